"""The staging folder beside an output: its lock, what a killed run left of one, and how a run ends early."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from sst_graph.errors import ConfigError, DataError
from sst_graph.files.manifest import give_back
from sst_graph.files.reading import FileKind, read_json, read_text

SUFFIX = ".sst-graph-partial"
"""Ends the name of everything that is not finished."""

OWNER = "owner.json"
"""Says which process a staging folder belongs to."""

NEW = "new"
FORMER = "former"
DONE = "done"
"""What is being written, what it replaces, and what was replaced, in a staging folder."""

EXCHANGE = "exchange"
"""Holds the inode number of the new folder from just before an exchange on: shows whether it took place."""

_NOTE = FileKind("a note in a staging folder", 4096)

_LONGEST_NAME = 180
"""Bytes of a name that are kept in the staging folder's; file systems allow 255 in all."""

_UNFINISHED = re.compile(rf"\.(.+)\.[0-9a-f]{{16}}{re.escape(SUFFIX)}", re.DOTALL)
"""Name of an unfinished file, or of a staging folder on its way, with that of its target."""

_ATTEMPTS = 20
"""Tries to take a name while others clean up there; each try fails only if another process made progress."""


@dataclass(eq=False)
class Stage:
    """A locked staging folder: the right to write one name.

    Attributes:
        target: the name, symbolic links resolved.
        path: the folder; ``path / NEW`` is to be written.
        lock: open descriptor that holds the lock.
        made: parent folders that were made for it, outermost first.
        keep_parents: whether they stay when the stage is released; set once something was published.
    """

    target: Path
    path: Path
    lock: int
    made: list[Path] = field(default_factory=list)
    keep_parents: bool = False

    @property
    def new(self) -> Path:
        """Where the new output is written."""
        return self.path / NEW

    @property
    def former(self) -> Path:
        """Where the replaced folder goes."""
        return self.path / FORMER

    def announce_exchange(self) -> None:
        """Note which folder is the new one, so that a later run can recognize it after a kill."""
        (self.path / EXCHANGE).write_text(str(self.new.stat().st_ino), encoding="ascii")

    def release(self) -> None:
        """Remove the folder and give up the name."""
        with uninterrupted():
            _stages.discard(self)
            remove(self.path)
            os.close(self.lock)
            if not self.keep_parents:
                _remove_parents(self.made)


_stages: set[Stage] = set()
_temporaries: set[Path] = set()
_depth = 0
_waiting: list[Callable[[], None]] = []


def claim(target: Path) -> Stage:
    """Take the right to write ``target`` (links resolved); what a killed run left there is removed.

    Raises:
        ConfigError: another process is writing it.
        OSError: its folder cannot be made or written.
    """
    with uninterrupted():
        made = _make_parents(target.parent)
        try:
            stage = _claimed(target, made)
        except BaseException:
            _remove_parents(made)
            raise
        _stages.add(stage)
        return stage


@contextmanager
def temporary(target: Path) -> Iterator[Path]:
    """A name beside ``target`` for one file; what is left of it when the block ends is removed."""
    path = _fresh_name(target)
    _temporaries.add(path)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
        _temporaries.discard(path)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Steps that belong together: what :func:`when_safe` is given runs after them."""
    global _depth
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        while _depth == 0 and _waiting:
            _waiting.pop(0)()


def when_safe(action: Callable[[], None]) -> None:
    """Run ``action`` at once, or at the end of :func:`uninterrupted` steps; for a signal's handler."""
    if _depth:
        _waiting.append(action)
    else:
        action()


