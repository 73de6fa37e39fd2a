"""Share of the sweep that is in the points, and where a turn begins, from the registration of the scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.odometry.sweep.window import SECTORS, Normal, Window

FloatArray = NDArray[np.float64]

FARTHEST = 1.3
"""Largest share of a turn that is believed on the way to an estimate."""
SETTLED = 0.005
"""Change of the share of a turn at which matches need not be made anew."""


def _candidates() -> FloatArray:
    """(SECTORS, 1 + SECTORS) times of a whole counter-clockwise turn that begins at each sector's border.

    q(a) for a start at the border s is that for a start behind, and 1 more for the sectors before s, but for
    a constant, which moves all poses along the path and nothing else.
    """
    columns = np.ones((SECTORS, 1 + SECTORS))
    columns[:, 1:] = np.tril(columns[:, 1:], -1)
    return columns


CANDIDATES = _candidates()


def start_of(sector: int) -> float:
    """Azimuth of the border before a sector [rad]."""
    return -np.pi + 2.0 * np.pi * sector / SECTORS


@dataclass(frozen=True)
class Quadratic:
    """Cost of the times u = f c over all starts c of a turn: f^2 curvature / 2 - f slope, 0 at f = 0 [m^2].

    Attributes:
        curvature, slope: (SECTORS,) by start.
    """

    curvature: FloatArray
    slope: FloatArray

    def cost(self, fraction: FloatArray | float) -> FloatArray:
        """(SECTORS,) cost at a share of the sweep."""
        return np.asarray(0.5 * fraction**2 * self.curvature - fraction * self.slope)

    def free(self) -> FloatArray:
        """(SECTORS,) the share of least cost."""
        best = self.slope / np.maximum(self.curvature, 1e-12)
        return np.asarray(np.clip(best, -FARTHEST, FARTHEST))


@dataclass(frozen=True)
class Estimate:
    """What the registration says.

    Attributes:
        fraction, sector: least cost of all.
        quadratic: the cost around it.
        normals: of the windows, at the last matches.
        misfit: mean robust misfit of the matches at the end, 0 to 1.
    """

    fraction: float
    sector: int
    quadratic: Quadratic
    normals: tuple[Normal, ...]
    misfit: float

    def units(self, windows: Sequence[Window], surface_m: float) -> FloatArray:
        """(SECTORS,) what a cost of 1/2 sigma^2 is, for turns that begin at each sector's border [m^2].

        Cluster-robust over the cells of the ground plan, with ``surface_m`` of error of its own for each; at
        least what the residuals themselves say.
        """
        total = np.zeros(SECTORS)
        for window, normal in zip(windows, self.normals, strict=True):
            score, lever = window.scores(CANDIDATES.T, normal)
            total += (score**2).sum(axis=0) + surface_m**2 * (lever**2).sum(axis=0)
        squares, weights = np.sum([window.squares for window in windows], axis=0)
        least = squares / max(weights, 1e-9)
        return np.maximum(total / np.maximum(self.quadratic.curvature, 1e-12), max(least, 1e-12))


def estimate(windows: Sequence[Window], fraction: float = 0.0, sector: int = 0) -> Estimate:
    """Share and start of least cost, from those given, with the poses of the windows; matches made anew."""
    config = windows[0].config
    for number in range(config.passes):
        quadratic, normals = _matched(windows, fraction, sector, number)
        shares = quadratic.free()
        best = int(np.argmin(quadratic.cost(shares)))
        last, fraction = fraction, float(shares[best])
        step = fraction * CANDIDATES[best] - last * CANDIDATES[sector]
        _move(windows, normals, step)
        done = best == sector and abs(fraction - last) < SETTLED and number >= len(config.gates_m)
        sector = best
        if done:
            break
    return Estimate(fraction, sector, quadratic, normals, _misfit(windows))


def at_hypothesis(windows: Sequence[Window], fraction: float, sector: int, passes: int) -> Estimate:
    """The cost around a given share and start, with the poses that go with it."""
    for number in range(passes):
        quadratic, normals = _matched(windows, fraction, sector, number)
        _move(windows, normals, np.zeros(1 + SECTORS))
    shares = quadratic.free()
    best = int(np.argmin(quadratic.cost(shares)))
    return Estimate(float(shares[best]), best, quadratic, normals, _misfit(windows))


def _matched(
    windows: Sequence[Window], fraction: float, sector: int, number: int
) -> tuple[Quadratic, tuple[Normal, ...]]:
    normals = tuple(window.linearized(fraction, start_of(sector), number) for window in windows)
    H = np.sum([normal.H for normal in normals], axis=0)
    # About u = 0, so that all hypotheses are told by one quadratic.
    g = np.sum([normal.g for normal in normals], axis=0) + H @ (fraction * CANDIDATES[sector])
    return Quadratic(np.einsum("ij,ij->i", CANDIDATES @ H, CANDIDATES), CANDIDATES @ g), normals


def _move(windows: Sequence[Window], normals: Sequence[Normal], step: FloatArray) -> None:
    for window, normal in zip(windows, normals, strict=True):
        window.move(normal, step)


def _misfit(windows: Sequence[Window]) -> float:
    scale = windows[0].config.scales_m[-1]
    return float(np.mean([window.misfit(scale) for window in windows]))
