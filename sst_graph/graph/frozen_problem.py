"""The problem of :func:`~sst_graph.graph.building.joint_graph`, optimised without building its graph.

The factors are the same, and so are their formulas (:func:`sst_graph.factors.reprojection.evaluate`,
:func:`sst_graph.factors.velocity.transferred`), but those of all images are evaluated at once: with
the few hundred matches of one image, the calls would cost more than the work. The twists are eliminated
(:mod:`sst_graph.graph.elimination`), and what remains is a small dense system in the extrinsic, the clocks,
the parameters of assumptions and the mask biases. Their priors are a gtsam graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from sst_graph.assumptions import named_sigmas
from sst_graph.drive.twists import camera_covariances
from sst_graph.factors.matches import Alignment
from sst_graph.factors.reprojection import Evaluated, ImageGroups, weigh
from sst_graph.factors.velocity import transferred
from sst_graph.graph.building import UNKNOWN_TWIST_SIGMAS, prior_graph
from sst_graph.graph.elimination import NormalEquations, Unknowns
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.linear import ordering_of
from sst_graph.graph.matching import DriveMatches, GraphConfig
from sst_graph.graph.state import (
    EXTRINSIC,
    State,
    bias_key,
    nuisance_key,
    object_bias_key,
    time_offset_key,
    twist_key,
)
from sst_graph.types import BoolArray, FloatArray, IntArray

_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-12, 1e5
"""Damping of the Levenberg-Marquardt steps: of the first, least, most."""
_SMALL = 1e-7
"""A step that changes the cost by a smaller fraction is the last one."""


@dataclass(frozen=True)
class FrozenPoint:
    """Values of all unknowns.

    Attributes:
        cTl: extrinsic.
        scalars: (k,) values of the other unknowns that are not twists, the time offsets first.
        twists: (f, 6) of the camera at each image [rad/s, m/s].
    """

    cTl: gtsam.Pose3
    scalars: FloatArray
    twists: FloatArray


@dataclass(frozen=True)
class _Images:
    """The twists of all images that have matches, and their measurements by odometry.

    Attributes:
        keys: of the twists.
        twists: (f, 6) of the camera where the matches were made [rad/s, m/s].
        l_twists, l_accelerations: (f, 6) of the LiDAR; 0 without odometry.
        information: (f, 6, 6) inverse covariance of the camera's.
        clocks: (f,) column of the time offset.
        offsets_s: (f,) time offset at which the twists were interpolated [s].
    """

    keys: tuple[int, ...]
    twists: FloatArray
    l_twists: FloatArray
    l_accelerations: FloatArray
    information: FloatArray
    clocks: IntArray
    offsets_s: FloatArray

    @cached_property
    def by_clock(self) -> list[tuple[BoolArray, IntArray, tuple[IntArray, ...]]]:
        """For each time offset its images (f,), the columns of the extrinsic and of it, and where these stand
        in H_mixed."""
        parts = [(self.clocks == c, np.array([*range(6), c])) for c in np.unique(self.clocks).tolist()]
        return [(own, columns, np.ix_(own, np.arange(6), columns)) for own, columns in parts]


@dataclass(frozen=True)
class _Frames:
    """The matches of one drive, ordered by image and within it by mask bias.

    Attributes:
        alignment: all m matches.
        images: (m,) number of the image of each.
        biases: (m,) column of its mask bias.
        clock: column of the drive's time offset.
        term_columns: of the parameters that are estimated.
        terms: (t, m) derivatives of the residuals by them.
        terms_at: (t,) where they were made.
    """

    alignment: Alignment
    images: IntArray
    biases: IntArray
    clock: int
    term_columns: Sequence[int]
    terms: FloatArray
    terms_at: FloatArray

    @cached_property
    def bounds(self) -> IntArray:
        """(f + 1,) first match of each image that has one, and the end."""
        return np.append(np.flatnonzero(np.diff(self.images, prepend=-1)), len(self.images))

    @cached_property
    def places(self) -> IntArray:
        """(f,) numbers of these images."""
        return self.images[self.bounds[:-1]]

    @cached_property
    def spans(self) -> list[tuple[int, int, int]]:
        """Number, first match and end of each of them."""
        bounds = self.bounds.tolist()
        return list(zip(self.places.tolist(), bounds[:-1], bounds[1:], strict=True))

    @cached_property
    def cells(self) -> IntArray:
        """First match of each image's matches that share a bias."""
        new_image, new_bias = np.diff(self.images, prepend=-1) != 0, np.diff(self.biases, prepend=-1) != 0
        return np.flatnonzero(new_image | new_bias)

    @cached_property
    def cell_spans(self) -> IntArray:
        """Which of ``spans`` each cell lies in."""
        return np.searchsorted(self.bounds, self.cells, side="right") - 1

    @cached_property
    def groups(self) -> ImageGroups:
        """Where the matches of each image stand in the alignment."""
        return ImageGroups.of(self.alignment, self.bounds)

    @cached_property
    def columns(self) -> IntArray:
        """Columns of the extrinsic, the time offset and the parameters."""
        return np.array([*range(6), self.clock, *self.term_columns])

    @cached_property
    def into_mixed(self) -> tuple[IntArray, ...]:
        """Where the products of twists and ``columns`` stand in H_mixed."""
        return np.ix_(self.places, np.arange(6), self.columns)


