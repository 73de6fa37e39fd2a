"""When new frames last confirmed the estimate: they agreed with it, and would have shown a step."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass
class Confirmation:
    """For how long nothing has confirmed the estimate.

    Attributes:
        turn_s: seconds since a frame last confirmed where the camera looks.
        offset_s: seconds in motion since one last confirmed the time offset; at rest nothing can.
        suspects: tracks of objects that raised a doubt which was given up; they confirm nothing until others
            have: the estimate has followed them, whether they were right or not.
    """

    turn_s: float = 0.0
    offset_s: float = 0.0
    suspects: set[int] = field(default_factory=set)

    def begin(self) -> None:
        """A start confirms all."""
        self.turn_s = self.offset_s = 0.0
        self.suspects.clear()

    def wait(self, seconds: float, moving: bool) -> None:
        """Time passes."""
        self.turn_s += seconds
        self.offset_s += seconds if moving else 0.0

    def take(self, shown: NDArray[np.bool_]) -> None:
        """The latest frames agree with the estimate and would have shown some of :func:`steps`."""
        if shown[:2].all():
            self.turn_s = 0.0
            self.suspects.clear()
        if shown[2]:
            self.offset_s = 0.0


def steps(cTl: gtsam.Pose3, turn_rad: float, offset_s: float) -> FloatArray:
    """(7, 3) of extrinsic and time offset: turns of the camera about its x and its y axis, a clock's jump."""
    found = np.zeros((7, 3))
    found[:6, :2] = camera_turns(cTl) * turn_rad
    found[6, 2] = offset_s
    return found


def camera_turns(cTl: gtsam.Pose3) -> FloatArray:
    """(6, 2) tangents of the extrinsic for turns of the camera by 1 rad about its own x and y axis.

    Exp(d_c) cTl = cTl Exp(Ad(cTl^-1) d_c).
    """
    return np.asarray(cTl.inverse().AdjointMap()[:, :2])
