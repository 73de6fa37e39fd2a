"""Gaussians on extrinsic, time offset, mask biases and estimated parameters of assumptions, in information
form about a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise

import gtsam
import numpy as np

from sst_graph.errors import EstimationError
from sst_graph.factors import custom_factor
from sst_graph.graph.linear import scaled_inverse, scattered
from sst_graph.graph.state import State, lower_edge_track
from sst_graph.types import FloatArray, IntArray, SemanticClass


@dataclass(frozen=True)
class Point:
    """A value of the unknowns; tangent order [extrinsic 6, offset 1, biases, parameters, object biases].

    Attributes:
        cTl: extrinsic.
        time_offset_s: time offset [s].
        biases_px: (2 c,) mask bias of each class, then that of each class's lower edges [px].
        tracks: objects with a mask bias of their own, by the number of their track.
        object_biases_px: (k,) those biases [px].
        names: assumptions whose parameters are estimated.
        parameters: (p,) the values of these parameters, in their units.
    """

    cTl: gtsam.Pose3
    time_offset_s: float
    biases_px: FloatArray
    tracks: tuple[int, ...] = ()
    object_biases_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    names: tuple[str, ...] = ()
    parameters: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def unbiased(
        cls,
        cTl: gtsam.Pose3,
        time_offset_s: float,
        classes: Sequence[SemanticClass],
        names: Sequence[str] = (),
    ) -> Point:
        """With mask biases of 0, and parameters of 0 by these names."""
        nothing = np.zeros(len(names))
        return cls(cTl, time_offset_s, np.zeros(2 * len(classes)), names=tuple(names), parameters=nothing)

    @classmethod
    def of_state(cls, state: State, classes: Sequence[SemanticClass], names: Sequence[str]) -> Point:
        """A state of one drive, lower edges with the biases of their classes; names: of its parameters."""
        biases = [state.biases_px.get((0, c), 0.0) for c in classes]
        parameters = np.array([state.nuisances.get(name, 0.0) for name in names])
        offset_s = state.time_offset_s(0)
        return cls(state.cTl, offset_s, np.array(2 * biases), names=tuple(names), parameters=parameters)

    @property
    def size(self) -> int:
        return self.core_size + len(self.tracks)

    @property
    def core_size(self) -> int:
        """Unknowns before the objects' biases."""
        return 7 + len(self.biases_px) + len(self.parameters)

    @property
    def parameter_columns(self) -> range:
        """Columns of the estimated parameters."""
        return range(7 + len(self.biases_px), self.core_size)

    def columns(self, tracks: Sequence[int], held: int = 0) -> IntArray:
        """Columns of [extrinsic, offset, biases, parameters, these objects' biases, and ``held`` further ones
        that are behind all]; not to be written to."""
        return _columns(self.core_size, self.tracks, tuple(tracks), held)

    def seen(self, places: Mapping[int, int]) -> Point:
        """The point with just these objects; one that has no bias yet takes its class's.

        Args:
            places: place of its class's bias by the number of the track.
        """
        known = dict(zip(self.tracks, self.object_biases_px.tolist(), strict=True))
        biases = [known.get(track, float(self.biases_px[place])) for track, place in places.items()]
        return replace(self, tracks=tuple(places), object_biases_px=np.array(biases))

    def with_objects(self, places: Mapping[int, int]) -> Point:
        """The point with further objects, as :meth:`seen` has them."""
        return self.seen({**dict.fromkeys(self.tracks, 0), **places})

    def core(self) -> Point:
        """The point without objects."""
        return self.seen({})

    def local(self, other: Point) -> FloatArray:
        """(n,) step from here to another point, over the objects that are known here."""
        turn = gtsam.Pose3.Logmap(self.cTl.between(other.cTl))
        theirs = other.object_biases_px
        if other.tracks != self.tracks:
            theirs = theirs[other.columns(self.tracks)[other.core_size :] - other.core_size]
        return np.concatenate(
            [
                turn,
                [other.time_offset_s - self.time_offset_s],
                np.subtract(other.biases_px, self.biases_px),
                np.subtract(other.parameters, self.parameters),
                theirs - self.object_biases_px,
            ]
        )

    def moved(self, step: FloatArray) -> Point:
        """The point a step (n,) away."""
        return replace(
            self,
            cTl=self.cTl.compose(gtsam.Pose3.Expmap(step[:6])),
            time_offset_s=self.time_offset_s + float(step[6]),
            biases_px=self.biases_px + step[7 : 7 + len(self.biases_px)],
            parameters=self.parameters + step[7 + len(self.biases_px) : self.core_size],
            object_biases_px=self.object_biases_px + step[self.core_size :],
        )

    def state(self, classes: Sequence[SemanticClass]) -> State:
        """As the state that matches are made at."""
        of_class, below = np.split(self.biases_px, 2)
        biases = {(0, c): float(bias) for c, bias in zip(classes, of_class, strict=True)}
        shared = {(0, lower_edge_track(c)): float(bias) for c, bias in zip(classes, below, strict=True)}
        return State(self.cTl, (self.time_offset_s,), biases, shared, self.nuisances)

    @property
    def nuisances(self) -> dict[str, float]:
        """The estimated parameters by name."""
        return dict(zip(self.names, self.parameters.tolist(), strict=True))


