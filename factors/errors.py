"""The exceptions of the package, the root of sst_graph's, and what their messages may hold."""

from __future__ import annotations

MAX_MESSAGE = 1200
"""Characters of a message; what is longer loses its middle."""


def printable(text: object, limit: int = MAX_MESSAGE) -> str:
    """``text`` as a message may contain it: no control character, and at most ``limit`` characters.

    Line breaks, escape sequences, direction marks and lone surrogates appear as in a Python literal
    (``\\n``, ``\\x1b``), so that no file's content reaches a terminal as anything but text. What is too
    long loses its middle.
    """
    shown = _shortened(str(text), limit)
    if not shown.isprintable():
        escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in shown)
        shown = "".join(escaped)
    return _shortened(shown, limit)


def count_of(count: int, one: str, several: str | None = None) -> str:
    """``1 pair``, ``0 pairs``, ``2 pairs``.

    Args:
        one: the noun of one.
        several: that of several, where it is not ``one`` with an s.
    """
    return f"{count} {one if count == 1 else several or one + 's'}"


def _shortened(text: str, limit: int) -> str:
    if len(text) <= limit:
        return text
    gap = " ... "
    tail = (limit - len(gap)) // 3
    return text[: limit - len(gap) - tail] + gap + text[-tail:]


class SstGraphError(Exception):
    """Root of every error that sst_graph and factors raise on purpose.

    The message is one line without control characters; line breaks in it become spaces.
    """

    def __init__(self, message: object = "") -> None:
        text = _shortened(str(message), 4 * MAX_MESSAGE)
        super().__init__(printable(" ".join(text.split())))


class FactorError(SstGraphError, ValueError):
    """A value that a factor cannot use: what it is, what was found, what was expected."""

    def __init__(self, what: str, found: str, expected: str) -> None:
        self.what = what
        self.found = found
        self.expected = expected
        super().__init__(f"{what}: found {found}, expected {expected}")

    def __reduce__(self) -> tuple[type[FactorError], tuple[str, str, str]]:
        return FactorError, (self.what, self.found, self.expected)
