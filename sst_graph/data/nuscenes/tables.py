"""Tables of nuScenes, read record by record: ``sample_data.json`` of the full data set has a gigabyte."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError
from sst_graph.files.checked_values import pose_by_quaternion
from sst_graph.files.reading import parse_json

Record = Mapping[str, Any]

_CHUNK = 1 << 20
_MAX_RECORD = 1 << 16
"""Characters of a record; those of nuScenes have less than one thousand."""
_MAX_RECORDS = 20_000_000


def records(path: Path) -> Iterator[Record]:
    """Records of a table, one after the other.

    Raises:
        DataError: a missing file, no list of flat records, or one cut short.
    """
    expected = "a table of nuScenes: a JSON list of records"
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise DataError(path, "no regular file", expected)
        with open(path, encoding="utf-8") as stream:
            yield from _records(stream.read, path, expected)
    except FileNotFoundError:
        raise DataError(path, "no such file", expected) from None
    except UnicodeDecodeError:
        raise DataError(path, "no UTF-8 text", expected) from None
    except OSError as error:
        raise DataError(path, f"an unreadable file ({error.strerror})", expected) from None


def _records(read: Callable[[int], str], path: Path, expected: str) -> Iterator[Record]:
    text = read(_CHUNK).lstrip()
    if not text.startswith("["):
        raise DataError(path, f"text that begins with {text[:8]!r}", expected)
    text, at, count, ended = text[1:], 0, 0, False
    while True:
        # A record is flat: it ends at the first brace that closes outside a string.
        end = _end_of_record(text, at)
        if end < 0 and not ended:
            if len(text) - at > _MAX_RECORD + _CHUNK:
                raise DataError(path, f"a record of more than {_MAX_RECORD} characters", expected)
            more = read(_CHUNK)
            text, at, ended = text[at:] + more, 0, not more
            continue
        rest = text[at:] if end < 0 else text[at : end + 1]
        rest = rest.lstrip(", \t\r\n")
        if end < 0:
            if rest.strip() != "]":
                raise DataError(path, f"no whole record after {count}", expected)
            return
        value = parse_json(rest, f"{path} (record {count})", "a record")
        if not isinstance(value, dict):
            raise DataError(path, f"a {type(value).__name__} in record {count}", expected)
        yield value
        at, count = end + 1, count + 1
        if count > _MAX_RECORDS:
            raise DataError(path, f"more than {_MAX_RECORDS} records", expected)


_DECODER = json.JSONDecoder()


def _end_of_record(text: str, at: int) -> int:
    """Where the next record ends, or -1 where the text does not hold all of it."""
    start = text.find("{", at)
    if start < 0:
        return -1
    try:
        return _DECODER.raw_decode(text, start)[1] - 1
    except (ValueError, RecursionError):
        # cut short by the chunk, or damaged: parse_json says what is wrong where the brace is there
        return -1


def text_of(record: Record, name: str, path: Path) -> str:
    """Text of a record.

    Raises:
        DataError: something else.
    """
    value = record.get(name)
    if not isinstance(value, str):
        raise DataError(path, f"{name} = {value!r:.60}", "text")
    return value


def whole_of(record: Record, name: str, path: Path) -> int:
    """Whole number of a record.

    Raises:
        DataError: something else.
    """
    value = record.get(name)
    if isinstance(value, bool) or not isinstance(value, int):
        raise DataError(path, f"{name} = {value!r:.60}", "a whole number")
    return value


def matrix_of(value: Any, shape: tuple[int, ...], place: str) -> np.typing.NDArray[np.float64]:
    """Array of a record.

    Raises:
        DataError: another shape, or values that are no numbers.
    """
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape:
        raise DataError(place, f"{value!r:.60}", f"numbers of shape {shape}")
    return array


def pose_of(record: Record, path: Path) -> gtsam.Pose3:
    """Pose of a record: translation [m] and rotation as a quaternion w x y z.

    Raises:
        DataError: no such pose.
    """
    place = f"{path} ({record.get('token')!r:.40})"
    translation = matrix_of(record.get("translation"), (3,), place)
    return pose_by_quaternion(translation, matrix_of(record.get("rotation"), (4,), place), place)
