"""Share of the sweep that is in the points, and where a turn begins, from the registration of the scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.odometry.sweep.window import ANNEALING, SECTORS, Normal, SurfaceSums, SweepWindow
from sst_graph.types import FloatArray

_MAX_FRACTION = 1.3
"""Bound of the share on the way to an estimate: the truth is at most 1."""
_CONVERGED = 0.005
"""Change of the share below which the iterations end."""
_POSES_ONLY = 2
"""Iterations in which only the poses move: what odometry left of their errors looks like a turn that begins
ahead, and matches made under that one confirm it."""
_LEAST_PAIRS, _LEAST_SPREAD = 8, 0.1
"""Fewest pairs of scans by which two fits are compared, and least deviation of points missed from pair to
pair."""
_MAX_ITERATIONS = 12
"""Most times that points are matched again."""


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
        return np.asarray(np.clip(best, -_MAX_FRACTION, _MAX_FRACTION))


@dataclass(frozen=True)
class SweepEstimate:
    """Result of the registration.

    Attributes:
        fraction, sector: least cost of all.
        quadratic: the cost around it.
        normals: of the windows, at the last matches.
        linearized_at: share and start under which those were made.
        missed: (pairs of scans,) :meth:`SweepWindow.missed` of all windows at the end.
    """

    fraction: float
    sector: int
    quadratic: Quadratic
    normals: tuple[Normal, ...]
    linearized_at: tuple[float, int]
    missed: FloatArray

    @property
    def misfit(self) -> float:
        """All points missed: the least is the best fit of the same windows."""
        return float(self.missed.sum())

    def worse_by(self, other: SweepEstimate) -> float:
        """By how many sigmas this fits worse than another estimate from the same windows: the mean over the
        pairs of scans, with its standard error. Few pairs tell nothing of that: 0."""
        more, n = self.missed - other.missed, len(self.missed)
        if n < _LEAST_PAIRS:
            return 0.0
        variance = n / (n - 1.0) * float(((more - more.mean()) ** 2).sum())
        return float(more.sum() / np.sqrt(max(variance, n * _LEAST_SPREAD**2)))

    def evidence(self, windows: Sequence[SweepWindow]) -> SweepEvidence:
        """Evidence for every start of a turn, at the last matches."""
        present = self.linearized_at[0] * CANDIDATES[self.linearized_at[1]]
        groupings: tuple[list[SurfaceSums], list[SurfaceSums]] = ([], [])
        modelled = np.zeros(SECTORS)
        for window, normal in zip(windows, self.normals, strict=True):
            by_cell, by_direction = window.surface_sums(CANDIDATES.T, normal, present)
            errors = window.errors
            modelled += errors.own * by_cell.information.sum(axis=0)
            modelled += errors.shared * (by_cell.lever**2).sum(axis=0)
            groupings[0].append(by_cell)
            groupings[1].append(by_direction)
        # A cluster-robust variance by each grouping (Cameron, Gelbach and Miller, 2011), the larger one.
        clustered = [sum((one.score**2).sum(axis=0) for one in sums) for sums in groupings]
        curvature = np.maximum(self.quadratic.curvature, 1e-12)
        return SweepEvidence(
            np.maximum.reduce([*clustered, modelled]) / curvature,
            curvature,
            tuple(
                (
                    np.concatenate([one.origin for one in sums]),
                    np.concatenate([one.information for one in sums]),
                )
                for sums in groupings
            ),
        )


_MAX_LOG_RATIO = 3.0
"""Most that one group of matches adds to the logarithm of a likelihood ratio: one in twenty is wrong (a
moving object, wrong matches), whatever its residuals."""


@dataclass(frozen=True)
class SweepEvidence:
    """Evidence of the registration on turns, by the sector at whose border they begin.

    Attributes:
        unit: (SECTORS,) variance of a residual as far as its errors reach a share [m^2]: cluster-robust from
            the groups' scores, at least that of the errors of matches and surfaces.
        curvature: (SECTORS,) of the cost [m^2].
        groupings: of the matches, each (slopes, curvatures), both (groups, SECTORS): derivatives of each
            group's cost, for points that share one instant [m^2].
    """

    unit: FloatArray
    curvature: FloatArray
    groupings: tuple[tuple[FloatArray, FloatArray], ...]

    @property
    def sigma(self) -> FloatArray:
        """(SECTORS,) standard deviation of the share."""
        return np.asarray(np.sqrt(self.unit / self.curvature))

    def log_ratio(self, fraction: float) -> FloatArray:
        """(SECTORS,) log likelihood of a share of the sweep against that of points that share one instant: by
        the grouping with the smaller one, 0 where they contradict each other.
        """
        sums = []
        for slopes, curvatures in self.groupings:
            gain = -(fraction * slopes + 0.5 * fraction**2 * curvatures) / self.unit
            sums.append(np.clip(gain, -_MAX_LOG_RATIO, _MAX_LOG_RATIO).sum(axis=0))
        least, most = np.min(sums, axis=0), np.max(sums, axis=0)
        return np.asarray(np.maximum(least, 0.0) + np.minimum(most, 0.0))


def estimate(windows: Sequence[SweepWindow], fraction: float = 0.0, sector: int = 0) -> SweepEstimate:
    """Share and start of least cost, iterated from those given, with the poses of the windows."""
    for number in range(_MAX_ITERATIONS):
        present = fraction, sector
        quadratic, normals = _matched(windows, fraction, sector, number)
        if number < _POSES_ONLY:
            _move(windows, normals, np.zeros(1 + SECTORS))
            continue
        shares = quadratic.free()
        best = int(np.argmin(quadratic.cost(shares)))
        last, fraction = fraction, float(shares[best])
        step = fraction * CANDIDATES[best] - last * CANDIDATES[sector]
        _move(windows, normals, step)
        done = best == sector and abs(fraction - last) < _CONVERGED and number >= ANNEALING
        sector = best
        if done:
            break
    return SweepEstimate(fraction, sector, quadratic, normals, present, _missed(windows))


def at_hypothesis(
    windows: Sequence[SweepWindow], fraction: float, sector: int, iterations: int
) -> SweepEstimate:
    """The cost around a given share and start, with the poses that go with it."""
    for number in range(iterations):
        quadratic, normals = _matched(windows, fraction, sector, number)
        _move(windows, normals, np.zeros(1 + SECTORS))
    shares = quadratic.free()
    best = int(np.argmin(quadratic.cost(shares)))
    return SweepEstimate(float(shares[best]), best, quadratic, normals, (fraction, sector), _missed(windows))


def _matched(
    windows: Sequence[SweepWindow], fraction: float, sector: int, number: int
) -> tuple[Quadratic, tuple[Normal, ...]]:
    normals = tuple(window.linearized(fraction, start_of(sector), number) for window in windows)
    H = np.sum([normal.H for normal in normals], axis=0)
    # About u = 0, so that one quadratic holds for all hypotheses.
    g = np.sum([normal.g for normal in normals], axis=0) + H @ (fraction * CANDIDATES[sector])
    return Quadratic(np.einsum("ij,ij->i", CANDIDATES @ H, CANDIDATES), CANDIDATES @ g), normals


def _move(windows: Sequence[SweepWindow], normals: Sequence[Normal], step: FloatArray) -> None:
    for window, normal in zip(windows, normals, strict=True):
        window.move(normal, step)


def _missed(windows: Sequence[SweepWindow]) -> FloatArray:
    return np.concatenate([window.missed() for window in windows])