class FrozenProblem:
    """Matches of all drives, and the optimum of everything under them."""

    def __init__(
        self,
        matches: Sequence[DriveMatches],
        state: State,
        config: GraphConfig,
        guess: State | None = None,
        prior: KnownCalibration | None = None,
    ) -> None:
        """
        Args:
            matches: by drive, made at ``state``.
            guess: what the weak priors are centred on; by default the state.
            prior: what is known beside the matches.
        """
        self.state = state
        self._classes = sorted({(own.number, c) for own in matches for c in own.classes})
        self._objects = sorted({each for own in matches for each in own.tracked})
        self._priors, values = prior_graph(self._classes, self._objects, state, config, guess)
        self._names = [name for name, _ in named_sigmas(config.estimate)]
        if prior is not None:
            self._priors.add(prior.factor(self._names))
        # 1. The unknowns: extrinsic, clocks, parameters of assumptions, mask biases of classes and objects.
        clocks = [time_offset_key(clock) for clock in range(len(state.time_offsets_s))]
        biases = [bias_key(drive, c) for drive, c in self._classes]
        biases += [object_bias_key(drive, track) for drive, _, track in self._objects]
        self._keys = (*clocks, *map(nuisance_key, self._names), *biases)
        self.unknowns = Unknowns((EXTRINSIC, *self._keys))
        self._terms = [self.unknowns.column(nuisance_key(name)) for name in self._names]
        self._shared = ordering_of(self.unknowns.keys)
        # 2. Images and matches.
        self._images = _images(matches, state, self.unknowns)
        places = {key: number for number, key in enumerate(self._images.keys)}
        self._frames = [self._frames_of(own, places) for own in matches]
        scalars = [float(values.atVector(key)[0]) for key in self._keys]
        self.start = FrozenPoint(state.cTl, np.array(scalars), self._images.twists)

    @property
    def ordering(self) -> gtsam.Ordering:
        """Order of all unknowns, as in the normal equations, the twists last."""
        return ordering_of((*self.unknowns.keys, *self._images.keys))

    def optimum(self, iterations: int) -> tuple[FrozenPoint, NormalEquations]:
        """By at most so many Levenberg-Marquardt steps from the start; and the problem linearized there."""
        point, damping = self.start, _DAMPING
        system = self.linearized(point)
        for _ in range(iterations):
            while True:
                moved = self.moved(point, *system.step(damping))
                there = self.linearized(moved)
                gain = system.cost - there.cost
                if gain >= 0.0 or abs(gain) < _SMALL * system.cost or damping >= _MOST_DAMPING:
                    break
                damping *= 10.0
            if not gain >= 0.0:
                break
            last, damping = gain < _SMALL * system.cost, max(damping / 10.0, _LEAST_DAMPING)
            point, system = moved, there
            if last:
                break
        return point, system

    def moved(self, point: FrozenPoint, x: FloatArray, twists: FloatArray) -> FrozenPoint:
        """A point after a step, as :meth:`NormalEquations.step` gives it."""
        return FrozenPoint(point.cTl.retract(x[:6]), point.scalars + x[6:], point.twists + twists)

    def state_at(self, point: FrozenPoint) -> State:
        """The state of a point; mask biases of classes and objects that had no match stay."""
        value = dict(zip(self._keys, point.scalars.tolist(), strict=True))
        state = self.state
        return State(
            point.cTl,
            tuple(value[time_offset_key(clock)] for clock in range(len(state.time_offsets_s))),
            {**state.biases_px, **{(d, c): value[bias_key(d, c)] for d, c in self._classes}},
            {**state.object_biases_px, **{(d, t): value[object_bias_key(d, t)] for d, _, t in self._objects}},
            {**state.nuisances, **{name: value[nuisance_key(name)] for name in self._names}},
        )

    def values_at(self, point: FrozenPoint) -> gtsam.Values:
        """A point as values of the graph's variables."""
        values = self._prior_values(point)
        for key, twist in zip(self._images.keys, point.twists, strict=True):
            values.insert(key, twist)
        return values

    def step_sigmas(self, point: FrozenPoint, system: NormalEquations) -> float:
        """Length of the step from the state to a point in extrinsic and offsets, in standard deviations of
        the problem linearized there."""
        clocks = len(self.state.time_offsets_s)
        turned = gtsam.Pose3.Logmap(self.state.cTl.between(point.cTl))
        step = np.concatenate([turned, point.scalars[:clocks] - np.array(self.state.time_offsets_s)])
        covariance = system.covariance()[: 6 + clocks, : 6 + clocks]
        return float(np.sqrt(step @ np.linalg.solve(covariance, step)))

    def linearized(self, point: FrozenPoint) -> NormalEquations:
        """The normal equations at a point, those of the graph of
        :func:`~sst_graph.graph.building.joint_graph`."""
        values = self._prior_values(point)
        H, b = self._priors.linearize(values).hessian(self._shared)
        count, n = len(self._images.keys), len(H)
        system = NormalEquations(
            self.unknowns,
            self._images.keys,
            self._priors.error(values),
            np.array(H),
            -np.asarray(b).reshape(-1),
            np.zeros((count, 6, 6)),
            np.zeros((count, 6)),
            np.zeros((count, 6, n)),
        )
        cost = system.cost + self._add_motion(system, point)
        return replace(system, cost=cost + sum(self._add(frames, system, point) for frames in self._frames))

    def _prior_values(self, point: FrozenPoint) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(EXTRINSIC, point.cTl)
        for key, value in zip(self._keys, point.scalars.reshape(-1, 1), strict=True):
            values.insert(key, value)
        return values

    def _add_motion(self, system: NormalEquations, point: FrozenPoint) -> float:
        """Add the measured twists to the normal equations; their cost."""
        images = self._images
        since_s = point.scalars[images.clocks - 6] - images.offsets_s
        error, by_cTl, by_offset = transferred(
            images.l_twists, images.l_accelerations, since_s[:, None], point.twists, point.cTl, True
        )
        assert by_cTl is not None and by_offset is not None
        weighted = (images.information @ error[:, :, None])[:, :, 0]
        J = np.concatenate([by_cTl, by_offset[:, :, None]], axis=2)
        WJ = images.information @ J
        system.H_twists[:] += images.information
        system.g_twists[:] += weighted
        for own, columns, into in images.by_clock:
            rows = J[own].reshape(-1, 7).T
            system.H[columns[:, None], columns] += rows @ WJ[own].reshape(-1, 7)
            system.g[columns] += rows @ weighted[own].reshape(-1)
            system.H_mixed[into] += WJ[own]
        return 0.5 * float((error * weighted).sum())

    def _add(self, frames: _Frames, system: NormalEquations, point: FrozenPoint) -> float:
        """Add the matches of a drive to the normal equations; their cost."""
        # 1. Weighted rows: those of the motion, the parameters that are estimated, bias, residual.
        evaluated = self._evaluated(frames, point)
        constant = weigh(frames.alignment, evaluated)
        rows = evaluated.rows[:, 0]
        # 2. Of each image the sums of the products of its rows; of the matches that share a bias, with it.
        products = np.empty((len(frames.spans), len(rows), len(rows)))
        for G, (_, start, end) in zip(products, frames.spans, strict=True):
            own = rows[:, start:end]
            np.matmul(own, own.T, out=G)
        cells = np.add.reduceat(rows * rows[-2], frames.cells, axis=1)
        if evaluated.lift is not None:
            lift = evaluated.whole_lift()
            products = lift @ products @ lift.transpose(0, 2, 1)
            cells = (lift[frames.cell_spans] @ cells.T[:, :, None])[:, :, 0].T
        # 3. They belong to the extrinsic, the time offset and the parameters, to the twists,
        places, columns = frames.places, frames.columns
        shared, twist = np.array([*range(7), *range(13, 13 + len(frames.terms))]), slice(7, 13)
        of_shared = products.take(shared, axis=2)
        total = of_shared.sum(axis=0)
        system.H[columns[:, None], columns] += total.take(shared, axis=0)
        system.g[columns] += total[-1]
        system.H_twists[places] += products[:, twist, twist]
        system.g_twists[places] += products[:, twist, -1]
        system.H_mixed[frames.into_mixed] += of_shared[:, twist]
        # and to the biases.
        bias, image_of = frames.biases[frames.cells], frames.images[frames.cells]
        by_bias = np.zeros((len(system.g), len(cells)))
        np.add.at(by_bias, bias, cells.T)
        with_shared = by_bias.take(shared, axis=1)
        system.H[columns] += with_shared.T
        system.H[:, columns] += with_shared
        np.einsum("ii->i", system.H)[...] += by_bias[:, -2]
        system.g[...] += by_bias[:, -1]
        system.H_mixed[image_of, :, bias] += cells[twist].T
        return 0.5 * (float(rows[-1] @ rows[-1]) + constant)

    def _evaluated(self, frames: _Frames, point: FrozenPoint) -> Evaluated:
        """Residuals of a drive's matches and their derivatives, not weighted."""
        time_offset_s, biases_px = float(point.scalars[frames.clock - 6]), point.scalars[frames.biases - 6]
        twists = point.twists[frames.places]
        evaluated = frames.groups.evaluate(frames.alignment, point.cTl, time_offset_s, twists, biases_px)
        if not self._terms:
            return evaluated
        steps = point.scalars[np.array(self._terms) - 6] - frames.terms_at
        return evaluated.with_terms(frames.terms, steps, True)

    def _frames_of(self, matches: DriveMatches, places: dict[int, int]) -> _Frames:
        number = matches.number
        pairs = [twist_key(number, pair.image) for pair in matches.pairs]
        images = np.array([places.get(key, -1) for key in pairs])[matches.pair_of]
        biases = _bias_columns(matches, self.unknowns)
        order = np.lexsort((biases, images))
        terms = (
            np.stack([matches.terms[name] for name in self._names])
            if self._names
            else np.zeros((0, len(order)))
        )
        clock = self.unknowns.column(time_offset_key(self.state.clock(number)))
        terms_at = np.array([self.state.nuisances.get(name, 0.0) for name in self._names])
        alignment, images, biases = matches.alignment.take(order), images[order], biases[order]
        return _Frames(alignment, images, biases, clock, self._terms, terms[:, order], terms_at)


