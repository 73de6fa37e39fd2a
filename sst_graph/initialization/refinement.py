"""Candidates refined side by side: one damped Gauss-Newton step each under every kernel.

The weak priors are those of the graph. Of the graph's other unknowns, twists are fixed and mask biases by
object are left out, so the best candidate is only a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import gtsam
import numpy as np

from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M
from sst_graph.graph.matching import DriveEdges, GraphConfig
from sst_graph.initialization.global_search import rotation_matrices
from sst_graph.initialization.pose_batch import BatchEquations, PoseBatch, Poses
from sst_graph.stepwise import Stepwise
from sst_graph.types import FloatArray

_LONGEST_RAD, _LONGEST_M, _LONGEST_S, _LONGEST_PX = 0.1, 0.3, 0.1, 3.0
"""Longest step of one iteration."""
_POINTS_A_STEP = 32_000
"""Boundary points, times poses, that are matched in one step: 12 ms."""
_DAMPING = 1e-3
"""Of a Gauss-Newton step, as a share of the diagonal of the normal equations."""


class RefinementProblem:
    """The silhouettes of some drives, ready to be compared with many poses at once."""

    def __init__(self, batches: Sequence[PoseBatch], config: GraphConfig) -> None:
        self._batches, self.config = batches, config
        self.biases = sum(len(batch.classes) for batch in batches)

    @classmethod
    def of(cls, edges: Sequence[DriveEdges], config: GraphConfig) -> RefinementProblem:
        """All boundary points of drives."""
        return cls([PoseBatch(own) for own in edges], config)

    def thinned(self, points: int) -> RefinementProblem:
        """The problem with about so many boundary points in all."""
        total = max(1, sum(map(len, self._batches)))
        batches = [batch.thinned(max(1, points * len(batch) // total)) for batch in self._batches]
        return RefinementProblem(batches, self.config)

    def equation_steps(self, poses: Poses, scale_px: float) -> Stepwise[BatchEquations]:
        """Normal equations of all drives, one mask bias for each class in each drive; some poses a step."""
        points = max(1, sum(map(len, self._batches)))
        some = max(1, _POINTS_A_STEP // points)
        parts = []
        for start in range(0, len(poses), some):
            part = poses.take(np.arange(start, min(start + some, len(poses))))
            parts.append(self._equations(part, RobustKernel("geman_mcclure", scale_px)))
            yield 3
        names = [field.name for field in fields(BatchEquations)]
        return BatchEquations(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _equations(self, poses: Poses, kernel: RobustKernel) -> BatchEquations:
        m, k = len(poses), 7 + self.biases
        H, g, support, seen = np.zeros((m, k, k)), np.zeros((m, k)), np.zeros(m), np.zeros(m)
        first = 7
        for batch in self._batches:
            columns = [*range(7), *range(first, first + len(batch.classes))]
            first += len(batch.classes)
            own = replace(poses, biases=poses.biases[:, [column - 7 for column in columns[7:]]])
            equations = batch.equations(own, kernel)
            H[np.ix_(range(m), columns, columns)] += equations.H
            g[:, columns] += equations.g
            support += equations.support
            seen += equations.seen
        return BatchEquations(H, g, support, seen)


def refine_steps(
    problem: RefinementProblem, poses: Poses, centres: Poses, kernels_px: Sequence[float]
) -> Stepwise[Poses]:
    """The poses after one step under each kernel.

    Args:
        centres: what the weak priors of each pose are centred on.
        kernels_px: scales of the robust kernel, step by step [px].
    """
    for scale_px in kernels_px:
        equations = yield from problem.equation_steps(poses, scale_px)
        poses = _stepped(poses, centres, equations, problem.config)
    return poses


def _stepped(poses: Poses, centres: Poses, equations: BatchEquations, config: GraphConfig) -> Poses:
    """One damped Gauss-Newton step, with the weak priors of the graph."""
    k = equations.g.shape[1]
    diagonal = range(k)
    rad, m = PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M
    information = _of_each(k, rad, m, config.time_offset_sigma_s, config.mask_bias_sigma_px) ** -2.0
    away = [
        _rotation_vectors(poses.rotations @ np.swapaxes(centres.rotations, 1, 2)),
        poses.translations - centres.translations,
        (poses.offsets - centres.offsets)[:, None],
        poses.biases,
    ]
    H, g = equations.H.copy(), equations.g + information * np.concatenate(away, axis=1)
    H[:, diagonal, diagonal] = (1.0 + _DAMPING) * (H[:, diagonal, diagonal] + information)
    x = np.asarray(-np.linalg.solve(H, g[:, :, None])[:, :, 0], np.float64)
    longest = _of_each(k, _LONGEST_RAD, _LONGEST_M, _LONGEST_S, _LONGEST_PX)
    x /= np.maximum(1.0, np.abs(x / longest).max(axis=1))[:, None]
    turns = rotation_matrices(x[:, :3])
    return Poses(
        turns @ poses.rotations,
        (turns @ poses.translations[:, :, None])[:, :, 0] + x[:, 3:6],
        poses.offsets + x[:, 6],
        poses.biases + x[:, 7:],
    )


def _of_each(k: int, rad: float, m: float, s: float, px: float) -> FloatArray:
    """(k,) a number for each of the unknowns: rotation, translation, offset, biases."""
    return np.array([rad] * 3 + [m] * 3 + [s] + [px] * (k - 7))


def _rotation_vectors(rotations: FloatArray) -> FloatArray:
    """(m, 3) logarithms of rotations (m, 3, 3) [rad]."""
    return np.stack([gtsam.Rot3.Logmap(gtsam.Rot3.ClosestTo(R)) for R in rotations])
