"""The truth of a drive, wrong starts around it, and errors against it."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import ConfigError
from sst_graph.types import GroundTruth, Source


def truth_of(source: Source) -> GroundTruth:
    """The reference calibration of a drive.

    Raises:
        ConfigError: it brings none.
    """
    if source.truth is None:
        raise ConfigError(f"{source.name}: found no reference calibration, expected one")
    return source.truth


def start_near(cTl: gtsam.Pose3, half_deg: float, half_m: float, rng: np.random.Generator) -> gtsam.Pose3:
    """The extrinsic with an error uniform by axis within half widths [deg], [m], in its tangent space."""
    turn = np.radians(half_deg) * rng.uniform(-1.0, 1.0, 3)
    return cTl.retract(np.concatenate([turn, half_m * rng.uniform(-1.0, 1.0, 3)]))


def error_of(cTl: gtsam.Pose3, time_offset_s: float, truth: GroundTruth) -> NDArray[np.float64]:
    """(7,) truth less estimate in the estimate's tangent space [rad, m, s]; an unknown true offset is 0."""
    return np.append(gtsam.Pose3.Logmap(cTl.between(truth.cTl)), (truth.time_offset_s or 0.0) - time_offset_s)
