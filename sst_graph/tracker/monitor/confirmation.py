"""Confirmation: time since new frames agreed with the estimate that would have shown a change."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray

DETECTABLE_TURN_RAD = float(np.radians(0.25))
"""Frames confirm the estimate where a turn of the camera by this about its x or y axis would be past the
threshold; under the wide kernel a turn of 1 degree looks like this one [rad]."""
DETECTABLE_OFFSET_S = 0.01
"""Frames confirm the time offset where a jump of the clock by this would be past the threshold [s]."""
_SIGMAS, _MOST = 3.0, 2.0
"""Where an estimate is less sure, a step by so many standard deviations will do: its covariance covers less.
At most so many times the above: farther away, edges of pictures do not find their matches any more."""
_MAX_TURN_AGE_S = 1.0
"""An estimate is unconfirmed where the camera's orientation was not confirmed for longer [s]."""
_MAX_OFFSET_AGE_S = 3.0
"""An estimate is unconfirmed where the time offset was not confirmed for longer, in motion [s]; chosen on
streets 820 to 829 of ``studies/tracker_steps.py``."""


@dataclass
class Confirmation:
    """Time since the estimate was last confirmed.

    Attributes:
        turn_s: seconds since a frame last confirmed the camera's orientation.
        time_offset_s: seconds in motion since one last confirmed the time offset; at rest nothing can.
        unreliable: tracks of objects that contradicted the estimate until they were given up; they confirm
            nothing until others have: the estimate has followed them, whether they were right or not.
    """

    turn_s: float = 0.0
    time_offset_s: float = 0.0
    unreliable: set[int] = field(default_factory=set)

    def too_old_after(self, seconds: float) -> bool:
        """Whether the estimate is unconfirmed once so much more time has passed [s]."""
        return self.turn_s + seconds > _MAX_TURN_AGE_S or self.time_offset_s > _MAX_OFFSET_AGE_S

    def begin(self) -> None:
        """A start confirms everything."""
        self.turn_s = self.time_offset_s = 0.0
        self.unreliable.clear()

    def wait(self, seconds: float, moving: bool) -> None:
        """Let time pass."""
        self.turn_s += seconds
        self.time_offset_s += seconds if moving else 0.0

    def add(self, detectable: NDArray[np.bool_]) -> None:
        """The latest frames agree with the estimate and would have shown some of :func:`steps`."""
        if detectable[:2].all():
            self.turn_s = 0.0
            self.unreliable.clear()
        if detectable[2]:
            self.time_offset_s = 0.0


def detectable_steps(cTl: gtsam.Pose3, covariance: FloatArray) -> FloatArray:
    """(7, 3) the steps that must have been seen for an estimate with this (7, 7) covariance."""
    M = cTl.AdjointMap()
    variances = np.append(np.diag(M @ covariance[:6, :6] @ M.T)[:2], covariance[6, 6])
    least = np.array([DETECTABLE_TURN_RAD, DETECTABLE_TURN_RAD, DETECTABLE_OFFSET_S])
    sizes = np.clip(_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), least, _MOST * least)
    return np.asarray(steps(cTl, 1.0, 1.0) * sizes)


def steps(cTl: gtsam.Pose3, turn_rad: float, time_offset_s: float) -> FloatArray:
    """(7, 3) of extrinsic and time offset: turns of the camera about its x and its y axis, a clock's jump."""
    found = np.zeros((7, 3))
    # Exp(d_c) cTl = cTl Exp(Ad(cTl^-1) d_c).
    found[:6, :2] = cTl.inverse().AdjointMap()[:, :2] * turn_rad
    found[6, 2] = time_offset_s
    return found
