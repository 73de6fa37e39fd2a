"""Stamps of files: in a CSV file beside them, or as their names.

``images.csv`` beside ``images/``: one "name,stamp" a line, or "stamp,name" (EuRoC), quotes or none; a first
line of words is a heading. A file without a line is left out, and so is a line whose file is missing. Names
may have a path before them, or lack their ending. A stamp, here or as a name, is seconds with a decimal point
("1317048145.963.png"), or whole nanoseconds ("1317048145963000000.png").
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import listed
from sst_graph.errors import DataError, count_of
from sst_graph.files.reading import FileKind, read_text
from sst_graph.timestamps import MAX_STAMPS, check_rising, checked_ns, parse_seconds

STAMPS_CSV = FileKind("a CSV file of name,stamp", 128 * 1024 * 1024)
LEAST_STEP_NS = 1_000_000
"""Median interval [ns] below which whole numbers are no nanoseconds but a count, or another unit."""

_WHOLE = re.compile(r"[+-]?\d{1,20}", re.ASCII)
_NUMBER = re.compile(r"[+-]?\d", re.ASCII)
_SECONDS = re.compile(r"\d{1,12}\.\d+", re.ASCII)
_STAMP = "seconds with a decimal point, or whole nanoseconds"
_LINE = f"name,stamp or stamp,name; the stamp in {_STAMP}"


@dataclass(frozen=True, eq=False)
class StampedFiles:
    """Files of one sensor in the order of their stamps.

    Attributes:
        stamps_ns: (n,) rising strictly [ns].
        paths: (n,) files.
        without_stamp: number of files that are left out because the CSV file does not name them.
        without_file: number of lines of the CSV file that name no file.
    """

    stamps_ns: NDArray[np.int64]
    paths: tuple[Path, ...]
    without_stamp: int = 0
    without_file: int = 0


def stamped_files(folder: Path, suffixes: tuple[str, ...]) -> StampedFiles:
    """Files of a folder with their stamps.

    Args:
        suffixes: of the files, lower case; others are passed over.

    Raises:
        DataError: no file, a name that is no stamp and no CSV file, stamps that are equal, a line of the CSV
            file without a stamp, or none that names a file.
    """
    entries = listed(folder, f"files {', '.join('*' + suffix for suffix in suffixes)}")
    # Hidden files are no data: macOS puts "._NAME" beside NAME on foreign disks.
    shown = (path for path in entries if not path.name.startswith("."))
    files = {path.name: path for path in shown if path.suffix.lower() in suffixes}
    if not files:
        raise DataError(folder, "no such file", f"files {', '.join('*' + suffix for suffix in suffixes)}")
    table = folder.with_name(f"{folder.name}.csv")
    without_file = 0
    if table.exists():
        stamps, without_file = _table(table, files)
    else:
        stamps = {name: _stamp_of(path, table) for name, path in files.items()}
    names = sorted(stamps, key=lambda name: stamps[name])
    stamps_ns = np.array([stamps[name] for name in names], np.int64)
    check_rising(stamps_ns, table if table.exists() else folder)
    if len(names) > 1 and float(np.median(np.diff(stamps_ns))) < LEAST_STEP_NS:
        step = float(np.median(np.diff(stamps_ns)))
        found = f"stamps with a median step of {step:g} ns"
        expected = "stamps in seconds with a decimal point or in whole nanoseconds"
        raise DataError(table if table.exists() else folder, found, expected)
    paths = tuple(files[name] for name in names)
    return StampedFiles(stamps_ns, paths, len(files) - len(names), without_file)


def _stamp_of(path: Path, table: Path) -> int:
    """Stamp [ns] that a file's name is."""
    stem = path.name[: -len(path.suffix)]
    if (stamp := _stamp(stem, path)) is not None:
        return stamp
    expected = f"a stamp ({_STAMP}), or {table.name} beside it"
    raise DataError(path, f"the name {stem!r:.80}", expected)


def _stamp(word: str, place: str | Path) -> int | None:
    """A stamp [ns], or None where the word is none."""
    if _SECONDS.fullmatch(word):
        return parse_seconds(word, place)
    return checked_ns(int(word), place) if _WHOLE.fullmatch(word) else None


def _table(table: Path, files: Mapping[str, Path]) -> tuple[dict[str, int], int]:
    """Stamps by name, and the number of lines whose file is missing."""
    text = read_text(table, STAMPS_CSV)
    if text.count("\n") > MAX_STAMPS:
        raise DataError(table, count_of(text.count(chr(10)), "line"), f"at most {MAX_STAMPS} stamps")
    stamps: dict[str, int] = {}
    missing: list[tuple[str, str]] = []
    known = _by_any_name(files)
    for number, line in enumerate(text.splitlines(), 1):
        words = _words(line)
        place = f"{table}:{number}"
        if not any(words) or (number == 1 and _is_heading(words, known)):
            continue
        entry = _entry(words, known, place)
        if entry is None:
            raise DataError(place, f"{line!r:.80}", _LINE)
        word, stamp = entry
        name = known.get(_last_part(word))
        if name is None:
            missing.append((place, word))
        elif name in stamps:
            raise DataError(place, f"{name!r:.80} again", "each file once")
        else:
            stamps[name] = stamp
    if missing and not stamps:
        place, word = missing[0]
        raise DataError(place, f"{word!r:.80}", f"the name of a file in {table.stem}")
    if not stamps:
        raise DataError(table, "no stamp", "one name,stamp a line")
    return stamps, len(missing)


def _by_any_name(files: Mapping[str, Path]) -> dict[str, str]:
    """Names of files by themselves, and without the ending where one file alone is called so."""
    stems = Counter(path.stem for path in files.values())
    return {path.stem: name for name, path in files.items() if stems[path.stem] == 1} | {n: n for n in files}


def _last_part(word: str) -> str:
    """The name of a file without the path before it, of any system."""
    return re.split(r"[/\\]", word)[-1]


def _entry(words: list[str], known: Mapping[str, str], place: str) -> tuple[str, int] | None:
    """Name and stamp [ns] of a line, or None where it has another content."""
    if len(words) != 2:
        return None
    # A file may be called by a number, too: 000000 or its stamp.
    for name, word in sorted((words, words[::-1]), key=lambda pair: _last_part(pair[0]) not in known):
        if (stamp := _stamp(word, place)) is not None:
            return name, stamp
    return None


def _is_heading(words: list[str], known: Mapping[str, str]) -> bool:
    """Whether a line names neither a file nor a number: "name,stamp_ns", "#timestamp [ns],filename"."""
    return len(words) == 2 and not any(word in known or _NUMBER.match(word) for word in words)


def _words(line: str) -> list[str]:
    """The fields of a line, quotes removed; a name in quotes may hold commas, and quotes doubled."""
    try:
        return [word.strip() for word in next(csv.reader([line], skipinitialspace=True, strict=True), [])]
    except csv.Error:
        return [line]
