"""When a spinning LiDAR measured a point, from the point's azimuth.

A turn of T seconds begins at the azimuth a0. With q(a) = mod(a - a0, 2 pi) / 2 pi the time of a point after
the instant at which the laser faces forward is

    t(a) = f T (q(a) - q(0)),

f = +1 for points as measured by a scanner that turns counter-clockwise (seen from above), -1 for one that
turns clockwise, 0 for points that were moved to one instant. The model is linear in f; the sense of rotation
is its sign.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import ConfigError
from sst_graph.types import FloatArray

SweepStamp = Literal["forward", "start", "end"]
"""The instant that a scan's stamp names: the laser faces forward, the turn begins, the turn ends."""

AHEAD_RAD = np.deg2rad(10.0)
"""Where a turn begins this near to forward, 'forward' would be its start or its end by chance: its start."""


def turned(azimuth_rad: FloatArray, start_rad: float) -> FloatArray:
    """q(a): share of a counter-clockwise turn from its start to the azimuths, 0 to 1."""
    return np.asarray(np.mod(azimuth_rad - start_rad, 2.0 * np.pi) / (2.0 * np.pi))


LONGEST_TURN_S = 60.0
"""No scanner turns more slowly [s]."""


@dataclass(frozen=True)
class SweepTiming:
    """Times of points by their azimuths.

    Attributes:
        fraction: f, -1 (clockwise) to 1 (counter-clockwise); 0 where all points share one instant.
        start_rad: azimuth at which a turn begins and ends, counter-clockwise from the LiDAR's x axis [rad].
        period_s: duration T of a turn [s].
        stamp: the instant that the stamp names; the times of the points are relative to it. It is a
            convention: no data separate it from a time offset between the clocks.
    """

    fraction: float
    start_rad: float
    period_s: float
    stamp: SweepStamp = "forward"

    def __post_init__(self) -> None:
        if not -1.0 <= self.fraction <= 1.0:
            raise ConfigError(f"fraction of the sweep: found {self.fraction}, expected -1 to 1")
        if self.stamp not in get_args(SweepStamp):
            raise ConfigError(
                f"stamp: found {self.stamp!r}, expected one of {', '.join(get_args(SweepStamp))}"
            )
        if not np.isfinite(self.start_rad):
            raise ConfigError(f"start of a turn: found {self.start_rad}, expected a finite azimuth")
        if not 0.0 < self.period_s < LONGEST_TURN_S:
            expected = f"up to {LONGEST_TURN_S:g} s"
            raise ConfigError(f"duration of a turn: found {self.period_s} s, expected {expected}")

    @property
    def instant(self) -> bool:
        """Whether all points share one instant."""
        return self.fraction == 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "fraction": self.fraction,
            "start_deg": float(np.degrees(self.start_rad)),
            "period_s": self.period_s,
            "stamp": self.stamp,
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> SweepTiming:
        """From :meth:`to_dict`.

        Raises:
            KeyError, TypeError, ValueError: not such a dictionary.
            ConfigError: values out of range.
        """
        start_rad = float(np.radians(float(data["start_deg"])))
        return SweepTiming(float(data["fraction"]), start_rad, float(data["period_s"]), data["stamp"])

    def offsets_s(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Time (n,) of points (n, 3) [m] relative to the stamp [s]; 0 for points that are not finite."""
        if self.instant:
            return np.zeros(len(points), np.float32)
        azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
        share = turned(azimuth, self.start_rad)
        seconds = self.fraction * self.period_s * (share - self._named())
        return np.where(np.isfinite(seconds), seconds, 0.0).astype(np.float32)

    def _named(self) -> float:
        """q of the instant that the stamp names."""
        ahead = abs(np.mod(self.start_rad + np.pi, 2.0 * np.pi) - np.pi) < AHEAD_RAD
        if self.stamp == "forward" and not ahead:
            return float(turned(np.zeros(1), self.start_rad)[0])
        # A clockwise turn begins at q = 1.
        return float((self.stamp == "end") == (self.fraction > 0.0))


AT_ONCE = SweepTiming(0.0, 0.0, 0.1)
"""Of points that share one instant, or whose times are given."""
