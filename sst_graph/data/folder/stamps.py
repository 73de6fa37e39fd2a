"""Stamps of files: in a CSV file beside them, or as their names.

``images.csv`` beside ``images/``: one "name,stamp" a line, or "stamp,name" (EuRoC), quotes or none, with
commas, semicolons, tabs or blanks between; a first line of words is a heading, a line behind "#" a comment.
Of more columns those of the name and of the stamp are taken, where they show; empty ones at the end are none.
A file without a line is left out, and so is a line whose file is missing. Names may have a path before them,
or lack their ending. Where the heading names a column of seconds and one of nanoseconds ("sec", "nanosec"),
these are the stamp, of any clock, with or without zeros before the nanoseconds.

A stamp, here or as a name, is seconds with a decimal point ("1317048145.963.png"), whole nanoseconds
("1317048145963000000.png"), or seconds and nanoseconds ("1317048145_963000000.png", or two columns of which
the first is a date); six digits behind a date are microseconds. Where all of them are dates in whole
microseconds or milliseconds they are read as such.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import listed
from sst_graph.errors import DataError, count_of
from sst_graph.files.reading import FileKind, read_text
from sst_graph.timestamps import FAR_APART_S, MAX_STAMPS, check_rising, checked_ns, parse_seconds

STAMPS_CSV = FileKind("a CSV file of name,stamp", 128 * 1024 * 1024)
LEAST_STEP_NS = 1_000_000
"""Median interval [ns] below which whole numbers are no nanoseconds but a count, or another unit."""

_WHOLE = re.compile(r"[+-]?\d{1,20}", re.ASCII)
_NUMBER = re.compile(r"[+-]?\d", re.ASCII)
_SECONDS = re.compile(r"\d{1,12}\.\d+", re.ASCII)
_PAIR = re.compile(r"(?=[1-4]\d{9}_|\d+_\d{9}$)(\d{1,10})_(\d{1,9})", re.ASCII)
"""Seconds and a part of a second: a date, or nanoseconds with all their zeros. Others are counts."""
_DATE = re.compile(r"\d{9,10}\.\d+|\d{13,19}", re.ASCII)
"""What cannot be a count beside a stamp: a date in seconds, or in whole units of 1 ms to 1 ns."""
_SECONDS_OF_DATE = re.compile(r"[1-4]\d{9}", re.ASCII)
_SECONDS_HEADING = re.compile(r"(^|[_. #\[])(s|secs?|seconds)\]?$", re.IGNORECASE)
_NANOSECONDS_HEADING = re.compile(r"(^|[_. #\[])(ns|nsecs?|nanosecs?|nanoseconds)\]?$", re.IGNORECASE)
_UP_TO_12_DIGITS = re.compile(r"\d{1,12}", re.ASCII)
_UP_TO_9_DIGITS = re.compile(r"\d{1,9}", re.ASCII)
_DATES_NS = (10**18, 42 * 10**17)
"""The years 2001 to 2103, between which dates of other units than nanoseconds have to lie [ns]."""
_OTHER_UNITS_NS = (1_000, 1_000_000)
_OF_PART_NS = {9: 1, 6: 1_000}
"""Unit of the part behind seconds [ns], by the digits of the longest: zeros before the others may lack."""
_STAMP = "seconds with a decimal point, whole nanoseconds, dates in microseconds or milliseconds, or sec_nsec"
_LINE = f"name,stamp or stamp,name (or name,sec,nsec); the stamp in {_STAMP}"


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
        words = {name: _stamp_of(path, table) for name, path in files.items()}
        stamps = _in_ns(words, {name: str(path) for name, path in files.items()})
    names = sorted(stamps, key=lambda name: stamps[name])
    stamps_ns = np.array([stamps[name] for name in names], np.int64)
    check_rising(stamps_ns, table if table.exists() else folder)
    if len(names) > 1 and float(np.median(np.diff(stamps_ns))) < LEAST_STEP_NS:
        step = float(np.median(np.diff(stamps_ns)))
        found = f"stamps with a median step of {step:g} ns"
        raise DataError(table if table.exists() else folder, found, f"stamps in {_STAMP}")
    paths = tuple(files[name] for name in names)
    return StampedFiles(stamps_ns, paths, len(files) - len(names), without_file)


def _stamp_of(path: Path, table: Path) -> str:
    """Stamp that a file's name is."""
    stem = path.name[: -len(path.suffix)]
    if _is_stamp(stem):
        return stem
    expected = f"a stamp ({_STAMP}), or {table.name} beside it"
    raise DataError(path, f"the name {stem!r:.80}", expected)


