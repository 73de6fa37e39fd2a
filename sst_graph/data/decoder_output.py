"""What image decoders print: libpng, libjpeg and OpenCV write to the process's stderr, not to Python.

These lines report damage that the decoder itself ignores (half a JPEG becomes a grey half), and they must not
appear among our own messages. So they are captured while a picture is decoded.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_STDERR = 2

_PREFIXES = (
    "libpng",
    "Corrupt JPEG",
    "Premature end of JPEG",
    "Unsupported",
    "Invalid",
    "Inconsistent progression",
    "Unknown Adobe",
    "Warning: ",
    "Application transferred",
    "Bogus",
    "[ WARN",
    "[ERROR",
    "[ INFO",
    # OpenCV's checks: several lines for one that fails
    "> ",
    "where",
    "must be ",
    "    '",
    "OpenCV(",
)
"""How the decoders' lines begin."""

_lock = threading.RLock()
if hasattr(os, "register_at_fork"):
    # No fork while a thread decodes: the child would wait for a lock that nobody opens, and have no stderr.
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)


@contextmanager
def decoder_output() -> Iterator[list[str]]:
    """Lines that decoders print within the block; the list is filled at its end.

    Other lines, which another thread wrote meanwhile, are passed on to stderr. A process without stderr
    gives none.
    """
    lines: list[str] = []
    with _lock:
        try:
            stderr = os.dup(_STDERR)
        except OSError:  # closed
            yield lines
            return
        reading, writing = os.pipe()
        try:
            # a pipe that is full drops what is written, and does not block
            os.set_blocking(reading, False)
            os.set_blocking(writing, False)
            os.dup2(writing, _STDERR)
            try:
                yield lines
            finally:
                os.dup2(stderr, _STDERR)
                lines += _sorted_out(_everything(reading), stderr)
        finally:
            for descriptor in (stderr, reading, writing):
                os.close(descriptor)


def _everything(descriptor: int) -> str:
    parts = []
    with suppress(BlockingIOError):
        while part := os.read(descriptor, 1 << 16):
            parts.append(part)
    return b"".join(parts).decode(errors="replace")


def _sorted_out(text: str, stderr: int) -> list[str]:
    """The decoders' lines; the others are written to ``stderr``."""
    lines = [line for line in text.splitlines() if line]
    others = "".join(f"{line}\n" for line in lines if not line.startswith(_PREFIXES))
    if others:
        os.write(stderr, others.encode())
    return [line for line in lines if line.startswith(_PREFIXES)]
