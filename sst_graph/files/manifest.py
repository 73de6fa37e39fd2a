"""The manifest of a folder: which of its files were written by us, and are as we wrote them."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from sst_graph.errors import DataError
from sst_graph.files.reading import FileKind, read_json

MANIFEST = ".sst-graph-manifest.json"
FORMAT = "sst-graph/manifest"
VERSION = 1

KEPT = ".kept"
"""Is appended to the name of a file of others where a new file of ours needs it."""

_MANIFEST = FileKind("the manifest of a folder", 256 * 1024 * 1024)
_CHUNK = 1 << 20


@dataclass(frozen=True)
class OutputKind:
    """A kind of folder that a command writes.

    Attributes:
        name: what it is; one kind is never replaced by another.
        exclusive: folders in it in which files of others would be taken for ours ("sequences"); a folder
            that holds such files is not replaced.
    """

    name: str
    exclusive: tuple[str, ...] = ()


@dataclass(frozen=True)
class Manifest:
    """What was written into a folder.

    Attributes:
        kind: name of the :class:`OutputKind`.
        files: (size in bytes, SHA-256) by path relative to the folder.
    """

    kind: str
    files: Mapping[str, tuple[int, str]]


def write_manifest(folder: Path, kind: OutputKind) -> None:
    """Write the manifest of all files that stand in ``folder``."""
    files = {
        path: list(_fingerprint(folder / path))
        for path in sorted(_files(folder))
        if path != MANIFEST and not (folder / path).is_symlink()
    }
    document = {"format": FORMAT, "version": VERSION, "kind": kind.name, "files": files}
    (folder / MANIFEST).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a folder, or None where there is none that can be read."""
    try:
        document = read_json(folder / MANIFEST, _MANIFEST)
        if document["format"] != FORMAT or document["version"] != VERSION:
            return None
        files = {str(path): (int(size), str(digest)) for path, (size, digest) in document["files"].items()}
        return Manifest(str(document["kind"]), files)
    except (DataError, ValueError, KeyError, TypeError, AttributeError):
        return None


def others(folder: Path, manifest: Manifest) -> list[str]:
    """Files in ``folder`` that are not of the manifest, or were changed since; relative paths."""
    return sorted(
        path
        for path in _files(folder)
        if path != MANIFEST and not _as_written(folder / path, manifest.files.get(path))
    )


def carry_over(folder: Path, new: Path) -> list[str]:
    """Put what others keep in ``folder`` into ``new`` as well (as links, where that is possible).

    Where ``new`` has something of that name, theirs gets ``.kept`` appended. Returns the paths in ``new``.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        return []
    carried = []
    for path in others(folder, manifest):
        place = next(place for place in _places(path, new) if not os.path.lexists(new / place))
        (new / place).parent.mkdir(parents=True, exist_ok=True)
        _link(folder / path, new / place)
        carried.append(place)
    _carry_empty_folders(folder, new)
    return carried


def give_back(former: Path, target: Path) -> None:
    """Move what others wrote into ``former`` while ``target`` took its place; the younger file is kept."""
    before, now = read_manifest(former), read_manifest(target)
    if before is None:
        return
    ours = now.files if now is not None else {}
    for path in others(former, before):
        with suppress(OSError):
            _give_back_one(former / path, path, target, ours)


def _give_back_one(old: Path, path: str, target: Path, ours: Mapping[str, tuple[int, str]]) -> None:
    """Move one file into ``target``, unless it is there under a name it may have been carried over to."""
    for place in _places(path, target):
        if os.path.lexists(target / place):
            mine, theirs = os.lstat(target / place), os.lstat(old)
            if os.path.samestat(mine, theirs) or _stamp(mine) == _stamp(theirs):
                return
            if place in ours or place != path:
                continue
            if theirs.st_mtime_ns <= mine.st_mtime_ns:
                return
        (target / place).parent.mkdir(parents=True, exist_ok=True)
        os.replace(old, target / place)
        return


def _places(path: str, folder: Path) -> Iterator[str]:
    """Names for a file of others in ``folder``, the first choice first, none below a file."""
    below_a_file = any(
        os.path.lexists(folder / parent) and not (folder / parent).is_dir()
        for parent in PurePosixPath(path).parents
    )
    if below_a_file:
        path = path.replace("/", "_")
    yield path
    yield path + KEPT
    for number in itertools.count(2):
        yield f"{path}{KEPT}{number}"


def _stamp(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns


def _link(source: Path, place: Path) -> None:
    try:
        os.link(source, place, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, place, follow_symlinks=False)


def _carry_empty_folders(folder: Path, new: Path) -> None:
    for path, folders, files in os.walk(folder):
        if not folders and not files:
            with suppress(OSError):
                (new / os.path.relpath(path, folder)).mkdir(parents=True, exist_ok=True)


def _files(folder: Path) -> Iterator[str]:
    """Relative paths of everything in a folder that is not itself a folder; links are not followed."""
    for path, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(path, name))]
        for name in (*files, *links):
            yield os.path.relpath(os.path.join(path, name), folder)


def _as_written(path: Path, expected: tuple[int, str] | None) -> bool:
    if expected is None or path.is_symlink() or not path.is_file():
        return False
    try:
        return path.stat().st_size == expected[0] and _fingerprint(path) == expected
    except OSError:
        return False


def _fingerprint(path: Path) -> tuple[int, str]:
    digest: Any = hashlib.sha256()
    size = 0
    with open(path, "rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()
