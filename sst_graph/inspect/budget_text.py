"""Where a result's sigmas come from: matches, motion, and assumptions, as a table."""

from __future__ import annotations

from typing import Any

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.covariance.considered import BUDGET, SHIFTS
from sst_graph.errors import printable
from sst_graph.files.checked_values import is_number
from sst_graph.inspect.considered import stored_assumptions
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

_PARTS_OF_EDGES = {
    "objects": "which objects there are",
    "positions": "positions between the beams",
    "shallow": "shallow upper edges",
    "farther_edges": "edges farther away",
    "floor": "floor",
}
"""Parts of a covariance by edges in words (docs/how-to/edges.md)."""
_LEAST_SHARE = 0.01
"""Assumptions and shifts that give less than this share of every variance are not shown."""


def budget_rows(result: CalibrationResult) -> list[tuple[str, str, str, str]]:
    """Name of each part, its largest sigma among the rotations [deg] and among the translations [cm], and
    that of the time offset [ms]; empty where the result has no parts."""
    total = np.diag(result.covariance)
    rows = []
    for name, sigmas in _parts(result).items():
        if name in (*ASSUMPTIONS, SHIFTS) and (sigmas**2 < _LEAST_SHARE * total).all():
            continue
        rotation, translation = np.degrees(sigmas[:3].max()), 100.0 * sigmas[3:6].max()
        label = printable(name) if name not in ASSUMPTIONS else _label(name, result)
        rows.append((label, f"{rotation:.3f} deg", f"{translation:.2f} cm", f"{1e3 * sigmas[6]:.2f} ms"))
    return rows


def budget_lines(result: CalibrationResult) -> list[str]:
    """:func:`budget_rows` as lines of text under a head."""
    rows = budget_rows(result)
    head = "where the sigmas come from (largest axis)     rotation  translation  time offset"
    lines = [f"  {label:<44}{turn:>11} {shift:>11} {offset:>12}" for label, turn, shift, offset in rows]
    return [head, *lines] if lines else []


def estimated_lines(result: CalibrationResult) -> list[str]:
    """The parameters of assumptions that were estimated with the calibration, with their sigmas."""
    stored = result.diagnostics.get("estimated")
    lines = []
    for name, entry in stored.items() if isinstance(stored, dict) else ():
        values = [entry.get(key) for key in ("value", "sigma")] if isinstance(entry, dict) else [None]
        if name in ASSUMPTIONS and all(is_number(v) for v in values):
            lines.append(ASSUMPTIONS[name].figure(*values))
    return lines


def _parts(result: CalibrationResult) -> dict[str, FloatArray]:
    """(7,) sigmas of each part; empty where the result has none."""
    stored = result.diagnostics.get(BUDGET)
    if not isinstance(stored, dict):
        stored = result.diagnostics.get("spread")
    if not isinstance(stored, dict):
        return {}
    parts: dict[str, FloatArray] = {}
    for name, sigmas in stored.items():
        if isinstance(sigmas, list) and len(sigmas) == 7 and all(_is_sigma(s) for s in sigmas):
            parts[_PARTS_OF_EDGES.get(str(name), str(name))] = np.array(sigmas, dtype=np.float64)
    return parts


def _is_sigma(value: Any) -> bool:
    return is_number(value) and value >= 0.0


def _label(name: str, result: CalibrationResult) -> str:
    """An assumption and the deviation of its parameter that was considered."""
    sigma = stored_assumptions(result).get(name, {}).get("sigma")
    if not _is_sigma(sigma):
        return name
    return f"{name} off by {sigma:.2g} {ASSUMPTIONS[name].unit}".rstrip()