def _is_stamp(word: str) -> bool:
    return any(kind.fullmatch(word) for kind in (_SECONDS, _WHOLE, _PAIR))


def _in_ns(words: Mapping[str, str], places: Mapping[str, str]) -> dict[str, int]:
    """Stamps [ns] by the names of their files, of words that are such.

    Which unit whole numbers have, or parts behind seconds, all of them show together.

    Raises:
        DataError: a stamp that no clock shows, or parts of seconds of unknown unit.
    """
    parts = {name: pair[2] for name, word in words.items() if (pair := _PAIR.fullmatch(word))}
    longest = max(parts, key=lambda name: len(parts[name]), default=None)
    digits = 9 if longest is None else len(parts[longest])
    if longest is not None and digits not in _OF_PART_NS:
        expected = "nanoseconds in 9 digits, or microseconds in 6"
        raise DataError(places[longest], f"a part of a second in {count_of(digits, 'digit')}", expected)
    part_ns = _OF_PART_NS[digits]
    whole = [int(word) for word in words.values() if _WHOLE.fullmatch(word)]
    unit_ns = _unit_ns(whole) if len(whole) == len(words) else 1

    def stamp(word: str, place: str) -> int:
        if pair := _PAIR.fullmatch(word):
            return checked_ns(int(pair[1]) * 10**9 + int(pair[2]) * part_ns, place)
        if _SECONDS.fullmatch(word):
            return parse_seconds(word, place)
        return checked_ns(int(word) * unit_ns, place)

    return {name: stamp(word, places[name]) for name, word in words.items()}


def _unit_ns(whole: list[int]) -> int:
    """Unit of whole numbers: nanoseconds, or that by which they are dates at a sensor's rate."""
    steps = np.diff(np.unique(np.array(whole, np.float64)))
    step = float(np.median(steps)) if len(steps) else 0.0
    for unit_ns in _OTHER_UNITS_NS:
        dates = _DATES_NS[0] <= min(whole) * unit_ns <= max(whole) * unit_ns <= _DATES_NS[1]
        # Nanoseconds since a start some weeks ago would be such dates, too, minutes apart.
        if dates and (len(whole) == 1 or LEAST_STEP_NS <= step * unit_ns <= FAR_APART_S * 1e9):
            return unit_ns
    return 1


def _table(table: Path, files: Mapping[str, Path]) -> tuple[dict[str, int], int]:
    """Stamps by name, and the number of lines whose file is missing."""
    text = read_text(table, STAMPS_CSV)
    if text.count("\n") > MAX_STAMPS:
        raise DataError(table, count_of(text.count(chr(10)), "line"), f"at most {MAX_STAMPS} stamps")
    stamps: dict[str, str] = {}
    places: dict[str, str] = {}
    missing: list[tuple[str, str]] = []
    known = _by_any_name(files)
    lines = text.splitlines()
    columns = _seconds_and_nanoseconds(_words(lines[0])) if lines else None
    for number, line in enumerate(lines, 1):
        words = _words(line)
        place = f"{table}:{number}"
        if not words or _is_comment(words, known) or (number == 1 and _is_heading(words, known)):
            continue
        words = _with_one_stamp(words, columns)
        entry = _entry(words, known) if len(words) == 2 else _entry_of_many(words, known)
        if entry is None:
            raise DataError(place, f"{line!r:.80}", _LINE)
        word, stamp = entry
        name = known.get(_last_part(word))
        if name is None:
            missing.append((place, word))
        elif name in stamps:
            raise DataError(place, f"{name!r:.80} again", "each file once")
        else:
            stamps[name], places[name] = stamp, place
    if missing and not stamps:
        place, word = missing[0]
        raise DataError(place, f"{word!r:.80}", f"the name of a file in {table.stem}")
    if not stamps:
        raise DataError(table, "no stamp", "one name,stamp a line")
    return _in_ns(stamps, places), len(missing)


