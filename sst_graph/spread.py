"""How far values spread, whatever a few of them are."""

from __future__ import annotations

import numpy as np

from sst_graph.types import FloatArray

_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution by its median absolute deviation."""


def robust_sigma(errors: FloatArray) -> float:
    """Standard deviation of errors (n,) about zero, by their median size; 0 of none."""
    return _OF_MEDIAN * float(np.median(np.abs(errors))) if len(errors) else 0.0


def robust_spread(values: FloatArray) -> float:
    """Standard deviation of values (n,) about their median, by the median absolute deviation."""
    return robust_sigma(values - np.median(values))
