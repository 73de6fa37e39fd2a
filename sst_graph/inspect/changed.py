"""Whether a result holds the calibration that its figures were made for, or one that was changed since."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_graph.errors import DataError
from sst_graph.factors.errors import FactorError
from sst_graph.files.checked_values import checked_pose
from sst_graph.fit import QUALITY
from sst_graph.metrics import quaternion_angle_deg
from sst_graph.result import CalibrationResult
from sst_graph.types import Calibration

_LEAST_DEG, _LEAST_CM, _LEAST_MS = 5e-3, 5e-2, 5e-2
"""Smaller changes are not seen in what is printed, and those of a file whose numbers were rounded to four
decimals."""


@dataclass(frozen=True)
class Change:
    """From the estimate to the calibration that the result holds.

    Attributes:
        rotation_deg: angle between the two [deg].
        translation_cm: distance between the origins of the LiDAR [cm].
        time_offset_ms: later minus earlier time offset [ms].
    """

    rotation_deg: float
    translation_cm: float
    time_offset_ms: float

    @property
    def words(self) -> str:
        """The three figures."""
        turned, moved = f"{self.rotation_deg:.2f}°", f"{self.translation_cm:.1f} cm"
        return f"{turned}, {moved} and {self.time_offset_ms:+.1f} ms from it"


def change_of(result: CalibrationResult) -> Change | None:
    """How far the result's calibration is from the one that its ``fit_quality`` was measured at.

    None where it is the same, or where the file does not say at which.
    """
    entry = result.diagnostics.get(QUALITY)
    at = _calibration(entry.get("at")) if isinstance(entry, Mapping) else None
    if at is None:
        return None
    now = result.T_camera_lidar
    moved = now.translation() - at.cTl.translation()
    change = Change(
        quaternion_angle_deg(now.rotation(), at.cTl.rotation()),
        100.0 * float(np.linalg.norm(moved)),
        1e3 * (result.time_offset_s - at.time_offset_s),
    )
    same = change.rotation_deg < _LEAST_DEG and change.translation_cm < _LEAST_CM
    return None if same and abs(change.time_offset_ms) < _LEAST_MS else change


def _calibration(entry: Any) -> Calibration | None:
    """The calibration in an entry of a file; None where it cannot be read."""
    if not isinstance(entry, Mapping):
        return None
    try:
        matrix = np.asarray(entry.get("T_camera_lidar"), np.float64)
        return Calibration(checked_pose(matrix, QUALITY), float(entry["time_offset_s"]))
    except (DataError, FactorError, KeyError, TypeError, ValueError):
        return None
