"""All matches of a frozen graph as rows of one linear problem, with the clusters that they belong to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse import csr_array

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.error_model import SideResiduals
from sst_graph.covariance.jackknife import curvature_ratio
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.sums import ScoreSums
from sst_graph.factors.alignment import weighted_residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import state_from
from sst_graph.graph.elimination import NormalEquations, Unknowns
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import State, bias_key, nuisance_key, object_bias_key, time_offset_key, twist_key
from sst_graph.objects.tracks import ObjectId
from sst_graph.types import FloatArray, IntArray, SemanticClass


@dataclass(frozen=True)
class MatchTable:
    """All weighted matches over the unknowns [extrinsic 6, offsets, biases].

    Attributes:
        J: (m, n) rows multiplied by sqrt(robust weight) / sigma, motion marginalised out: the covariance of
            independent matches times a row is how the estimate follows the residual. Sparse: a frame sees few
            of a long drive's objects.
        root_weights: (m,) sqrt(robust weight).
        curvatures: (m,) second derivative of the robust loss (its slope over the residual is the weight).
        r: (m,) whitened residuals, unweighted.
        sides: (m,) number of the object's side, the same in all frames; ``sides // SIDES`` is its object.
        frames: (m,) number of the frame.
        level: which of them lie on level edges.
    """

    J: csr_array
    root_weights: FloatArray
    curvatures: FloatArray
    r: FloatArray
    sides: IntArray
    frames: IntArray
    level: LevelEdges

    @cached_property
    def objects(self) -> IntArray:
        """(m,) number of the object over all frames, from 0 on."""
        return np.unique(self.sides // SIDES, return_inverse=True)[1].reshape(-1)

    @property
    def object_weights(self) -> FloatArray:
        """By object, the sum of the robust weights of its matches."""
        return np.asarray(np.bincount(self.objects, self.root_weights**2), np.float64)

    @property
    def clusters(self) -> float:
        """How many sides of equal weight would weigh as unevenly as these: (sum w)^2 / sum w^2."""
        weights = np.bincount(self.sides, self.root_weights**2)
        return float(weights.sum() ** 2 / max(float(weights @ weights), 1e-12))

    def take(self, index: IntArray) -> MatchTable:
        """Some of the matches, by position."""
        names = ("J", "root_weights", "curvatures", "r", "sides", "frames")
        return MatchTable(
            **{name: getattr(self, name)[index] for name in names}, level=self.level.take(index)
        )

    def after(self, step: FloatArray) -> MatchTable:
        """The matches after a step (n,) of the unknowns, their robust weights as they are."""
        roots = np.maximum(self.root_weights, 1e-6)
        return replace(self, r=np.where(self.root_weights > 1e-6, self.r + self.J @ step / roots, self.r))

    @cached_property
    def scores(self) -> ScoreSums:
        """The sums of their scores."""
        return ScoreSums.of(self.J, self.root_weights, self.sides, self.frames, self.level)

    @property
    def residuals(self) -> SideResiduals:
        """Their residuals by side and frame."""
        return SideResiduals.of(self.r, self.root_weights**2, self.sides, self.frames)

    @property
    def weight_curvature_ratio(self) -> float:
        """Mean robust weight over mean curvature."""
        return curvature_ratio(float(self.root_weights @ self.root_weights), float(self.curvatures.sum()))


def match_table(
    system: NormalEquations,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    tracks: Sequence[dict[ObjectId, int]],
) -> MatchTable:
    """All matches of the frozen problem at its optimum, with the clusters they belong to.

    Args:
        system: the problem, linear at its optimum ``values``.
        state: that the matches were made at.
        tracks: of each drive's objects.
    """
    made_at = state.nuisances
    state = state_from(values, state, pairs)
    steps = {name: value - made_at.get(name, 0.0) for name, value in state.nuisances.items()}
    unknowns, motion = system.unknowns, _Motion(values, system.twist_responses(), steps)
    blocks, roots, residuals, curvatures, sides, level = [], [], [], [], [], []
    for pair in pairs:
        for c, matches in pair.matches.items():
            block, root, r = _rows(pair, c, state, unknowns, motion)
            blocks.append(csr_array(block))
            roots.append(root)
            residuals.append(r)
            curvatures.append(curvatures_of(matches.alignment.kernel, root, r))
            level.append(LevelEdges.of(matches.alignment, matches.level_px, pair.wTl))
            track = np.array([tracks[pair.drive][pair.pair.scan, c, int(o)] for o in matches.objects])
            # Tracks of different drives have numbers of their own.
            sides.append((track * len(tracks) + pair.drive) * SIDES + matches.sides)
    # What several images show of one scan errs together: its points are the same.
    scans: dict[tuple[int, int], int] = {}
    frames = [scans.setdefault((pair.drive, pair.pair.scan), len(scans)) for pair in pairs]
    return MatchTable(
        sparse.vstack(blocks, format="csr"),
        np.concatenate(roots),
        np.concatenate(curvatures),
        np.concatenate(residuals),
        np.concatenate(sides),
        np.repeat(frames, [len(pair) for pair in pairs]),
        LevelEdges.joined(level),
    )


@dataclass(frozen=True)
class _Motion:
    """Twists and parameters at the optimum, relative to the point that the matches were made at.

    Attributes:
        values: with the twists at the optimum.
        responses: (6, n) derivative of each twist by the other unknowns, by its key.
        nuisances: steps of the assumptions' parameters since the matches were made, by name.
    """

    values: gtsam.Values
    responses: Mapping[int, FloatArray]
    nuisances: Mapping[str, float]


def _rows(
    pair: PairMatches, c: SemanticClass, state: State, unknowns: Unknowns, motion: _Motion
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted Jacobian rows, roots of the weights, and whitened residuals of one class in one pair."""
    V_key = twist_key(pair.drive, pair.pair.image)
    c_twist, response = motion.values.atVector(V_key), motion.responses[V_key]
    alignment = pair.matches[c].alignment
    if c in pair.tracks:
        names, groups = pair.biased[c]
        columns = np.array([unknowns.column(object_bias_key(pair.drive, track)) for track in names])[groups]
        biases_px = np.array([state.object_bias_px(pair.drive, track, c) for track in names])[groups]
    else:
        columns = np.full(len(alignment), unknowns.column(bias_key(pair.drive, c)))
        biases_px = np.full(len(alignment), state.biases_px.get((pair.drive, c), 0.0))
    r, J, _ = weighted_residuals(alignment, state.cTl, state.time_offset_s(pair.drive), c_twist, biases_px)
    roots = np.abs(J[:, 13]) * alignment.sigmas_px
    block = J[:, 7:13] @ response
    block[:, :6] += J[:, :6]
    block[:, unknowns.column(time_offset_key(state.clock(pair.drive)))] += J[:, 6]
    block[np.arange(len(alignment)), columns] += J[:, 13]
    for name, column in pair.terms.get(c, {}).items():
        block[:, unknowns.column(nuisance_key(name))] += column * J[:, 13]
        r = r + column * J[:, 13] * motion.nuisances.get(name, 0.0)
    return block, roots, unweighted(r, roots)


def unweighted(r: FloatArray, roots: FloatArray) -> FloatArray:
    """(m,) whitened residuals from those multiplied by the roots of their weights; 0 where nothing weighs."""
    return np.where(roots > 1e-6, r / np.maximum(roots, 1e-6), 0.0)


def curvatures_of(kernel: RobustKernel, roots: FloatArray, r: FloatArray) -> FloatArray:
    """(m,) second derivatives of the robust loss, multiplied by the matches' own weights."""
    return np.asarray(roots**2 * kernel.curvature(r) / np.maximum(kernel.weight(r), 1e-12))
