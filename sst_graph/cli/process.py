"""What a command does to its process: signals, streams, threads of the linear algebra.

Imports built-in modules only until the signals have their handler.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType, TracebackType

    Handler = Callable[[int, FrameType | None], None] | signal.Handlers

_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "BLIS_NUM_THREADS")
"""Sums over more threads are rounded otherwise: the same input must give the same bytes."""


class own_process:
    """For a process that runs one command; yields its arguments. (contextlib would take milliseconds.)

    From the start on SIGINT, SIGTERM and SIGHUP end the process: unfinished outputs are removed, one line
    is written, the exit code is 128 + the signal's number. At the end they are ignored: what is left is
    the interpreter's own shutdown, and the exit code stands.
    """

    def __enter__(self) -> list[str]:
        _on_signals(_end)
        _open_missing_streams()
        for name in _THREADS:
            os.environ[name] = "1"
        return sys.argv[1:]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _on_signals(signal.SIG_IGN)
        _silence_broken_streams()


def _on_signals(handler: Handler) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # A signal that is ignored from outside stays so (nohup, jobs in the background).
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _end(number: int, frame: FrameType | None) -> None:
    """End the process, at once or as soon as a step that must be whole is done."""
    _on_signals(signal.SIG_IGN)

    def end() -> None:
        try:
            _of_files("abandon_all")()
            word = "interrupted" if number == signal.SIGINT else "terminated"
            # A bar of progress may stand in the terminal's line.
            start = "\n" if os.isatty(2) else ""
            os.write(2, f"{start}sst-graph: error: {word}\n".encode())
        finally:
            os._exit(128 + number)

    _of_files("when_safe", otherwise=end)(end)


def _of_files(name: str, otherwise: Callable[[], None] | None = None) -> Callable[..., None]:
    """A function of :mod:`sst_graph.files` if it has been imported, else one that does the other."""
    found = getattr(sys.modules.get("sst_graph.files"), name, None)
    return found if callable(found) else lambda *_: None if otherwise is None else otherwise()


def _open_missing_streams() -> None:
    """Open what was closed: no output file may get the number of a standard stream.

    What is written to a closed stdout fails, as to a full disk; what is written to a closed stderr is lost.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # Names that are not UTF-8, or not of the terminal's encoding, are shown escaped.
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _silence_broken_streams() -> None:
    """Let the interpreter's last flush succeed, so that it does not change the exit code."""
    for stream, number in ((sys.stdout, 1), (sys.stderr, 2)):
        try:
            stream.flush()
        except (OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
