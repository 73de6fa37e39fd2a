"""Weighted rows of the matches of some pairs of scan and image, evaluated at once.

A pair has ten to a few hundred matches: pair by pair, the calls would cost several times as much as the work.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from sst_graph.association.edge_matching import MatchConfig
from sst_graph.assumptions.model import Scene
from sst_graph.factors.matches import Alignment, joined
from sst_graph.factors.reprojection import ImageGroups, weigh
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.nuisances import residual_columns
from sst_graph.graph.state import lower_edge_track
from sst_graph.objects.tracks import numbers_in, of_each
from sst_graph.tracker.sums.held import EDGE_ERRORS, edge_error_columns
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import FloatArray, IntArray, SemanticClass


@dataclass(frozen=True)
class PairColumns:
    """What the columns of a linearized pair stand for.

    Attributes:
        classes: whose mask biases are estimated, in the order of the point's.
        tracks: number of the track of each (class, object) of the scan.
        held: what is held behind the unknowns (:func:`~sst_graph.tracker.sums.held.held_names`).
        config: that the matches were made under.
    """

    classes: Sequence[SemanticClass]
    tracks: Mapping[tuple[SemanticClass, int], int]
    held: Sequence[str] = ()
    config: MatchConfig = field(default_factory=MatchConfig)

    def object_places(self, pair: PairMatches) -> dict[int, int]:
        """Place of its class's bias for each object of a pair, if objects have a bias of their own."""
        return {
            self.tracks[c, number]: self.classes.index(c)
            for c in pair.tracks
            for number in numbers_in(pair.matches[c].objects)
        }

    def tracks_of(self, pair: PairMatches, c: SemanticClass) -> IntArray:
        """(m,) track of the object of each match of a class."""
        objects = pair.matches[c].objects
        return of_each(objects, {number: self.tracks[c, number] for number in numbers_in(objects)})


@dataclass(frozen=True)
class PairAt:
    """A pair, the point that it is linearized at, with just the objects that it sees, and its columns."""

    pair: PairMatches
    point: Point
    columns: PairColumns

    def bias_columns(self, c: SemanticClass) -> IntArray:
        """(m,) column of the mask bias of each match of a class."""
        point, classes = self.point, self.columns.classes
        place = classes.index(c)
        if c not in self.pair.tracks:
            return np.full(len(self.pair.matches[c]), 7 + place)
        tracks, groups = self.pair.biased[c]
        below = 7 + len(classes) + place
        known = {track: point.core_size + k for k, track in enumerate(point.tracks)}
        return np.array([below if t == lower_edge_track(c) else known[t] for t in tracks])[groups]

    @property
    def scalars(self) -> FloatArray:
        """Values of the unknowns behind extrinsic and time offset."""
        point = self.point
        return np.concatenate([point.biases_px, point.parameters, point.object_biases_px])


@dataclass(frozen=True)
class Rows:
    """Weighted rows of m matches.

    Attributes:
        J: (m, n) by the unknowns and what is held.
        by_twist: (m, 6) by the camera's twist.
        by_picture: (m, 2) by a shift of the picture across and down.
        residuals: (m,) weighted.
        roots: (m,) of the robust weights.
    """

    J: FloatArray
    by_twist: FloatArray
    by_picture: FloatArray
    residuals: FloatArray
    roots: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """One after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return parts[0] if len(parts) == 1 else cls(*map(np.concatenate, columns))


def rows_of_pairs(pairs: Sequence[PairAt]) -> list[Rows]:
    """The rows of each of some pairs, which share extrinsic, offset, and the names of the held parameters."""
    parts: list[list[Rows]] = [[] for _ in pairs]
    for c in dict.fromkeys(c for one in pairs for c in one.pair.matches):
        members = [k for k, one in enumerate(pairs) if c in one.pair.matches]
        for k, rows in zip(members, _of_class([pairs[k] for k in members], c), strict=True):
            parts[k].append(rows)
    return [Rows.joined(own) for own in parts]


def _of_class(pairs: Sequence[PairAt], c: SemanticClass) -> list[Rows]:
    """The rows of the matches of one class in each of some pairs."""
    point, held = pairs[0].point, pairs[0].columns.held
    assumptions = [name for name in held if name not in EDGE_ERRORS]
    alignment = joined([one.pair.matches[c].alignment for one in pairs])
    counts = [len(one.pair.matches[c]) for one in pairs]
    columns = [one.bias_columns(c) for one in pairs]
    biases = np.concatenate([one.scalars[own - 7] for one, own in zip(pairs, columns, strict=True)])
    J, r = _weighted(pairs, alignment, np.array(counts), biases)
    roots, known = np.abs(J[:, 13]) * alignment.sigmas_px, np.zeros((0, len(r)))
    if assumptions:
        twists = np.repeat([one.pair.motion.c_twist for one in pairs], counts, axis=0)
        offsets_s = np.concatenate([one.pair.matches[c].offsets_s for one in pairs])
        at, scene = (point.cTl, point.time_offset_s, twists.T), _scene(pairs, counts)
        known = np.array([*residual_columns(alignment, scene, offsets_s, at, assumptions, J).values()])
    assert alignment.normals is not None
    by_picture = J[:, 13:14] * alignment.normals
    ends = np.cumsum(counts).tolist()
    found = []
    for one, places, start, end in zip(pairs, columns, [0, *ends], ends, strict=False):
        some, point = slice(start, end), one.point
        block = np.zeros((end - start, point.size + len(held)))
        block[:, :7] = J[some, :7]
        block[np.arange(end - start), places] = J[some, 13]
        for place, name in zip(point.parameter_columns, point.names, strict=True):
            block[:, place] = one.pair.terms[c][name] * J[some, 13]
        block[:, point.size : point.size + len(assumptions)] = known[:, some].T
        if held and c == SemanticClass.OBJECT:
            errors = edge_error_columns(J[some], one.pair.matches[c], one.columns.config)
            block[:, point.size + len(assumptions) :] = errors
        found.append(Rows(block, J[some, 7:13], by_picture[some], r[some], roots[some]))
    return found


def _weighted(
    pairs: Sequence[PairAt], alignment: Alignment, counts: IntArray, biases_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted Jacobian (m, 14) by [rot, trans, offset, twist, bias], and residuals (m,), of joined matches
    with biases (m,) [px]."""
    point, bounds = pairs[0].point, np.append(0, np.cumsum(counts))
    twists = np.array([one.pair.motion.c_twist for one in pairs])
    groups = ImageGroups.of(alignment, bounds)
    evaluated = groups.evaluate(alignment, point.cTl, point.time_offset_s, twists, biases_px)
    weigh(alignment, evaluated)
    if groups.accelerations is None:
        system = evaluated.system()
        return system[:-1].T, system[-1]
    assert evaluated.lift is not None
    rows, motion_rows = evaluated.rows[:, 0], evaluated.motion_rows
    J = np.empty((len(alignment), 14))
    J[:, 13] = rows[-2]
    for lift, (a, b) in zip(evaluated.lift, pairwise(bounds.tolist()), strict=True):
        np.matmul(rows[:motion_rows, a:b].T, lift.T, out=J[a:b, :13])
    return J, rows[-1]


def _scene(pairs: Sequence[PairAt], counts: Sequence[int]) -> Scene:
    """What assumptions may depend on, with a row for each match."""
    scenes = [one.pair.scene for one in pairs if one.pair.scene is not None]
    l_twists = np.repeat([scene.l_twist for scene in scenes], counts, axis=0)
    images_s = np.repeat([scene.image_s for scene in scenes], counts)
    return replace(scenes[0], l_twist=l_twists, image_s=images_s)
