"""What a command says: results on stdout, remarks on stderr, and what it means where that fails."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TextIO

from sst_graph.factors.errors import printable

_LONGEST_REMARK = 4800
"""Characters of a remark on stderr."""


class StreamError(Exception):
    """stdout does not take what was written to it.

    Attributes:
        reader_gone: it is a pipe that nobody reads from any more.
    """

    def __init__(self, error: OSError) -> None:
        self.reader_gone = error.errno == errno.EPIPE
        super().__init__(f"stdout: {error.strerror or error}")


def say(text: str, end: str = "\n") -> None:
    """Print what the command was called for.

    Raises:
        StreamError: it could not be written, so the command has failed.
    """
    try:
        sys.stdout.write(_shown(text + end, sys.stdout))
        sys.stdout.flush()
    except OSError as error:
        raise StreamError(error) from None


@dataclass
class Loudness:
    """What is said beside results, warnings and errors, in this process.

    Attributes:
        quiet: neither progress nor what :func:`mention` is given.
        lines: progress in plain lines where stderr is no terminal.
        began_s: when the command began, by :func:`time.monotonic`, in a process of its own [s].
    """

    quiet: bool = False
    lines: bool = False
    began_s: float | None = None


loudness = Loudness()
"""Set when a command begins."""


def mention(text: str) -> None:
    """Print what was done, where the results are in files: a failure to print is no error."""
    if loudness.quiet:
        return
    try:
        say(text)
    except StreamError as error:
        _discard_stdout()
        if not error.reader_gone:
            complain(f"warning: {error}: the outputs are complete, but could not be listed")


def _shown(text: str, stream: TextIO) -> str:
    """The text with what the stream's encoding has not escaped."""
    encoding = stream.encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def _discard_stdout() -> None:
    """Let what cannot be written to stdout, and all that follows, vanish."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.stdout.flush()


def complain(text: str) -> None:
    """One printable line on stderr, whatever the text holds."""
    _on_stderr("sst-graph: " + printable(" ".join(text.split()), _LONGEST_REMARK) + "\n")


def _on_stderr(text: str) -> None:
    # Where nobody reads it, the exit code still says it.
    with suppress(OSError, ValueError):
        sys.stderr.write(_shown(text, sys.stderr))
        sys.stderr.flush()


@contextmanager
def loading(command: str) -> Iterator[None]:
    """Words in a terminal's line while a command's modules are loaded: seconds on a busy machine."""
    shown = loudness.lines and not loudness.quiet and sys.stderr.isatty()
    words = f"sst-graph {command}: loading"
    if shown:
        _on_stderr(words)
    try:
        yield
    finally:
        if shown:
            _on_stderr(f"\r{' ' * len(words)}\r")


def flush() -> None:
    """Write out what is printed.

    Raises:
        StreamError: it could not be.
    """
    try:
        sys.stdout.flush()
    except OSError as error:
        raise StreamError(error) from None