@dataclass(frozen=True)
class Gaussian:
    """exp(-1/2 d' information d + vector' d) of the step d from a point.

    Behind the unknowns there may be parameters that are held at 0, those of assumptions that are not
    estimated: the information that the data have on them is kept with that on the unknowns.

    Attributes:
        point: where it was linearized.
        information: (n, n) of the unknowns, then of what is held.
        vector: (n,).
    """

    point: Point
    information: FloatArray
    vector: FloatArray

    @property
    def held(self) -> int:
        """How many parameters are held."""
        return len(self.vector) - self.point.size

    def without_held(self) -> Gaussian:
        """On the unknowns alone, the held parameters at 0."""
        n = self.point.size
        return self if self.held == 0 else Gaussian(self.point, self.information[:n, :n], self.vector[:n])

    def holding(self, count: int) -> Gaussian:
        """With so many parameters held on which there is no information yet."""
        n = len(self.vector)
        information = np.zeros((n + count, n + count))
        information[:n, :n] = self.information
        return Gaussian(self.point, information, np.append(self.vector, np.zeros(count)))

    def at(self, point: Point) -> Gaussian:
        """The Gaussian about another, near point; objects that are new there are left out."""
        known = self.point.tracks
        if point.tracks != known:
            point = replace(point, tracks=known, object_biases_px=_picked(point, known))
        moved = self.information[:, : self.point.size] @ self.point.local(point)
        return Gaussian(point, self.information, self.vector - moved)

    def plus(self, other: Gaussian) -> Gaussian:
        """Both together, about this one's point; the objects of the other are all known here.

        What is held is what this one holds, or nothing.
        """
        return Gaussian(self.point, self.information_with([other]), self.vector_with([other]))

    def information_with(self, others: Sequence[Gaussian]) -> FloatArray:
        """(n, n) information of this and others, whose objects are all known here."""
        others = others if self.held else [other.without_held() for other in others]
        columns = [self.point.columns(other.point.tracks, other.held) for other in others]
        return self.information + scattered(len(self.vector), columns, [o.information for o in others])[0]

    def vector_with(self, others: Sequence[Gaussian]) -> FloatArray:
        """(n,) vector of the same, about this one's point."""
        vector = self.vector.copy()
        for other in others if self.held else [other.without_held() for other in others]:
            vector[self.point.columns(other.point.tracks, other.held)] += other.at(self.point).vector
        return vector

    def with_objects(self, places: Mapping[int, int], sigma_px: float) -> Gaussian:
        """With biases of further objects, each within ``sigma_px`` of its class's.

        Args:
            places: place of its class's bias by the number of the track.
        """
        if not places:
            return self
        point, n, size = self.point.with_objects(places), self.point.size, len(self.vector) + len(places)
        information, vector = np.zeros((size, size)), np.zeros(size)
        before = np.array([*range(n), *range(point.size, size)])
        information[np.ix_(before, before)], vector[before] = self.information, self.vector
        weight = sigma_px**-2.0
        for i, place in enumerate(places.values()):
            a, b = 7 + place, n + i
            information[a, a] += weight
            information[b, b] += weight
            information[a, b] = information[b, a] = -weight
        return Gaussian(point, information, vector)

    def without(self, tracks: Sequence[int]) -> tuple[Gaussian, FloatArray]:
        """With some objects' biases marginalized out, and how scores follow.

        Returns:
            the Gaussian; T (m, n) = [I, -H_xo H_oo^-1]: a score (n,) of the whole becomes T times it in the
            smaller one.
        """
        kept = [track for track in self.point.tracks if track not in set(tracks)]
        x = self.point.columns(kept, self.held)
        o = np.setdiff1d(np.arange(len(self.vector)), x)
        T = np.zeros((len(x), len(self.vector)))
        T[np.arange(len(x)), x] = 1.0
        H = self.information
        T[:, o] = -np.linalg.solve(H[np.ix_(o, o)], H[np.ix_(o, x)]).T
        point = replace(self.point, tracks=tuple(kept), object_biases_px=_picked(self.point, kept))
        information = T @ H[:, x]
        return Gaussian(point, 0.5 * (information + information.T), T @ self.vector), T

    def transition(self, variances: FloatArray) -> FloatArray:
        """A (n, n) = (I + information Q)^-1 of a random walk, Q = diag(variances (m,), 0): the rest stays."""
        Q = np.zeros(len(self.vector))
        Q[: len(variances)] = variances
        return np.asarray(np.linalg.inv(np.eye(len(Q)) + self.information * Q[None, :]))

    def drifted(self, variances: FloatArray) -> Gaussian:
        """After a random walk of the unknowns."""
        A = self.transition(variances)
        information = A @ self.information
        return Gaussian(self.point, 0.5 * (information + information.T), A @ self.vector)

    def mean(self) -> Point:
        """The most likely value; nothing is held."""
        return self.point.moved(scaled_inverse(self.information) @ self.vector)

    def factor(self, keys: Sequence[int]) -> gtsam.LinearContainerFactor:
        """As a factor on [extrinsic, offset, biases..., parameters..., object biases...]; it can be pickled.

        Nothing is held.
        """
        n, starts = self.point.size, [0, 6, *range(7, self.point.size + 1)]
        scale = np.sqrt(np.maximum(np.diag(self.information), 1e-30))
        R = np.linalg.cholesky(self.information / np.outer(scale, scale) + 1e-14 * np.eye(n)).T
        b = np.linalg.solve(R.T, self.vector / scale)
        R = R * scale
        blocks = [np.asarray(R[:, start:end], np.float64) for start, end in pairwise(starts)]
        error = np.asarray(-b, np.float64)

        def linear(*_: object, jacobians: bool) -> tuple[FloatArray, list[FloatArray] | None]:
            return error, blocks if jacobians else None

        values = gtsam.Values()
        insert_point(values, keys, self.point)
        dims = [end - start for start, end in pairwise(starts)]
        factor = custom_factor(gtsam.noiseModel.Unit.Create(n), keys, linear, dims, n)
        return gtsam.LinearContainerFactor(factor.linearize(values), values)


