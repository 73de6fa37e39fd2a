"""What may be written where: refused before work begins, not after it."""

from __future__ import annotations

import codecs
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sst_graph.errors import ConfigError
from sst_graph.files.manifest import MANIFEST, OutputKind, others, read_manifest

_HEAD = 4096
"""Bytes by which a kind of file is recognized."""


@dataclass(frozen=True)
class OutputFileKind:
    """A kind of file that a command writes.

    Attributes:
        name: what it is, with its article.
        recognizes: whether the first bytes of a file (up to 4 kB) are of this kind; another is not replaced.
    """

    name: str
    recognizes: Callable[[bytes], bool]


def is_text(head: bytes) -> bool:
    """Whether the first bytes of a file are UTF-8 text."""
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


TEXT = OutputFileKind("a text file", is_text)


def check_file_target(path: str | Path, overwrite: bool, kind: OutputFileKind) -> None:
    """Refuse an output file that cannot be made, or must not be replaced; ask before work begins.

    Args:
        path: the file to be made.
        overwrite: whether an earlier file of the same kind may be replaced; an empty file is of any kind.
        kind: of the output.

    Raises:
        ConfigError: it is there and may not be replaced, or is no ordinary file, or its folder cannot be
            made or written.
    """
    target = real_path(path)
    _check_reachable(path, target)
    if not target.exists():
        return
    if target.is_dir():
        raise ConfigError(f"{path}: found a folder, expected a file or nothing")
    if not target.is_file():
        raise ConfigError(f"{path}: found a device or a pipe, expected a file or nothing")
    if not overwrite:
        raise ConfigError(f"{path}: found a file, expected none (or --overwrite)")
    try:
        with open(target, "rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise ConfigError(f"{path}: found a file that cannot be read ({error.strerror})") from error
    if head and not kind.recognizes(head):
        raise ConfigError(f"{path}: found another kind of file, expected {kind.name} to overwrite")


def check_folder_target(path: str | Path, overwrite: bool, kind: OutputKind) -> None:
    """Refuse an output folder that cannot be made, or must not be replaced; ask before work begins.

    One that is absent or empty is always fine.

    Args:
        path: the folder to be made.
        overwrite: whether an earlier output of the same kind may be replaced.
        kind: of the output.

    Raises:
        ConfigError: it is a file or a mount point, holds something and may not be replaced, was not
            written as this kind, or its parent cannot be made or written.
    """
    target = real_path(path)
    _check_reachable(path, target)
    if not target.exists():
        return
    if not target.is_dir():
        raise ConfigError(f"{path}: found a file, expected a folder or nothing")
    if target.is_mount():
        raise ConfigError(f"{path}: found a mount point, which cannot be renamed, expected a folder in it")
    try:
        empty = not any(target.iterdir())
    except OSError as error:
        raise ConfigError(f"{path}: found a folder that cannot be read ({error.strerror})") from error
    if empty:
        return
    if not overwrite:
        raise ConfigError(f"{path}: found a folder that is not empty, expected none (or --overwrite)")
    _check_replaceable(path, target, kind)


def real_path(path: str | Path) -> Path:
    """The path behind symbolic links, so that what they name is replaced and not the link."""
    return Path(os.path.realpath(path))


def _check_reachable(path: str | Path, target: Path) -> None:
    """Refuse a target whose folder cannot be made or written, or that is too long a name."""
    folder = target.parent
    if os.path.islink(target):  # though links are resolved: it leads to itself
        raise ConfigError(f"{path}: found a loop of symbolic links, expected a name")
    try:
        os.lstat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be written ({getattr(error, 'strerror', error)})") from error
    while not os.path.lexists(folder):
        folder = folder.parent
    if not folder.is_dir():
        raise ConfigError(f"{path}: found a file {folder}, expected a folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: cannot be written, {folder} is read-only")


def _check_replaceable(path: str | Path, target: Path, kind: OutputKind) -> None:
    manifest = read_manifest(target)
    if manifest is None:
        raise ConfigError(
            f"{path}: found a folder without {MANIFEST} (not from sst-graph), expected one to overwrite"
        )
    if manifest.kind != kind.name:
        raise ConfigError(f"{path}: found a {manifest.kind}, expected a {kind.name} to overwrite")
    if kind.exclusive:
        strangers = [one for one in others(target, manifest) if one.split("/")[0] in kind.exclusive]
        if strangers:
            raise ConfigError(
                f"{path}: found {strangers[0]}, which is not as sst-graph wrote it, expected only its own "
                f"files in {', '.join(kind.exclusive)}: move it away"
            )
