"""What a result's covariance holds of its assumptions, as stored under ``diagnostics.assumptions``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sst_graph.files.checked_values import is_number
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

ASSUMPTIONS_KEY = "assumptions"
"""Key in the diagnostics of a result."""


def stored_assumptions(result: CalibrationResult) -> dict[str, Mapping[str, Any]]:
    """The entry of each assumption, by name; empty where the result has none."""
    stored = result.diagnostics.get(ASSUMPTIONS_KEY)
    entries = stored.items() if isinstance(stored, Mapping) else ()
    return {str(name): entry for name, entry in entries if isinstance(entry, Mapping)}


def considered_errors(result: CalibrationResult) -> dict[str, tuple[float, FloatArray]]:
    """Deviation of each assumption that was considered, and the estimate's sensitivity (7,) to it, by name.

    What a file holds in the place of these numbers is passed over.
    """
    found = {}
    for name, entry in stored_assumptions(result).items():
        sigma, sensitivity = entry.get("sigma"), entry.get("sensitivity")
        numbers = [sigma, *sensitivity] if isinstance(sensitivity, list) else []
        if len(numbers) == 8 and all(map(is_number, numbers)):
            found[name] = float(numbers[0]), np.array(numbers[1:], np.float64)
    return found


def covered_errors(result: CalibrationResult) -> dict[str, float]:
    """Estimate of each parameter that is off while its step is in the covariance, by name, in its unit.

    By edges a lens that the data contradict is a reason against the result only where the estimate moves
    farther than it is known with the lens free; else that step is added to the covariance.
    """
    if result.method != "edges" or result.status == "not_converged":
        return {}
    entries = stored_assumptions(result).items()
    off = {name: entry.get("estimate") for name, entry in entries if entry.get("contradicted") is True}
    return {name: float(value) for name, value in off.items() if is_number(value)}
