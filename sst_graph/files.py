"""Writing that is whole or does not happen: a killed process leaves no half-written output.

Everything is written under a hidden sibling name first (same file system), then renamed, which the
operating system does in one step. After a kill such a sibling (``.NAME.*.partial``) may remain; what
stands under the asked-for name is always complete.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sst_graph.errors import ConfigError


def atomic_write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file whole or not at all; one that exists is replaced. Missing folders are made.

    Raises:
        OSError: the file cannot be written; what stood there before is untouched.
    """
    target = _real(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = _sibling(target)
    try:
        with open(partial, "xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, target)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def atomic_write_text(path: str | Path, text: str) -> None:
    """As :func:`atomic_write_bytes`, for UTF-8 text."""
    atomic_write_bytes(path, text.encode("utf-8"))


def check_writable_target(path: str | Path, overwrite: bool, owned_by: str | None = None) -> None:
    """Refuse an output folder that must not be replaced; ask before long work begins.

    Args:
        path: the folder to be made. One that is absent or empty is always fine.
        overwrite: whether one that holds something may be replaced.
        owned_by: entry that such a folder must hold ("calibration.json"), so that nobody's home
            directory is replaced by mistake; None: any folder will do.

    Raises:
        ConfigError: the folder is a file, or holds something and may not be replaced.
    """
    target = _real(path)
    if not target.exists():
        return
    if not target.is_dir():
        raise ConfigError(f"{path}: found a file, expected a folder or nothing")
    if not any(target.iterdir()):
        return
    if not overwrite:
        raise ConfigError(f"{path}: found a folder that is not empty, expected none (or --overwrite)")
    if owned_by is not None and not (target / owned_by).exists():
        raise ConfigError(f"{path}: found a folder without {owned_by}, expected one to overwrite")


@contextmanager
def atomic_directory(
    path: str | Path, overwrite: bool = False, owned_by: str | None = None
) -> Iterator[Path]:
    """Folder that appears under ``path`` when the block ends well; yields the folder to write into.

    If the block raises, nothing remains and what stood at ``path`` is untouched. A folder that is
    replaced is put aside by one rename and the new one put in its place by the next; it is
    deleted only then.

    Raises:
        ConfigError: as :func:`check_writable_target`, on entry and again before the replacement.
        OSError: the folder cannot be made or written.
    """
    check_writable_target(path, overwrite, owned_by)
    target = _real(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = _sibling(target)
    partial.mkdir()
    try:
        yield partial
        check_writable_target(path, overwrite, owned_by)
        _put_in_place(partial, target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _put_in_place(partial: Path, target: Path) -> None:
    if not target.exists():
        os.rename(partial, target)
        return
    former = _sibling(target)
    os.rename(target, former)
    try:
        os.rename(partial, target)
    except BaseException:
        os.rename(former, target)
        raise
    with suppress(OSError):
        shutil.rmtree(former)


def _real(path: str | Path) -> Path:
    """The path behind symbolic links, so that the file is replaced and not the link."""
    return Path(os.path.realpath(path))


def _sibling(target: Path) -> Path:
    """A hidden name beside ``target`` that nobody else uses; permissions then follow the umask."""
    return target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")