def _bias_columns(matches: DriveMatches, unknowns: Unknowns) -> IntArray:
    """(m,) column of the mask bias of each match."""
    number = matches.number
    if matches.tracks is None:
        of_groups = [unknowns.column(bias_key(number, c)) for c in matches.group_classes]
        return np.repeat(of_groups, matches.counts)
    tracks, which = np.unique(matches.tracks, return_inverse=True)
    columns = [unknowns.column(object_bias_key(number, track)) for track in tracks.tolist()]
    return np.array(columns)[which.reshape(-1)]


def _images(matches: Sequence[DriveMatches], state: State, unknowns: Unknowns) -> _Images:
    """The images that have matches, drive by drive."""
    parts = []
    for own in matches:
        # Scans that share an image share its twist.
        first: dict[int, int] = {}
        for p in own.paired:
            first.setdefault(own.pairs[p].image, p)
        pairs, k = list(first.values()), len(first)
        samples, clock = own.motions.l_twists, unknowns.column(time_offset_key(state.clock(own.number)))
        if samples is None:
            l_twists = l_accelerations = np.zeros((k, 6))
            information = np.tile(np.diag(UNKNOWN_TWIST_SIGMAS**-2.0), (k, 1, 1))
        else:
            l_twists, l_accelerations = samples.twists[pairs], samples.accelerations[pairs]
            covariances = camera_covariances(samples.covariances[pairs], state.cTl)
            information = np.asarray(np.linalg.inv(covariances), np.float64)
        keys = [twist_key(own.number, image) for image in first]
        offsets_s = np.full(k, own.at.time_offset_s)
        parts.append(
            (keys, own.c_twists[pairs], l_twists, l_accelerations, information, np.full(k, clock), offsets_s)
        )
    keys, *arrays = zip(*parts, strict=True)
    return _Images(tuple(key for own in keys for key in own), *(np.concatenate(each) for each in arrays))
