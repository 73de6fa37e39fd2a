"""Frames at which the vehicle stands, found from its motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.types import RelativeMotion


@dataclass(frozen=True)
class StandingConfig(Settings):
    """What counts as standing.

    Attributes:
        max_speed_mps: fastest that a standing sensor may seem to move [m/s].
        max_turn_radps: fastest that it may seem to turn [rad/s].
        certainty: the speed plus this many of its sigmas must stay below twice ``max_speed_mps``.
        rest_sigma_rad, rest_sigma_m: sigmas of the motion of a sensor that stands [rad, m].
        min_motions: fewest consecutive motions at rest that make a stop.
        longest_stretch: as many motions in a row may be judged as one, for noise alone lets a single one
            seem to move.
    """

    max_speed_mps: float = setting(0.07, at_least=0.0, at_most=10.0)
    max_turn_radps: float = setting(0.03, at_least=0.0, at_most=10.0)
    certainty: float = setting(2.0, at_least=0.0, at_most=100.0)
    min_motions: int = setting(2, at_least=1, at_most=1000)
    longest_stretch: int = setting(4, at_least=1, at_most=50)
    rest_sigma_rad: float = setting(2e-5, at_least=1e-7, at_most=1.0)
    rest_sigma_m: float = setting(2e-4, at_least=1e-7, at_most=1.0)


def standing_frames(
    motions: Sequence[RelativeMotion], config: StandingConfig | None = None
) -> NDArray[np.bool_]:
    """(n + 1,) whether each frame of n consecutive motions stands still.

    A frame stands when the motion before it and the motion after it are both at rest (at either end
    of the drive: the one there is), as part of a stop of at least ``min_motions``. A motion that
    failed, or is known too poorly to tell rest from rolling, is never at rest.
    """
    config = config or StandingConfig()
    at_rest = _at_rest(motions, config)
    at_rest &= _run_lengths(at_rest) >= config.min_motions
    before = np.concatenate([at_rest[:1], at_rest])
    after = np.concatenate([at_rest, at_rest[-1:]])
    return before & after if len(motions) else np.zeros(1, np.bool_)


def at_rest(motions: Sequence[RelativeMotion], config: StandingConfig | None = None) -> list[RelativeMotion]:
    """The motions with those between standing frames replaced by none at all.

    Odometry's noise would otherwise look like slow motion, which a time offset could feed on.
    """
    config = config or StandingConfig()
    stands = standing_frames(motions, config)
    covariance = np.diag(np.repeat([config.rest_sigma_rad, config.rest_sigma_m], 3) ** 2)
    return [
        replace(motion, aTb=gtsam.Pose3(), covariance=covariance) if stands[i] and stands[i + 1] else motion
        for i, motion in enumerate(motions)
    ]


class Rest:
    """:func:`at_rest` for motions of which some are new in each call.

    What is told of a motion stays when enough others have followed.
    """

    def __init__(self, config: StandingConfig | None = None) -> None:
        self.config = config or StandingConfig()
        self._motions: list[RelativeMotion] = []
        self._told: list[RelativeMotion] = []

    def told(self, motions: Sequence[RelativeMotion]) -> list[RelativeMotion]:
        """As :func:`at_rest`; a motion that the call before had is known by being the same object."""
        # A motion's neighbours decide, as far as a stretch reaches, and a stop at the least.
        reach = self.config.longest_stretch + self.config.min_motions
        first, alike = overlap(self._motions, motions)
        known = self._told[first : first + max(0, alike - reach)]
        start = max(0, len(known) - reach)
        told = known + at_rest(motions[start:], self.config)[len(known) - start :]
        self._motions, self._told = list(motions), told
        return list(told)


def overlap(before: Sequence[RelativeMotion], now: Sequence[RelativeMotion]) -> tuple[int, int]:
    """Where the first motion stood before, and how many from it on are the same objects; none: (0, 0)."""
    oldest = next(iter(now), None)
    first = next((i for i, motion in enumerate(before) if motion is oldest), None)
    if first is None:
        return 0, 0
    pairs = zip(before[first:], now, strict=False)
    ends = min(len(before) - first, len(now))
    return first, next((i for i, (a, b) in enumerate(pairs) if a is not b), ends)


def _at_rest(motions: Sequence[RelativeMotion], config: StandingConfig) -> NDArray[np.bool_]:
    """(n,) whether motions, or stretches of them, are surely below the speeds of the configuration."""
    found = np.zeros(len(motions), np.bool_)
    if not motions:
        return found
    seconds = np.array([motion.seconds for motion in motions])
    steps = np.stack([motion.mean_twist for motion in motions]) * seconds[:, None]
    covariances = np.stack([motion.covariance[3:, 3:] for motion in motions])
    sigmas_m = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    speeds = np.linalg.norm(steps[:, 3:], axis=1) / seconds
    # A single motion may be at rest only if its noise allows it.
    may = speeds < config.max_speed_mps + config.certainty * sigmas_m / seconds
    may &= np.array([motion.ok for motion in motions])
    for length in range(1, min(config.longest_stretch, len(motions)) + 1):
        windows = np.arange(len(motions) - length + 1)[:, None] + np.arange(length)
        time = seconds[windows].sum(axis=1)
        mean = steps[windows].sum(axis=1) / time[:, None]
        turn, speed = np.linalg.norm(mean[:, :3], axis=1), np.linalg.norm(mean[:, 3:], axis=1)
        # The poses inside a stretch do not matter: its error is that of its two ends.
        sigma = sigmas_m[windows].max(axis=1) / time
        slow = (speed < config.max_speed_mps) & (turn < config.max_turn_radps)
        sure = speed + config.certainty * sigma < 2.0 * config.max_speed_mps
        found[windows[slow & sure & may[windows].all(axis=1)]] = True
    return found


def _run_lengths(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n,) length of the run of equal flags that each belongs to, 0 where the flag is False."""
    if len(flags) == 0:
        return np.zeros(0, np.int64)
    starts = np.flatnonzero(np.concatenate([[True], flags[1:] != flags[:-1]]))
    lengths = np.diff(np.concatenate([starts, [len(flags)]]))
    return np.asarray(np.repeat(lengths, lengths) * flags, np.int64)
