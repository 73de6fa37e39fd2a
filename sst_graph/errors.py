"""The exceptions of sst_graph: one root, a few kinds, each saying what was found and expected."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sst_graph.factors.errors import SstGraphError, count_of, printable

__all__ = [
    "CheckpointError",
    "ConfigError",
    "DataError",
    "EstimationError",
    "MissingDependencyError",
    "SstGraphError",
    "count_of",
    "first_line",
    "in_file",
    "one_line",
    "optional_module",
    "printable",
]

_MAX_PART = 390
"""Characters of the place, of what was found and of what was expected: together they fit into a message."""


class DataError(SstGraphError):
    """Input data that cannot be used: a file, an array or a value.

    The message is one line: place, what was found, what was expected, each made :func:`printable`.
    """

    def __init__(self, place: str | Path, found: str, expected: str) -> None:
        self.place = printable(place, _MAX_PART)
        self.found = printable(found, _MAX_PART)
        self.expected = printable(expected, _MAX_PART)
        super().__init__(f"{self.place}: found {self.found}, expected {self.expected}")

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str, str]]:
        return type(self), (self.place, self.found, self.expected)


@contextmanager
def in_file(file: str | Path) -> Iterator[None]:
    """Name ``file`` before the place of a :class:`DataError` that does not name it."""
    try:
        yield
    except DataError as error:
        name = printable(file, _MAX_PART)
        if error.place.startswith(name) and error.place[len(name) : len(name) + 1] in ("", ":", ",", " "):
            raise
        raise type(error)(f"{file}: {error.place}", error.found, error.expected) from error


class CheckpointError(DataError):
    """A checkpoint that cannot be read back: damaged, changed, or of another version."""


class ConfigError(SstGraphError, ValueError):
    """A configuration or command-line value that is unknown or out of its range."""


class EstimationError(SstGraphError):
    """An estimation step that could not be carried out (no match, indeterminate system)."""


class ContradictionError(EstimationError):
    """Estimates that are to be fused contradict one another beyond what their covariances allow."""


class MissingDependencyError(SstGraphError):
    """An optional dependency is not installed; the message names the extra to install."""


def optional_module(name: str, without: str, extra: str) -> Any:
    """A module of an optional dependency.

    Args:
        without: that it is not installed, in a sentence.
        extra: of this package, which brings it.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f"{without}: pip install 'sst-graph[{extra}]'") from error


def one_line(error: BaseException) -> str:
    """What an exception says, on one line; the name of its class where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


def first_line(error: BaseException) -> str:
    """The first line of what an exception says; the name of its class where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]
