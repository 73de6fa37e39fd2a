"""The files of a drive on this machine: their size, and what tells whether they have changed."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

_TEXT_SUFFIXES = (".txt", ".yaml", ".yml", ".json", ".csv", ".xml")
_MOST_TEXT_BYTES = 2**20
"""Smaller text files, such as calibrations and stamps, count with their contents: a corrected number need not
change their size."""


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
        if file.lower().endswith(_TEXT_SUFFIXES) and size < _MOST_TEXT_BYTES:
            with contextlib.suppress(OSError):
                digest.update(Path(file).read_bytes())
    return digest.hexdigest() if found else ""


def changed_at(path: Path) -> float:
    """When a drive's files, or folders that hold some, last changed: contents, names or rights, as the file
    system says [s since 1970]; 0 where there are none."""
    files = {file for file, _ in _files(path)}
    moment = 0.0
    for changed in files | {os.path.dirname(file) for file in files if path.is_dir()}:
        with contextlib.suppress(OSError):
            moment = max(moment, os.stat(changed).st_ctime)
    return moment


def _files(path: Path) -> Iterator[tuple[str, int]]:
    """Names and sizes of the file, or of all in the folder, that can be looked at; links are followed, each
    folder once."""
    if (size := _size(path)) is not None:
        yield os.fspath(path), size
        return
    seen: set[tuple[int, int]] = set()
    for folder, folders, names in os.walk(path, followlinks=True):
        with contextlib.suppress(OSError):
            status = os.stat(folder)
            if (status.st_dev, status.st_ino) in seen:
                folders.clear()
                continue
            seen.add((status.st_dev, status.st_ino))
        folders.sort()
        for name in names:
            file = os.path.join(folder, name)
            if (size := _size(file)) is not None:
                yield file, size


def _size(file: str | Path) -> int | None:
    """Bytes of a file; None of what is no file (a folder, a pipe), or cannot be looked at."""
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None
