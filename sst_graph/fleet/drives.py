"""The drives of a batch: from a folder, a pattern or a list to names, vehicles and dates."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.factors.arguments import checked_count, checked_several, checked_type
from sst_graph.fleet.places import Place

_NOT_IN_A_NAME = re.compile(r"[^\w.=+-]+")
_PATTERN = re.compile(r"[*?\[]")
_COMMENT = re.compile(r"(^|\s)#.*")
_LONGEST_NAME = 150  # bytes
BAGS = (".bag", ".mcap", ".db3")
"""How files end that are drives; of all others in a folder of drives none is one."""
MOST_DRIVES = 1_000_000

_DATES = (
    "%Y-%m-%d",
    "%Y%m%d",
    "%Y_%m_%d",
    "%Y-%m-%dT%H:%M:%S",
    "%Y-%m-%dT%H-%M-%S",
    "%Y-%m-%d-%H-%M-%S",
    "%Y-%m-%d_%H-%M-%S",
    "%Y%m%dT%H%M%S",
    "%Y%m%d_%H%M%S",
    "%Y%m%d-%H%M%S",
    "%Y_%m_%d-%H_%M_%S",
)
_HYPHEN_IN_TIME = re.compile(r"(\d{4}-?\d\d-?\d\d)[-_T ](\d\d)-(\d\d)", re.ASCII)
"""Hour and minute as file names have them; in ISO 8601 the minute would be hours west of Greenwich."""


@dataclass(frozen=True)
class ListedDrive:
    """A drive that is to be calibrated.

    Attributes:
        name: of its result's folder; no two drives of a batch have the same.
        place: where its data stand.
        vehicle: whose sensors it shares with other drives; empty where that is not known.
        date: ISO 8601, UTC where it names no zone; empty where it is not known.

    Raises:
        FactorError: no place, or names that are no texts.
        DataError: no date.
    """

    name: str
    place: Place
    vehicle: str = ""
    date: str = ""

    def __post_init__(self) -> None:
        for field in ("name", "vehicle", "date"):
            checked_type(f"{field} of a ListedDrive", getattr(self, field), str, "a text")
        checked_type("place of a ListedDrive", self.place, Place, "a Place (Place.of)")
        _checked_date(self.date, f"date of the drive {self.name:.60}")

    @property
    def day(self) -> float | None:
        """Days since 1970, or None without a date."""
        return None if not self.date else _instant(self.date).timestamp() / 86400.0


def checked_drives(drives: Sequence[ListedDrive]) -> None:
    """Refuse what is no list of drives.

    Raises:
        FactorError: it is none.
    """
    one, several = "a ListedDrive (find_drives)", "a list of ListedDrive (find_drives)"
    checked_several("drives", drives, ListedDrive, one, several)


def find_drives(what: str | Path, name_parts: int = 1) -> list[ListedDrive]:
    """The drives that a folder, a pattern or a list names, in the order of the list or of their names.

    Of a folder they are its folders and its bags; other files that lie there are left out
    (:func:`loose_files`).

    A list is a text file with one path or URL a line (# after a blank begins a comment), or a CSV with a
    column ``drive`` and any of ``name``, ``vehicle`` and ``date``. Paths in it are relative to where the
    program was started.

    Args:
        name_parts: how many of the last parts of a path make a drive's name.

    Raises:
        ConfigError: none are found, two have the same name, or two vehicles' files have one name.
        DataError: the list cannot be read.
        FactorError: no name of a place, or no number of parts.
    """
    checked_type("drives", what, (str, Path), "a folder of drives, a pattern, or a list, by its path")
    what = str(what)
    checked_count("name_parts", name_parts)
    if not what.strip():
        raise ConfigError("drives: found an empty name, expected a folder of drives, a pattern, or a list")
    place = Place.of(what)
    # A name with brackets may be a folder's own.
    if place.is_folder():
        drives = [_named(one, name_parts) for one, folder in place.entries().items() if _holds(one, folder)]
    elif place.exists():
        drives = _of_list(place, name_parts)
    elif _PATTERN.search(what):
        drives = [_named(one, name_parts) for one in place.matches()]
    else:
        raise ConfigError(f"{what}: found nothing, expected a folder of drives, a pattern, or a list")
    if not drives:
        bags = ", ".join(BAGS)
        raise ConfigError(f"{what}: found no drive, expected at least one folder or bag ({bags})")
    if len(drives) > MOST_DRIVES:
        raise ConfigError(f"{what}: found {count_of(len(drives), 'drive')}, expected at most {MOST_DRIVES}")
    _check_names(drives)
    vehicle_files(drive.vehicle for drive in drives)
    return drives


def loose_files(what: str) -> list[str]:
    """Names of the files in a folder of drives that are taken for no drive; none of a pattern or a list.

    Raises:
        DataError: the folder cannot be listed.
    """
    place = Place.of(what)
    if not place.is_folder():
        return []
    return [one.name for one, folder in place.entries().items() if not _holds(one, folder)]


def _holds(place: Place, is_folder: bool) -> bool:
    """Whether an entry of a folder of drives may be one."""
    return is_folder or place.name.lower().endswith(BAGS)


def with_vehicles(drives: Sequence[ListedDrive], given: str | Path) -> list[ListedDrive]:
    """The drives with vehicle and date by a CSV or a regular expression.

    Args:
        given: a CSV with columns ``drive`` (its name, path or URL), ``vehicle`` and, if known, ``date``; or a
            regular expression on a drive's path with a group ``vehicle`` (or one group without a name) and,
            if its dates are in the paths, a group ``date``.

    Raises:
        ConfigError: no such expression, or it fits no drive; two vehicles whose files have one name.
        DataError: the CSV cannot be read, or has two rows of one drive.
        FactorError: no drives, or no text.
    """
    checked_drives(drives)
    checked_type("given", given, (str, Path), "the path of a CSV, or a regular expression")
    given = str(given)
    row_of = _by_table(given) if given.lower().endswith(".csv") else _by_expression(given)
    found = []
    for drive in drives:
        row = row_of(drive)
        date = _checked_date(row.get("date") or drive.date, f"--vehicle-from {given}: {drive.place}")
        found.append(replace(drive, vehicle=(row.get("vehicle") or drive.vehicle).strip(), date=date))
    if not any(drive.vehicle for drive in found):
        raise ConfigError(
            f"--vehicle-from {given}: found no vehicle of any of {count_of(len(found), 'drive')}"
        )
    vehicle_files(drive.vehicle for drive in found)
    return found


def file_name(words: str) -> str:
    """Words as the name of a file: what is no letter and no digit of any script becomes an underscore."""
    name = _NOT_IN_A_NAME.sub("_", unicodedata.normalize("NFC", words)).strip("._") or "_"
    return name.encode("utf-8")[:_LONGEST_NAME].decode("utf-8", "ignore")


def vehicle_files(names: Iterable[str]) -> dict[str, str]:
    """The name of a file for each vehicle; drives of no known one (an empty name) have none.

    Raises:
        ConfigError: one name for two of them.
    """
    owners: dict[str, str] = {}
    for vehicle in sorted(set(names) - {""}):
        name = f"{file_name(vehicle)}.json"
        if owners.setdefault(name, vehicle) != vehicle:
            raise ConfigError(f"vehicles {owners[name]!r} and {vehicle!r}: found one file {name} for both")
    return {vehicle: name for name, vehicle in owners.items()}


def _by_table(given: str) -> Callable[[ListedDrive], Mapping[str, str | None]]:
    known: dict[str, dict[str, str]] = {}
    for row in _rows(Place.of(given), ("drive", "vehicle")):
        place = Place.of(row["drive"])
        # A name without a folder may be that of the folder or that of its result.
        for key in {place.url, place.whole()} | ({file_name(place.url)} if "/" not in place.url else set()):
            if known.setdefault(key, row) != row:
                raise DataError(given, f"two rows of the drive {row['drive']}", "one vehicle and one date")

    def row_of(drive: ListedDrive) -> Mapping[str, str | None]:
        return known.get(drive.name) or known.get(drive.place.whole()) or {}

    return row_of


def _by_expression(given: str) -> Callable[[ListedDrive], Mapping[str, str | None]]:
    try:
        expression = re.compile(given)
    except (re.error, OverflowError, RecursionError) as error:
        raise ConfigError(f"--vehicle-from {given!r:.80}: found no regular expression ({error})") from error
    names = expression.groupindex
    unnamed = [number for number in range(1, expression.groups + 1) if number not in names.values()]
    if "vehicle" not in names and not unnamed:
        raise ConfigError(f"--vehicle-from {given!r}: found no group, expected (?P<vehicle>...)")
    group = "vehicle" if "vehicle" in names else unnamed[0]

    def row_of(drive: ListedDrive) -> Mapping[str, str | None]:
        match = expression.search(drive.place.url)
        if match is None:
            return {}
        return {"vehicle": match.group(group), "date": match.groupdict().get("date")}

    return row_of


def _of_list(place: Place, name_parts: int) -> list[ListedDrive]:
    if place.name.lower().endswith(".csv"):
        drives = []
        for row in _rows(place, ("drive",)):
            drive = _named(Place.of(row["drive"]), name_parts)
            date = _checked_date(row.get("date", ""), f"{place}: {row['drive']}")
            name = file_name(row["name"]) if row.get("name") else drive.name
            drives.append(ListedDrive(name, drive.place, row.get("vehicle", ""), date))
        return drives
    lines = (_COMMENT.sub("", line).strip() for line in _text(place).splitlines())
    return [_named(Place.of(line), name_parts) for line in lines if line]


def _rows(place: Place, needed: Iterable[str]) -> list[dict[str, str]]:
    """Rows of a CSV, by the names in its first line, without spaces around."""
    try:
        reader = csv.DictReader(io.StringIO(_text(place)), strict=True)
        head = [name.strip().lower() for name in reader.fieldnames or ()]
        missing = [name for name in needed if name not in head]
        if missing:
            raise DataError(place.url, f"the columns {', '.join(head)}", f"a column {missing[0]}")
        reader.fieldnames = head
        rows = []
        for row in reader:
            extra = row.pop(None, None)
            if extra:
                raise DataError(f"{place}: line {reader.line_num}", "too many cells", f"{len(head)}")
            rows.append({name: (cell or "").strip() for name, cell in row.items()})
            if any(not rows[-1][name] for name in needed):
                raise DataError(f"{place}: line {reader.line_num}", "an empty cell", ", ".join(needed))
        return rows
    except csv.Error as error:
        raise DataError(place.url, str(error), "a CSV file") from error


def _text(place: Place) -> str:
    try:
        text = place.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(place.url, "bytes that are no UTF-8", "a list of drives (text or CSV)") from error
    if "\0" in text:
        raise DataError(place.url, "a zero byte", "a list of drives (text or CSV)")
    return text


def _named(place: Place, parts: int) -> ListedDrive:
    return ListedDrive(file_name("_".join(place.url.split("/")[-parts:])), place)


def _check_names(drives: Sequence[ListedDrive]) -> None:
    names = Counter(drive.name for drive in drives)
    for name, count in names.items():
        if count > 1:
            same = [drive.place for drive in drives if drive.name == name]
            if len({place.whole() for place in same}) < count:
                raise ConfigError(f"{same[0]}: found the drive {name} twice, expected each drive once")
            first, second = same[:2]
            raise ConfigError(
                f"{first} and {second}: found two drives named {name}, expected names that differ "
                "(--name-parts 2 takes the folder above into the name; a list in CSV has a column name)"
            )


def _checked_date(text: str, place: str) -> str:
    """A date in ISO 8601."""
    if not text:
        return ""
    try:
        return _instant(text).isoformat()
    except ValueError:
        raise DataError(
            place, f"the date {text!r:.60}", "one such as 2026-11-23 or 20261123_101500"
        ) from None


def _instant(text: str) -> datetime:
    if plain := _HYPHEN_IN_TIME.fullmatch(text):
        text = f"{plain[1]}T{plain[2]}:{plain[3]}"
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        for form in _DATES:
            try:
                found = datetime.strptime(text, form)
                break
            except ValueError:
                continue
        else:
            raise
    return found if found.tzinfo else found.replace(tzinfo=UTC)
