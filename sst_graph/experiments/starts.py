"""The truth of a drive, and wrong starts around it."""

from __future__ import annotations

import gtsam
import numpy as np

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