def abandon_all() -> None:
    """Remove everything this process has not finished."""
    for stage in list(_stages):
        with suppress(OSError):
            stage.release()
    for path in list(_temporaries):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file or a folder with all it holds, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def lock_file(descriptor: int) -> bool:
    """Take the lock of an open file or folder; whether it was free. True where locks are not supported."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True


def _claimed(target: Path, made: list[Path]) -> Stage:
    sweep_folder(target.parent, _short(target))
    path = target.with_name(_staging_name(target))
    for _ in range(_ATTEMPTS):
        fresh = _fresh_name(target)
        lock = _locked_folder(fresh)
        if lock is None:
            continue
        try:
            # A rename replaces an empty folder, never one that names its owner.
            os.rename(fresh, path)
        except OSError as error:
            _give_up(fresh, lock)
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT, errno.ENOTDIR):
                raise
            _clear(path, target)
            continue
        return Stage(target, path, lock, made)
    raise ConfigError(f"{target}: other runs of sst-graph keep writing it, expected to be the only one")


def _locked_folder(path: Path) -> int | None:
    """Make a folder that names its owner, and lock it; None where another run, which sweeps, took it for
    abandoned before it was locked."""
    path.mkdir()
    lock = None
    try:
        with suppress(FileNotFoundError):
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        if lock is not None and lock_file(lock) and path.exists():
            owner = {"host": socket.gethostname(), "process": os.getpid()}
            (path / OWNER).write_text(json.dumps(owner), encoding="utf-8")
            return lock
    except BaseException:
        _give_up(path, lock)
        raise
    _give_up(path, lock)
    return None


def _give_up(path: Path, lock: int | None) -> None:
    remove(path)
    if lock is not None:
        os.close(lock)


def sweep_folder(folder: Path, short: str | None = None) -> None:
    """Remove what killed runs left unfinished in a folder of many files; what a living process writes stays.

    Args:
        short: of one target only, by its name as it is kept; None: of all.
    """
    with os.scandir(folder) as entries:
        found = [_UNFINISHED.fullmatch(entry.name) for entry in entries]
    for one in filter(None, found):
        if short in (None, one[1]):
            with suppress(OSError, ConfigError):
                _clear(folder / one[0], folder / one[1])


def _clear(path: Path, target: Path) -> None:
    """Remove a stage whose process is gone, and save what it holds of others.

    Raises:
        ConfigError: its process lives, or it is not a stage.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        if not _abandoned(descriptor, path):
            raise ConfigError(f"{target}: another run of sst-graph is writing it{_named_owner(path)}")
        with suppress(FileNotFoundError):
            if not os.path.samestat(os.fstat(descriptor), os.stat(path, follow_symlinks=False)):
                return
            _save_former(path, target)
            doomed = _fresh_name(target)
            os.rename(path, doomed)
            remove(doomed)
    finally:
        os.close(descriptor)


def _abandoned(descriptor: int, path: Path) -> bool:
    """Whether nobody holds the lock; without locks, whether the process named as owner is gone."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
    owner = _owner(path)
    process = owner.get("process")
    if owner.get("host") != socket.gethostname() or not isinstance(process, int):
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _save_former(path: Path, target: Path) -> None:
    """What a run killed while it replaced a folder left behind: the folder itself, or notes in it."""
    if not stat.S_ISDIR(os.stat(path, follow_symlinks=False).st_mode):
        return
    former = path / FORMER
    if former.is_dir() and (path / NEW).is_dir() and not os.path.lexists(target):
        os.rename(former, target)
    left = path / NEW if _exchanged(path, target) else former
    if left.is_dir() and target.is_dir():
        give_back(left, target)


def _exchanged(path: Path, target: Path) -> bool:
    """Whether the new folder has its name, and the former one still the name of the new."""
    try:
        return int(read_text(path / EXCHANGE, _NOTE)) == target.stat().st_ino
    except (OSError, ValueError, DataError):
        return False


def _owner(path: Path) -> dict[str, object]:
    try:
        owner = read_json(path / OWNER, _NOTE)
    except DataError:
        return {}
    return owner if isinstance(owner, dict) else {}


def _named_owner(path: Path) -> str:
    process = _owner(path).get("process")
    return f" (process {process}), expected to be the only one" if isinstance(process, int) else ""


def _make_parents(folder: Path) -> list[Path]:
    """Make missing folders down to ``folder``; those that were made, outermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    made: list[Path] = []
    try:
        for one in reversed(missing):
            with suppress(FileExistsError):
                one.mkdir()
                made.append(one)
    except OSError:
        _remove_parents(made)
        raise
    return made


def _remove_parents(made: list[Path]) -> None:
    with suppress(OSError):
        for folder in reversed(made):
            folder.rmdir()


def _staging_name(target: Path) -> str:
    return f".{_short(target)}{SUFFIX}"


def _fresh_name(target: Path) -> Path:
    return target.with_name(f".{_short(target)}.{secrets.token_hex(8)}{SUFFIX}")


def _short(target: Path) -> str:
    """The target's name, or a digest where it is too long to be extended."""
    name = os.fsencode(target.name)
    return target.name if len(name) <= _LONGEST_NAME else hashlib.sha256(name).hexdigest()[:32]
