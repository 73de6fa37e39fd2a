"""The exceptions of sst_graph: one root, a few kinds, each saying what was found and expected."""

from __future__ import annotations

from pathlib import Path


class SstGraphError(Exception):
    """Root of every error that sst_graph raises on purpose."""


class DataError(SstGraphError):
    """Input data that cannot be used: a file, an array or a value.

    The message is one line: place, what was found, what was expected.
    """

    def __init__(self, place: str | Path, found: str, expected: str) -> None:
        self.place = str(place)
        self.found = found
        self.expected = expected
        super().__init__(f"{self.place}: found {found}, expected {expected}")


class ConfigError(SstGraphError):
    """A configuration or command-line value that is unknown or out of its range."""


class EstimationError(SstGraphError):
    """An estimation step that could not be carried out (no match, indeterminate system)."""


class ContradictionError(EstimationError):
    """Estimates that are to be fused contradict one another beyond what their covariances allow."""


class MissingDependencyError(SstGraphError):
    """An optional dependency is not installed; the message names the extra to install."""
