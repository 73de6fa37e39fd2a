"""Standstill of the vehicle, found from its motions, and the zero-velocity update that follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import RelativeMotion

_MAX_SPEED_MPS = 0.07
"""Fastest that a sensor at standstill may seem to move [m/s]."""
_MAX_TURN_RADPS = 0.03
"""Fastest that it may seem to turn [rad/s]."""
_CERTAINTY = 2.0
"""The speed plus this many of its sigmas has to stay below twice ``_MAX_SPEED_MPS``."""
_MIN_MOTIONS = 2
"""Fewest consecutive motions that make a stop."""
MAX_MOTIONS_TOGETHER = 4
"""So many consecutive motions may be tested as one, for noise alone lets a single one seem to move."""
SIGMA_RAD, SIGMA_M = 2e-5, 2e-4
"""Sigmas of the motion of a sensor at standstill [rad, m]."""


def standstill_frames(
    motions: Sequence[RelativeMotion], together: int = MAX_MOTIONS_TOGETHER
) -> NDArray[np.bool_]:
    """(n + 1,) whether the vehicle is at standstill at each frame of n consecutive motions.

    It is where the motion before the frame and the motion after it are both zero (at either end of the drive:
    the one there is), as part of a stop of at least two motions. A motion that failed, or is known too poorly
    to distinguish standstill from rolling, is never zero.

    Args:
        together: most consecutive motions that may be tested as one.
    """
    zero = _are_zero(motions, together)
    zero &= _run_lengths(zero) >= _MIN_MOTIONS
    before = np.concatenate([zero[:1], zero])
    after = np.concatenate([zero, zero[-1:]])
    return before & after if len(motions) else np.zeros(1, np.bool_)


def zero_velocity_update(
    motions: Sequence[RelativeMotion], together: int = MAX_MOTIONS_TOGETHER
) -> list[RelativeMotion]:
    """The motions, with those between two frames at standstill replaced by the identity.

    Odometry's noise would otherwise look like slow motion, which a time offset could explain.

    Args:
        together: as in :func:`standstill_frames`.
    """
    stands = standstill_frames(motions, together)
    covariance = np.diag(np.repeat([SIGMA_RAD, SIGMA_M], 3) ** 2)
    return [
        replace(motion, aTb=gtsam.Pose3(), covariance=covariance) if stands[i] and stands[i + 1] else motion
        for i, motion in enumerate(motions)
    ]


class ZeroVelocityUpdate:
    """:func:`zero_velocity_update` for motions of which some are new in each call.

    The decision about a motion is final when enough others have followed.
    """

    def __init__(self) -> None:
        self._motions: list[RelativeMotion] = []
        self._updated: list[RelativeMotion] = []

    def apply(self, motions: Sequence[RelativeMotion]) -> list[RelativeMotion]:
        """As :func:`zero_velocity_update`; motions of the call before are recognised by identity."""
        # A new motion changes decisions as far back as motions are tested together, plus the shortest stop.
        reach = MAX_MOTIONS_TOGETHER + _MIN_MOTIONS
        first, alike = overlap(self._motions, motions)
        known = self._updated[first : first + max(0, alike - reach)]
        start = max(0, len(known) - reach)
        updated = known + zero_velocity_update(motions[start:])[len(known) - start :]
        self._motions, self._updated = list(motions), updated
        return list(updated)


def overlap(before: Sequence[RelativeMotion], now: Sequence[RelativeMotion]) -> tuple[int, int]:
    """Position in ``before`` of the first motion of ``now``, and how many from it on are the same objects.

    (0, 0) where the first one is not there.
    """
    oldest = next(iter(now), None)
    first = next((i for i, motion in enumerate(before) if motion is oldest), None)
    if first is None:
        return 0, 0
    pairs = zip(before[first:], now, strict=False)
    ends = min(len(before) - first, len(now))
    return first, next((i for i, (a, b) in enumerate(pairs) if a is not b), ends)


def _are_zero(motions: Sequence[RelativeMotion], together: int) -> NDArray[np.bool_]:
    """(n,) whether motions, by themselves or several together, are surely below the limits."""
    found = np.zeros(len(motions), np.bool_)
    if not motions:
        return found
    seconds = np.array([motion.seconds for motion in motions])
    steps = np.stack([motion.mean_twist for motion in motions]) * seconds[:, None]
    covariances = np.stack([motion.covariance[3:, 3:] for motion in motions])
    sigmas_m = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    speeds = np.linalg.norm(steps[:, 3:], axis=1) / seconds
    # A single motion may be zero only if its noise allows it.
    may = speeds < _MAX_SPEED_MPS + _CERTAINTY * sigmas_m / seconds
    may &= np.array([motion.ok for motion in motions])
    for length in range(1, min(together, len(motions)) + 1):
        windows = np.arange(len(motions) - length + 1)[:, None] + np.arange(length)
        time = seconds[windows].sum(axis=1)
        mean = steps[windows].sum(axis=1) / time[:, None]
        turn, speed = np.linalg.norm(mean[:, :3], axis=1), np.linalg.norm(mean[:, 3:], axis=1)
        # The poses between do not matter: the error of motions together is that of their two ends.
        sigma = sigmas_m[windows].max(axis=1) / time
        slow = (speed < _MAX_SPEED_MPS) & (turn < _MAX_TURN_RADPS)
        sure = speed + _CERTAINTY * sigma < 2.0 * _MAX_SPEED_MPS
        found[windows[slow & sure & may[windows].all(axis=1)]] = True
    return found


def _run_lengths(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n,) length of the run of equal flags that each belongs to, 0 where the flag is False."""
    if len(flags) == 0:
        return np.zeros(0, np.int64)
    starts = np.flatnonzero(np.concatenate([[True], flags[1:] != flags[:-1]]))
    lengths = np.diff(np.concatenate([starts, [len(flags)]]))
    return np.asarray(np.repeat(lengths, lengths) * flags, np.int64)
