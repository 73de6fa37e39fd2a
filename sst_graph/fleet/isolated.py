"""One command in a process of its own, under limits: whatever happens to it happens to it alone."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sst_graph.config import Settings, setting

GUARD = Path(__file__).with_name("guard.py")
_KERNEL_COUNTS = "/proc/vmstat"
_LOG_BYTES, _LOG_LINES = 64 * 1024, 30
_FIRST_LOOK_S, _LONGEST_PAUSE_S = 0.01, 0.1
_GRACE_S = 5.0
"""Time to remove unfinished outputs after SIGTERM."""

_running: set[int] = set()
_ended = threading.Event()


@dataclass(frozen=True)
class Limits(Settings):
    """What one attempt may take.

    Attributes:
        wall_s: time; None: no limit [s].
        memory_bytes: resident memory; None: no limit.
    """

    wall_s: float | None = setting(None, more_than=0.0, at_most=1e9)
    memory_bytes: int | None = setting(None, at_least=1, at_most=2**60)


@dataclass(frozen=True)
class Ending:
    """How a process ended.

    Attributes:
        code: its exit code; negative: the signal that ended it.
        limit: which limit ended it: "memory", "time" or "".
        wall_s, cpu_s: what it took [s].
        peak_bytes: its largest resident memory.
        log: last lines of its stderr.
        short_of_memory: whether the kernel ended processes for want of memory meanwhile (Linux).
    """

    code: int
    limit: str
    wall_s: float
    cpu_s: float
    peak_bytes: int
    log: tuple[str, ...]
    short_of_memory: bool = False

    @property
    def from_outside(self) -> bool:
        """Whether something else ended it: an operator, a machine that is taken away, the kernel.

        A process that heeds a signal ends with 128 and its number.
        """
        return not self.limit and (-self.code in _OF_OTHERS or self.code - 128 in _HEEDED)

    @property
    def words(self) -> str:
        """The code for people."""
        if self.code >= 0 and not self.from_outside:
            return f"exit code {self.code}"
        try:
            return signal.Signals(self.code - 128 if self.code > 0 else -self.code).name
        except ValueError:
            return f"signal {-self.code}"


_HEEDED = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_OF_OTHERS = (signal.SIGKILL, *_HEEDED)
"""Signals that a process gets from others; what goes wrong in it ends it by SIGSEGV, SIGABRT and the like."""


def run_isolated(
    command: Sequence[str], environment: Mapping[str, str], limits: Limits, folder: str
) -> Ending:
    """Run a command to its end or to a limit.

    Args:
        command: program and arguments.
        environment: all of its variables.
        folder: where it is run.

    Raises:
        OSError: no process can be started.
    """
    guarded = [sys.executable, "-I", "-S", str(GUARD), str(os.getpid()), *command]
    with tempfile.TemporaryFile() as log:
        started, killed_before = time.monotonic(), _killed_for_memory()
        process = subprocess.Popen(
            guarded,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=log,
            env=dict(environment),
            cwd=folder,
            start_new_session=True,  # a Ctrl-C is the batch's to pass on
        )
        _running.add(process.pid)
        try:
            limit, peak, code, cpu_s = _watched(process.pid, started, limits)
        finally:
            _running.discard(process.pid)
        process.returncode = code
        wall_s, said = time.monotonic() - started, _tail(log.fileno())
        return Ending(code, limit, wall_s, cpu_s, peak, said, _killed_for_memory() > killed_before)


def end_all() -> None:
    """End every process that this one runs: gently, then by force. No other is started afterwards."""
    _ended.set()
    deadline = time.monotonic() + _GRACE_S
    for number in (signal.SIGTERM, signal.SIGKILL):
        for pid in list(_running):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        while _running and number == signal.SIGTERM and time.monotonic() < deadline:
            time.sleep(_FIRST_LOOK_S)


def has_ended() -> bool:
    """Whether :func:`end_all` was called."""
    return _ended.is_set()


def _watched(pid: int, started: float, limits: Limits) -> tuple[str, int, int, float]:
    """The limit that ended it, its peak memory, its code and its processor time."""
    limit, peak, asked_at = "", 0, 0.0
    for pause in _pauses():
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return limit, peak, os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        peak = max(peak, resident_bytes(pid))
        now = time.monotonic()
        if limits.memory_bytes is not None and peak > limits.memory_bytes:
            limit = limit or "memory"
            os.kill(pid, signal.SIGKILL)  # there is no memory for a grace
        elif limits.wall_s is not None and now - started > limits.wall_s:
            if not limit:
                limit, asked_at = "time", now
                os.kill(pid, signal.SIGTERM)
            elif now - asked_at > _GRACE_S:
                os.kill(pid, signal.SIGKILL)
        time.sleep(pause)
    raise AssertionError("pauses do not end")


def _pauses() -> Iterator[float]:
    pause = _FIRST_LOOK_S
    while True:
        yield pause
        pause = min(1.5 * pause, _LONGEST_PAUSE_S)


def resident_bytes(pid: int) -> int:
    """Largest resident memory of a process so far; the present one where the system does not keep it.

    0 where neither is known.
    """
    try:
        with open(f"/proc/{pid}/status", "rb") as stream:
            for line in stream:
                if line.startswith(b"VmHWM:"):
                    return 1024 * int(line.split()[1])
        return 0  # it has ended, and is waited for
    except (OSError, ValueError):
        pass
    if sys.platform == "linux":
        return 0
    done = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return 1024 * int(done.stdout) if done.stdout.strip().isdigit() else 0


def _killed_for_memory() -> int:
    """How many processes the kernel has ended for want of memory, on the whole machine; 0 if not known."""
    try:
        with open(_KERNEL_COUNTS, "rb") as stream:
            return next((int(line.split()[1]) for line in stream if line.startswith(b"oom_kill ")), 0)
    except (OSError, ValueError):
        return 0


def _tail(descriptor: int) -> tuple[str, ...]:
    size = os.lseek(descriptor, 0, os.SEEK_END)
    os.lseek(descriptor, max(0, size - _LOG_BYTES), os.SEEK_SET)
    text = os.read(descriptor, _LOG_BYTES).decode("utf-8", "replace")
    return tuple(text.splitlines()[-_LOG_LINES:])
