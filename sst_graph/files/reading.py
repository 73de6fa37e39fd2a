"""Reading of files that others wrote: regular files of a bounded size, strict UTF-8, strict JSON and TOML.

Every file that is read passes through :func:`read_file`. What is no regular file (a folder, FIFO, socket,
device or looping link) and what is larger than its kind may be is refused before a byte is read, so that
nothing blocks and no memory is taken for it. JSON and TOML are bounded in depth, in their number of values
and in the length of a number, and hold finite numbers and unique keys only.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import stat
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

from sst_graph.errors import DataError, count_of, first_line
from sst_graph.factors.arguments import described

MAX_DEPTH = 64
"""Levels of JSON or TOML; what this package writes has at most ten."""
MAX_VALUES = 5_000_000
"""Values of a JSON document: with 100 bytes each in memory, half a gigabyte."""
MAX_NUMBER_LENGTH = 100
"""Characters of a number; a double needs 24, and none of our whole numbers has more than 20 digits."""
MAX_DIGITS = 20
MAX_DOTS = 500
"""Dots in a line of TOML: the standard library takes time with the square of the parts of a dotted key, 81 s
for 60,000 of them."""


@dataclass(frozen=True)
class FileKind:
    """A kind of input file.

    Attributes:
        name: what it is, as errors say it: "a calibration.json".
        max_bytes: the largest such file that is read.
    """

    name: str
    max_bytes: int


SETTINGS = FileKind("a settings file (JSON or TOML)", 256 * 1024)
CALIBRATION = FileKind("a calibration.json", 64 * 1024 * 1024)
MARGINAL = FileKind("a marginal.json", 1024 * 1024)
GROUND_TRUTH = FileKind("a groundtruth.json", 1024 * 1024)
CALIB_TXT = FileKind("a KITTI calib.txt", 1024 * 1024)
TIMES_TXT = FileKind("a text file with one number of seconds a line", 32 * 1024 * 1024)


def path_of(value: str | Path, expected: str) -> Path:
    """A path that a caller gave.

    Raises:
        DataError: a value that is no path; ``expected`` says what should be there.
    """
    if not isinstance(value, str | os.PathLike):
        raise DataError("path", described(value), f"a text or a pathlib.Path, of {expected}")
    path = Path(value)
    if "\0" in str(path):
        raise DataError(path, "no name of a file (a NUL character is in it)", expected)
    try:
        os.lstat(path)
    except UnicodeEncodeError:
        raise DataError(path, "no name of a file (a lone surrogate is in it)", expected) from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise DataError(path, f"a name of {count_of(len(str(path)), 'character')}", expected) from None
    return path


def read_file(path: str | Path, kind: FileKind) -> bytes:
    """Contents of a regular file of at most ``kind.max_bytes``.

    Raises:
        DataError: missing, unreadable, no regular file, or larger. Nothing blocks: a FIFO is not waited for.
    """
    with _opened(path, kind) as stream:
        # read(n) reserves n bytes before it reads: no more than the file has.
        size = min(os.fstat(stream.fileno()).st_size, kind.max_bytes)
        data = stream.read(size + 1)
        if len(data) > size:  # it grew meanwhile, or says nothing of its size, as in /proc
            data += stream.read(kind.max_bytes + 1 - len(data))
    if len(data) > kind.max_bytes:
        raise _too_large(path, len(data), kind)
    return data


def digest_of_file(path: str | Path, kind: FileKind) -> bytes:
    """SHA-256 of the contents of a regular file of at most ``kind.max_bytes``, read in parts.

    Raises:
        DataError: as :func:`read_file`.
    """
    with _opened(path, kind) as stream:
        return hashlib.file_digest(stream, "sha256").digest()


@contextmanager
def _opened(path: str | Path, kind: FileKind) -> Iterator[BufferedReader]:
    """A regular file of at most ``kind.max_bytes``, open to be read; errors, also of reading it, are ours."""
    path = path_of(path, kind.name)
    try:
        _require_regular(os.stat(path), path, kind)
        # O_NONBLOCK: what was replaced by a FIFO since must not block either
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as stream:
            _require_regular(os.fstat(descriptor), path, kind)
            yield stream
    except FileNotFoundError:
        raise DataError(path, "no such file", kind.name) from None
    except OSError as error:
        raise DataError(path, f"an unreadable file ({error.strerror or error})", kind.name) from None
    except ValueError as error:  # a lone surrogate in the name
        raise DataError(path, f"no name of a file ({error})", kind.name) from None


def read_text(path: str | Path, kind: FileKind) -> str:
    """Contents of a UTF-8 text file, decoded strictly; a byte-order mark is left out.

    Raises:
        DataError: as :func:`read_file`, or bytes that are no UTF-8.
    """
    data = read_file(path, kind)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"no UTF-8 text (byte {error.start} is 0x{data[error.start]:02x})"
        raise DataError(path, found, kind.name) from None


def read_json(path: str | Path, kind: FileKind) -> Any:
    """The value in a JSON file; see :func:`parse_json`.

    Raises:
        DataError: as :func:`read_text` and :func:`parse_json`.
    """
    return parse_json(read_text(path, kind), path, kind.name)


def read_toml(path: str | Path, kind: FileKind) -> dict[str, Any]:
    """The table in a TOML file; see :func:`parse_toml`.

    Raises:
        DataError: as :func:`read_text` and :func:`parse_toml`.
    """
    return parse_toml(read_text(path, kind), path, kind.name)


def parse_json(text: str, place: str | Path, expected: str = "JSON", max_depth: int = MAX_DEPTH) -> Any:
    """The value of a JSON text: finite numbers, unique keys, bounded depth and size.

    Raises:
        DataError: naming ``place``: no JSON, NaN or Infinity (1e999 too), a key given twice, more than
            ``max_depth`` levels or MAX_VALUES values, a number of more than MAX_NUMBER_LENGTH characters or
            MAX_DIGITS digits, a string with half a character (a lone surrogate).
    """
    if not isinstance(text, str):
        raise DataError(place, f"a {type(text).__name__}", f"{expected} as text")
    if text.count(",") + text.count("[") + text.count("{") > MAX_VALUES:
        raise DataError(place, "too many values", f"{expected} with at most {MAX_VALUES}")

    def parse() -> Any:
        return json.loads(
            text,
            parse_int=_whole_number,
            parse_float=_finite_number,
            parse_constant=_no_constant,
            object_pairs_hook=_unique_keys,
        )

    return _parsed(parse, place, "JSON", expected, max_depth)


def parse_toml(text: str, place: str | Path, expected: str = "TOML") -> dict[str, Any]:
    """The table of a TOML text: finite numbers, bounded depth.

    Raises:
        DataError: naming ``place``: no TOML, inf or nan, more than MAX_DEPTH levels, a number that is too
            long, more than MAX_DOTS dots in a line.
    """
    if len(text) > MAX_DOTS and max(line.count(".") for line in text.split("\n")) > MAX_DOTS:
        raise DataError(place, f"a line with more than {MAX_DOTS} dots", expected)
    table: dict[str, Any] = _parsed(
        lambda: tomllib.loads(text, parse_float=_finite_number), place, "TOML", expected
    )
    return table


def _parsed(
    parse: Callable[[], Any], place: str | Path, language: str, expected: str, max_depth: int = MAX_DEPTH
) -> Any:
    try:
        value = parse()
        check_values(value, max_depth)
    except RecursionError:
        raise DataError(place, f"{language} nested too deeply", f"at most {max_depth} levels") from None
    except ValueError as error:  # JSONDecodeError, TOMLDecodeError and those of the hooks below
        raise DataError(place, f"no {language} ({said_of_values(error)})", expected) from None
    return value


def said_of_values(error: Exception) -> str:
    """What a parser's error says, on one line; not what Python advises for thousands of digits."""
    return _TOO_MANY_DIGITS if "int_max_str_digits" in str(error) else first_line(error)