def inverted(information: FloatArray) -> FloatArray:
    """(n, n) covariance of independent matches from their information.

    Raises:
        EstimationError: a direction without any information.
    """
    try:
        return scaled_inverse(information)
    except np.linalg.LinAlgError as error:
        raise EstimationError(str(error)) from error


@lru_cache(maxsize=4096)
def _columns(core: int, known: tuple[int, ...], chosen: tuple[int, ...], held: int) -> IntArray:
    """Cached: each frame needs those of the whole window, and few of them are new."""
    objects, size = [core + known.index(track) for track in chosen], core + len(known)
    return np.array([*range(core), *objects, *range(size, size + held)], dtype=np.intp)


def with_room(before: int, after: int, held: int) -> FloatArray:
    """T (after + held, before + held) from some unknowns to more of them, before what is held."""
    T = np.zeros((after + held, before + held))
    T[:before, :before] = np.eye(before)
    T[after:, before:] = np.eye(held)
    return T


def core_steps(points: Sequence[Point], to: Point) -> FloatArray:
    """(k, m) steps from each point to another, over [extrinsic, offset, biases, parameters]."""
    turns = np.array([gtsam.Pose3.Logmap(point.cTl.between(to.cTl)) for point in points]).reshape(-1, 6)
    offsets = np.array([to.time_offset_s - point.time_offset_s for point in points])
    biases = np.array([point.biases_px for point in points]).reshape(len(turns), -1)
    parameters = np.array([point.parameters for point in points]).reshape(len(turns), -1)
    return np.column_stack([turns, offsets, to.biases_px - biases, to.parameters - parameters])


def _picked(point: Point, tracks: Sequence[int]) -> FloatArray:
    """(k,) biases of some objects of a point [px]."""
    return point.object_biases_px[point.columns(tracks)[point.core_size :] - point.core_size]


def insert_point(values: gtsam.Values, keys: Sequence[int], point: Point) -> None:
    """Put a point into values under [extrinsic, offset, biases, parameters, object biases], where a key is
    not there yet."""
    scalars = [point.time_offset_s, *point.biases_px, *point.parameters, *point.object_biases_px]
    if not values.exists(keys[0]):
        values.insert(keys[0], point.cTl)
    for key, scalar in zip(keys[1:], scalars, strict=True):
        if not values.exists(key):
            values.insert(key, np.array([float(scalar)]))
