"""When new frames last confirmed the estimate: they agreed with it, and would have shown a step."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass
class Confirmation:
    """Since when nothing has confirmed the estimate.

    Attributes:
        turn_ns: stamp of the scan that last confirmed where the camera looks, or of the start's; None before.
        offset_ns: the same of the time offset.
        suspects: tracks of objects that raised a doubt which was given up; they confirm nothing until others
            have: the estimate has followed them, whether they were right or not.
    """

    turn_ns: int | None = None
    offset_ns: int | None = None
    suspects: set[int] = field(default_factory=set)

    def begin(self, stamp_ns: int) -> None:
        """A start confirms all."""
        self.turn_ns = self.offset_ns = stamp_ns
        self.suspects.clear()

    def take(self, stamp_ns: int, shown: NDArray[np.bool_]) -> None:
        """A scan agrees with the estimate and would have shown some of :func:`steps`."""
        if shown[:2].all():
            self.turn_ns = stamp_ns
            self.suspects.clear()
        if shown[2]:
            self.offset_ns = stamp_ns

    def ages_s(self, stamp_ns: int) -> tuple[float, float]:
        """Seconds since where the camera looks, and the time offset, were confirmed; 0 before a start."""
        since = (stamp_ns if then is None else then for then in (self.turn_ns, self.offset_ns))
        turn, offset = (max(0.0, 1e-9 * (stamp_ns - then)) for then in since)
        return turn, offset


def steps(cTl: gtsam.Pose3, turn_rad: float, offset_s: float) -> FloatArray:
    """(7, 3) of extrinsic and time offset: turns of the camera about its x and its y axis, a clock's jump."""
    found = np.zeros((7, 3))
    found[:6, :2] = cTl.inverse().AdjointMap()[:, :2] * turn_rad
    found[6, 2] = offset_s
    return found
