"""Stamps of files: in a CSV file beside them, or as their names.

``images.csv`` beside ``images/``: one "name,stamp" a line, or "stamp,name" (EuRoC), quotes or none; a first
line of words is a heading; a file without a line is left out. A stamp, here or as a name, is seconds with a
decimal point ("1317048145.963.png"), or whole nanoseconds ("1317048145963000000.png").
"""

from __future__ import annotations

import csv
import re
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
    """

    stamps_ns: NDArray[np.int64]
    paths: tuple[Path, ...]
    without_stamp: int = 0


def stamped_files(folder: Path, suffixes: tuple[str, ...]) -> StampedFiles:
    """Files of a folder with their stamps.

    Args:
        suffixes: of the files, lower case; others are passed over.

    Raises:
        DataError: no file, a name that is no stamp and no CSV file, stamps that are equal, a line of the CSV
            file that names no file or no stamp.
    """
    entries = listed(folder, f"files {', '.join('*' + suffix for suffix in suffixes)}")
    # Hidden files are no data: macOS puts "._NAME" beside NAME on foreign disks.
    shown = (path for path in entries if not path.name.startswith("."))
    files = {path.name: path for path in shown if path.suffix.lower() in suffixes}
    if not files:
        raise DataError(folder, "no such file", f"files {', '.join('*' + suffix for suffix in suffixes)}")
    table = folder.with_name(f"{folder.name}.csv")
    if table.exists():
        stamps = _table(table, files)
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
    return StampedFiles(stamps_ns, tuple(files[name] for name in names), len(files) - len(names))


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


def _table(table: Path, files: Mapping[str, Path]) -> dict[str, int]:
    """Stamps by name."""
    text = read_text(table, STAMPS_CSV)
    if text.count("\n") > MAX_STAMPS:
        raise DataError(table, count_of(text.count(chr(10)), "line"), f"at most {MAX_STAMPS} stamps")
    stamps: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = _words(line)
        place = f"{table}:{number}"
        if not any(words) or (number == 1 and _is_heading(words, files)):
            continue
        if len(words) != 2:
            raise DataError(place, f"{line!r:.80}", _LINE)
        # A file may be called by a number, too: 000000 or its stamp.
        name, word = words if words[0] in files or words[1] not in files else reversed(words)
        if (stamp := _stamp(word, place)) is None:
            raise DataError(place, f"{line!r:.80}", _LINE)
        if name not in files:
            raise DataError(place, f"{name!r:.80}", f"the name of a file in {table.stem}")
        if name in stamps:
            raise DataError(place, f"{name!r:.80} again", "each file once")
        stamps[name] = stamp
    if not stamps:
        raise DataError(table, "no stamp", "one name,stamp a line")
    return stamps


def _is_heading(words: list[str], files: Mapping[str, Path]) -> bool:
    """Whether a line names neither a file nor a number: "name,stamp_ns", "#timestamp [ns],filename"."""
    return len(words) == 2 and not any(word in files or _NUMBER.match(word) for word in words)


def _words(line: str) -> list[str]:
    """The fields of a line, quotes removed; a name in quotes may hold commas, and quotes doubled."""
    try:
        return [word.strip() for word in next(csv.reader([line], skipinitialspace=True, strict=True), [])]
    except csv.Error:
        return [line]