_TOO_MANY_DIGITS = f"a whole number of more than {MAX_DIGITS} digits"


def check_values(value: Any, max_depth: int) -> None:
    """Depth, whole numbers (parsers of TOML and YAML have no hook for them) and text of a parsed document.

    Raises:
        RecursionError: more than ``max_depth`` levels.
        ValueError: a number of more than MAX_DIGITS digits, or half a character.
    """
    level, depth = [value], 0
    while level:
        depth += 1
        if depth > max_depth:
            raise RecursionError
        below: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                below.extend(item)
                below.extend(item.values())
            elif isinstance(item, list):
                below.extend(item)
            elif isinstance(item, str):
                if not item.isascii() and any("\ud800" <= c <= "\udfff" for c in item):
                    raise ValueError("a lone surrogate in a string")
            elif isinstance(item, int) and abs(item) >= 10**MAX_DIGITS:
                raise ValueError(_TOO_MANY_DIGITS)
        level = below


def _whole_number(text: str) -> int:
    if len(text) > MAX_DIGITS + 1:
        raise ValueError(f"a whole number of {count_of(len(text), 'character')}")
    return int(text)


def _finite_number(text: str) -> float:
    if len(text) > MAX_NUMBER_LENGTH:
        raise ValueError(f"a number of {count_of(len(text), 'character')}")
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"the number {text} is not finite")
    return number


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice!r:.60} twice")
    return table


def _require_regular(status: os.stat_result, path: str | Path, kind: FileKind) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise DataError(path, _KINDS.get(stat.S_IFMT(status.st_mode), "no regular file"), kind.name)
    if status.st_size > kind.max_bytes:
        raise _too_large(path, status.st_size, kind)


def refuse_special(paths: Iterable[Path], expected: str) -> None:
    """Refuse what is there and neither a regular file nor a folder: another library would wait for it.

    Raises:
        DataError: a FIFO, a socket or a device.
    """
    for path in paths:
        try:
            kind = stat.S_IFMT(os.stat(path).st_mode)
        except (OSError, ValueError):  # missing: said where it is read
            continue
        if kind not in (stat.S_IFREG, stat.S_IFDIR):
            raise DataError(path, _KINDS.get(kind, "no regular file"), expected)


def _too_large(path: str | Path, size: int, kind: FileKind) -> DataError:
    return DataError(path, f"{size} bytes or more", f"{kind.name} of at most {kind.max_bytes} bytes")


_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}
