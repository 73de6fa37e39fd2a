"""Files and folders that appear whole under their name; see the package for what is promised."""

from __future__ import annotations

import ctypes
import errno
import functools
import itertools
import os
import sys
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from sst_graph.errors import ConfigError
from sst_graph.files import staging
from sst_graph.files.manifest import OutputKind, carry_over, give_back, write_manifest
from sst_graph.files.staging import Stage, claim, uninterrupted
from sst_graph.files.targets import TEXT, OutputFileKind, check_file_target, check_folder_target, real_path

_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
"""Errors of a file system without hard links."""

_PATIENCE = 50
"""Steps that go by while the disk takes in what was written."""


def atomic_write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file whole or not at all; one that exists is replaced. Missing folders are made.

    Raises:
        OSError: the file cannot be written; what stood there is untouched.
    """
    target = real_path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with _locked_file(target) as (partial, stream):
        _write_through(stream, data)
        os.replace(partial, target)
        _sync_folder(target.parent)


def atomic_write_in_steps(path: str | Path, fill: Callable[[BinaryIO], Iterator[None]]) -> Generator[None]:
    """As :func:`atomic_write_bytes`, some with each step; the disk takes it in aside.

    While the disk has not taken it in, further steps do nothing, up to a number of them; then one waits. What
    is not done to its end (or closed on the way) leaves what stood there.

    Args:
        fill: writes all of it, some with each step.

    Raises:
        OSError: the file cannot be written; what stood there is untouched.
    """
    target = real_path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with _locked_file(target) as (partial, stream):
        with ThreadPoolExecutor(1) as aside:
            yield from fill(stream)
            stream.flush()
            flushed = aside.submit(os.fsync, stream.fileno())
            for _ in range(_PATIENCE):
                yield
                if flushed.done():
                    break
            flushed.result()
        os.replace(partial, target)
        _sync_folder(target.parent)


def atomic_write_text(path: str | Path, text: str) -> None:
    """As :func:`atomic_write_bytes`, for UTF-8 text."""
    atomic_write_bytes(path, text.encode("utf-8"))


@contextmanager
def atomic_directory(path: str | Path, overwrite: bool, kind: OutputKind) -> Iterator[Path]:
    """Folder that appears under ``path`` when the block ends well; yields the folder to write into.

    The name is taken on entry. If the block raises, nothing remains and what stood at ``path`` is
    untouched. Files of others in a folder that is replaced are carried over.

    Raises:
        ConfigError: as :func:`check_folder_target`; another run is writing it; or something appeared there
            meanwhile (what the block wrote then stands beside it, and the message says where).
        OSError: the folder cannot be made or written.
    """
    check_folder_target(path, overwrite, kind)
    target = real_path(path)
    with _claimed(path, target) as stage, _named(target, stage.new):
        stage.new.mkdir()
        yield stage.new
        write_manifest(stage.new, kind)
        _sync_tree(stage.new)
        with uninterrupted():
            _publish_folder(stage, path, overwrite, kind)


class OutputFile:
    """A file whose name is taken; each ``write`` puts all of it in place in one step."""

    def __init__(self, stage: Stage, path: str | Path, overwrite: bool) -> None:
        self._stage, self._path, self._overwrite = stage, path, overwrite

    def write_bytes(self, data: bytes) -> None:
        """Write all of it; what an earlier call wrote is replaced.

        Raises:
            ConfigError: another program put something there meanwhile; what was to be written stands beside
                it, and the message says where.
            OSError: it cannot be written; what stood there is untouched.
        """
        stage = self._stage
        with _named(stage.target, stage.new), uninterrupted():
            stage.new.unlink(missing_ok=True)
            with open(stage.new, "xb") as stream:
                _write_through(stream, data)
            self._publish()

    @property
    def partial(self) -> Path:
        """Where another program or library may write all of it, before :meth:`publish`."""
        return self._stage.new

    def publish(self) -> None:
        """Put what was written at :attr:`partial` in place; errors as of :meth:`write_bytes`."""
        with _named(self._stage.target, self._stage.new), uninterrupted():
            _sync(self._stage.new)
            self._publish()

    def _publish(self) -> None:
        stage = self._stage
        if self._overwrite:
            os.replace(stage.new, stage.target)
        elif not _link_free(stage.new, stage.target):
            raise _taken(self._path, _beside(stage, _link_free))
        stage.keep_parents = self._overwrite = True
        _sync_folder(stage.target.parent)

    def write_text(self, text: str) -> None:
        """As :meth:`write_bytes`, for UTF-8 text."""
        self.write_bytes(text.encode("utf-8"))


@contextmanager
def output_file(path: str | Path, overwrite: bool, kind: OutputFileKind = TEXT) -> Iterator[OutputFile]:
    """A file to be written in the block, whose name is taken on entry.

    Raises:
        ConfigError: as :func:`check_file_target`, or another run is writing it.
        OSError: its folder cannot be made or written.
    """
    check_file_target(path, overwrite, kind)
    target = real_path(path)
    with _claimed(path, target) as stage, _named(target, stage.new, nameless=False):
        yield OutputFile(stage, path, overwrite)


@contextmanager
def _claimed(path: str | Path, target: Path) -> Iterator[Stage]:
    try:
        stage = claim(target)
    except OSError as error:
        raise ConfigError(f"{path}: nothing can be made in {target.parent} ({error.strerror})") from error
    try:
        yield stage
    finally:
        stage.release()


@contextmanager
def _named(target: Path, partial: Path, nameless: bool = True) -> Iterator[None]:
    """Errors of writing that name the output, not where it stands while it is not finished.

    Args:
        nameless: whether those that name nothing are about it, too.
    """
    try:
        yield
    except OSError as error:
        name, hidden = error.filename, str(partial)
        if nameless and name is None and error.errno is not None:
            error.filename = str(target)
        elif isinstance(name, str) and name.startswith(hidden):
            error.filename, error.filename2 = str(target) + name[len(hidden) :], None
        raise


def _publish_folder(stage: Stage, path: str | Path, overwrite: bool, kind: OutputKind) -> None:
    """Give the new folder its name. A rename takes the place of nothing or of an empty folder only."""
    if not _rename_free(stage.new, stage.target):
        try:
            check_folder_target(path, overwrite, kind)
        except ConfigError:
            raise _taken(path, _beside(stage, _rename_free)) from None
        try:
            _replace_folder(stage)
        except OSError as error:
            place = _beside(stage, _rename_free)
            reason = f"cannot be replaced ({error.strerror})"
            raise ConfigError(f"{path}: {reason}; the output stands in {place}") from error
    stage.keep_parents = True
    _sync_folder(stage.target.parent)


def _replace_folder(stage: Stage) -> None:
    """Put the new folder in the place of the earlier one, with what others keep there."""
    carry_over(stage.target, stage.new)
    _sync_folder(stage.new)
    stage.announce_exchange()
    if _exchange(stage.new, stage.target):
        os.rename(stage.new, stage.former)
    else:
        os.rename(stage.target, stage.former)
        try:
            os.rename(stage.new, stage.target)
        except OSError:
            os.rename(stage.former, stage.target)
            raise
    give_back(stage.former, stage.target)
    os.rename(stage.former, stage.path / staging.DONE)


def _beside(stage: Stage, put: Callable[[Path, Path], bool]) -> Path:
    """Put finished work under the next free name beside its target."""
    stem, suffix = stage.target.stem, stage.target.suffix
    for number in itertools.count(2):
        place = stage.target.with_name(f"{stem}-{number}{suffix}")
        if not os.path.lexists(place) and put(stage.new, place):
            stage.keep_parents = True
            return place
    raise AssertionError("there is always a next number")


def _taken(path: str | Path, place: Path) -> ConfigError:
    return ConfigError(f"{path}: another program put something there meanwhile; the output stands in {place}")


def _rename_free(source: Path, target: Path) -> bool:
    """Rename a folder unless something stands at ``target``; an empty folder counts as nothing."""
    try:
        os.rename(source, target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR) and os.path.lexists(target):
            return False
        raise
    return True


def _link_free(source: Path, target: Path) -> bool:
    """Give a file its name unless something stands there."""
    try:
        os.link(source, target)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # Without hard links a file may be replaced that comes between check and rename, within microseconds.
        if os.path.lexists(target):
            return False
        os.rename(source, target)
    return True


@functools.cache
def _exchanger() -> Callable[[bytes, bytes], int] | None:
    """The operating system's exchange of two names, or None."""
    libc = ctypes.CDLL(None, use_errno=True)
    if sys.platform == "darwin" and hasattr(libc, "renamex_np"):
        swap = 2
        return lambda a, b: int(libc.renamex_np(a, b, swap))
    if hasattr(libc, "renameat2"):
        here, exchange = -100, 2
        return lambda a, b: int(libc.renameat2(here, a, here, b, exchange))
    return None


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two names in one step; whether the system and the file system can.

    Raises:
        OSError: they can, and it failed.
    """
    exchange = _exchanger()
    if exchange is None:
        return False
    if exchange(os.fsencode(a), os.fsencode(b)) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(b))


@contextmanager
def _locked_file(target: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """A new file beside ``target``, to be renamed in the block; it is locked until then, or removed.

    A run that sweeps the folder may take the file for abandoned before it is locked. Then another is made.
    """
    with ExitStack() as held:
        while True:
            partial = held.enter_context(staging.temporary(target))
            held.enter_context(_named(target, partial))
            stream = held.enter_context(open(partial, "xb"))
            if staging.lock_file(stream.fileno()) and partial.exists():
                break
        yield partial, stream


def _write_through(stream: BinaryIO, data: bytes) -> None:
    stream.write(data)
    stream.flush()
    os.fsync(stream.fileno())


def _sync_tree(folder: Path) -> None:
    """Flush all files and folders below, and the folder itself, to the disk."""
    for path, _, files in os.walk(folder):
        for name in files:
            one = os.path.join(path, name)
            if os.path.isfile(one) and not os.path.islink(one):
                _sync(one)
        _sync_folder(Path(path))


def _sync_folder(folder: Path) -> None:
    # Some file systems cannot flush a folder; the rename is then as durable as they make it.
    with suppress(OSError):
        _sync(folder)


def _sync(path: str | Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
