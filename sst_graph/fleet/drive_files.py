"""The files of a drive on this machine: their size, and what tells whether they have changed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

_WORDS = (".txt", ".yaml", ".yml", ".json", ".csv", ".xml")
_MOST_WORDS_BYTES = 2**20
"""Smaller text files, such as calibrations and stamps, count with their contents: a number that is mended
leaves the size as it was."""


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return sum(size for _, size in _files(path))


def fingerprint(path: Path) -> str:
    """Of the names and sizes of a drive's files, and of the contents of small text files; empty where there
    are none. Hidden files do not count."""
    digest, found = sha256(), False
    for file, size in sorted(_files(path)):
        name = os.path.relpath(file, path)
        if any(part.startswith(".") and part != "." for part in name.split(os.sep)):
            continue
        found = True
        digest.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape"))
        if file.lower().endswith(_WORDS) and size < _MOST_WORDS_BYTES:
            with contextlib.suppress(OSError):
                digest.update(Path(file).read_bytes())
    return digest.hexdigest() if found else ""


def _files(path: Path) -> Iterator[tuple[str, int]]:
    """Names and sizes of the file, or of all in the folder, that can be looked at."""
    if path.is_file():
        yield os.fspath(path), path.stat().st_size
        return
    for folder, _, names in os.walk(path):
        for name in names:
            with contextlib.suppress(OSError):
                file = os.path.join(folder, name)
                yield file, os.stat(file).st_size