def _by_any_name(files: Mapping[str, Path]) -> dict[str, str]:
    """Names of files by themselves, and without the ending where one file alone is called so."""
    stems = Counter(path.stem for path in files.values())
    return {path.stem: name for name, path in files.items() if stems[path.stem] == 1} | {n: n for n in files}


def _last_part(word: str) -> str:
    """The name of a file without the path before it, of any system."""
    return re.split(r"[/\\]", word)[-1]


def _entry(words: list[str], known: Mapping[str, str]) -> tuple[str, str] | None:
    """Name and stamp of a line, or None where it has another content."""
    # A file may be called by a number, too: 000000 or its stamp.
    for name, word in sorted((words, words[::-1]), key=lambda pair: _last_part(pair[0]) not in known):
        if _is_stamp(word):
            return name, word
    return None


def _entry_of_many(words: list[str], known: Mapping[str, str]) -> tuple[str, str] | None:
    """Name and stamp of a line of three columns or more, or None where it does not show which they are.

    The name is that of a file, or no number. The stamp is the only date, or the seconds of one and
    nanoseconds side by side.
    """
    named = [word for word in words if _last_part(word) in known]
    named = [word for word in named if not _WHOLE.fullmatch(word)] or named
    named = named or [word for word in words if not _NUMBER.match(word)]
    if len(words) < 3 or len(named) != 1:
        return None
    others = [word for word in words if word != named[0]]
    dates = {word for word in others if _DATE.fullmatch(word)}
    pairs = [
        f"{seconds}_{part}"
        for seconds, part in pairwise(others)
        if _SECONDS_OF_DATE.fullmatch(seconds) and _PAIR.fullmatch(f"{seconds}_{part}")
    ]
    if len(dates) == 1:
        return named[0], dates.pop()
    return (named[0], pairs[0]) if len(pairs) == 1 and not dates else None


def _seconds_and_nanoseconds(heading: list[str]) -> tuple[int, int] | None:
    """Columns of seconds and nanoseconds that a heading, or a comment in its place, names; None of others."""
    found = [
        [column for column, word in enumerate(heading) if kind.search(word)]
        for kind in (_SECONDS_HEADING, _NANOSECONDS_HEADING)
    ]
    return (found[0][0], found[1][0]) if len(found[0]) == len(found[1]) == 1 else None


def _with_one_stamp(words: list[str], columns: tuple[int, int] | None) -> list[str]:
    """A line's fields with one stamp in the place of its two columns; as they are where it has others."""
    if columns is None or max(columns) >= len(words):
        return words
    seconds, nanoseconds = (words[column] for column in columns)
    if not _UP_TO_12_DIGITS.fullmatch(seconds) or not _UP_TO_9_DIGITS.fullmatch(nanoseconds):
        return words
    others = [word for column, word in enumerate(words) if column not in columns]
    return [*others, f"{seconds}.{nanoseconds:0>9}"]


def _is_heading(words: list[str], known: Mapping[str, str]) -> bool:
    """Whether a line names neither a file nor a number: "name,stamp_ns"."""
    return len(words) > 1 and not any(_last_part(word) in known or _NUMBER.match(word) for word in words)


def _is_comment(words: list[str], known: Mapping[str, str]) -> bool:
    """Whether a line begins with "#", and not with a file that is called so."""
    return words[0].startswith("#") and _last_part(words[0]) not in known


def _words(line: str) -> list[str]:
    """The fields of a line, quotes removed and none empty at the end; a name in quotes may hold commas, and
    quotes doubled."""
    line = line.strip()
    between = next((mark for mark in ",;\t" if mark in line), " ")
    try:
        rows = csv.reader([line], delimiter=between, skipinitialspace=True, strict=True)
        words = [word.strip() for word in next(rows, [])]
    except csv.Error:
        words = [line]
    while words and not words[-1]:
        words.pop()
    return words
