"""Do new frames meet the pictures better where the camera is turned? Else edges would hide a large turn.

Edges meet some edge of a picture at any pose. After a turn of the camera by more than the kernel reaches, the
gradient at the estimate is that of chance matches, and no statistic of it shows the turn. The cost of all
boundary points does: it is least at the estimate, and after the turn at another pose.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np

from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import FloatArray

_FRAMES = 8
"""Held-out frames in a row that must meet the pictures better at a turned pose."""
_SUSPECTED = 2
"""Held-out frames in a row after which the estimate counts as not confirmed."""
_LEAST_USUAL_FRAMES, _USUAL_FRAMES = 10, 300
"""Least and most frames that say how much worse a turned pose usually is."""
_FEW = 0.2
"""Part of the frames in which the estimate may be the worse one: in more, costs show nothing."""
_SHARE = 0.5
"""A turned pose must be better by this part of what it usually is worse by."""
_TURNS_RAD = np.radians([0.5, 1.0])
"""Turns about the camera's x and y axis, both ways; the wide kernel reaches from each to the next [rad]."""
_AXES = np.array([s * turn * axis for turn in _TURNS_RAD for axis in np.eye(3)[:2] for s in (1.0, -1.0)])
"""(8, 3) rotation vectors of these turns [rad]."""


def turned(point: Point, rotation: FloatArray) -> Point:
    """The point with the camera turned by a rotation vector (3,) [rad]."""
    return replace(point, cTl=gtsam.Pose3(gtsam.Rot3.Expmap(rotation), np.zeros(3)) * point.cTl)


class TurnedPoses:
    """Costs of held-out frames at the estimate and at poses turned from it.

    Attributes:
        gains: (k,) of the latest frames: cost at the estimate less that at each turned pose.
        usual: by how much the turned poses were worse on average, frame by frame.
    """

    def __init__(self) -> None:
        self.gains: deque[FloatArray] = deque(maxlen=_FRAMES)
        self.usual: deque[float] = deque(maxlen=_USUAL_FRAMES)

    def restart(self) -> None:
        """Another estimate begins."""
        self.gains.clear()
        self.usual.clear()

    def add(self, cost: Callable[[Point], float | None], point: Point) -> None:
        """Compare the estimate with turned poses on new frames, before these are used.

        Args:
            cost: of the frames at a point; None where no boundary point is in view.
            point: the estimate before them.
        """
        own, others = cost(point), [cost(turned(point, axis)) for axis in _AXES]
        known = [other for other in others if other is not None]
        if own is None or len(known) < len(others):
            return
        gains = own - np.array(known)
        self.gains.append(gains)
        self.usual.append(float(-gains.mean()))

    def better(self, point: Point) -> Point | None:
        """The turned pose that the latest frames agree with instead of the estimate; None where none is."""
        place = self._place(_FRAMES)
        return None if place is None else turned(point, _AXES[place])

    @property
    def contradicted(self) -> bool:
        """Whether the last few frames agree with a turned pose, though that may be by chance."""
        return self._place(_SUSPECTED) is not None

    def _place(self, frames: int) -> int | None:
        """Place of the turned pose that so many frames in a row agree with."""
        if len(self.gains) < frames or len(self.usual) < _LEAST_USUAL_FRAMES:
            return None
        low, usual = np.quantile(self.usual, [_FEW, 0.5])
        gains = np.array(self.gains)[-frames:]
        means = np.where((gains > 0.0).all(axis=0), gains.mean(axis=0), 0.0)
        return None if low < 0.0 or means.max() < _SHARE * usual else int(means.argmax())
