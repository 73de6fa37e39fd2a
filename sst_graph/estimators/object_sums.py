"""What each object says, frame by frame, for the jackknife over objects of the batch's covariance.

Objects of the window, and those that may be seen again, are kept one by one; of those gone for good only the
square of the step that the estimate would take without them.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sst_graph.estimators.gaussian import Gaussian, Point, core_steps
from sst_graph.uncertainty.object_spread import ObjectSpread, growth_without

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class ObjectBeliefs:
    """The matches of each object of a frame alone, on extrinsic, offset, mask biases, parameters, its own
    bias if any, and what the frame's belief holds.

    Attributes:
        point: where the frame is linearized.
        tracks: (k) the objects' tracks.
        information, vector: (k, m, m), (k, m) as of :class:`~sst_graph.estimators.gaussian.Gaussian`.
        biases_px: (k,) the objects' own biases at the point; empty where they have none.
        weights: (k,) sum of the robust weights of the objects' matches.
    """

    point: Point
    tracks: tuple[int, ...]
    information: FloatArray
    vector: FloatArray
    biases_px: FloatArray
    weights: FloatArray

    @classmethod
    def of(
        cls, J: FloatArray, r: FloatArray, roots: FloatArray, track: NDArray[np.intp], point: Point
    ) -> ObjectBeliefs:
        """From weighted rows J (m, n) at a point, of the unknowns and what is held, and residuals, roots of
        the weights, tracks (m,)."""
        order = np.argsort(track, kind="stable")
        bounds = [0, *(np.flatnonzero(np.diff(track[order])) + 1).tolist(), len(track)]
        rows, residuals = J[order, : point.core_size], r[order]
        names = tuple(track[order[bounds[:-1]]].tolist())
        biases = np.zeros(0)
        if point.tracks:
            places = np.array([point.tracks.index(name) for name in names])
            own = J[order, np.repeat(point.core_size + places, np.diff(bounds))]
            rows, biases = np.column_stack([rows, own]), point.object_biases_px[places]
        rows = np.column_stack([rows, J[order, point.size :]])
        parts = [slice(start, end) for start, end in pairwise(bounds)]
        information = np.array([rows[part].T @ rows[part] for part in parts])
        vector = np.array([-rows[part].T @ residuals[part] for part in parts])
        weights = np.add.reduceat(roots[order] ** 2, bounds[:-1])
        return cls(point, names, information, vector, biases, weights)

    def one_by_one(self) -> dict[int, ObjectBelief]:
        """By track."""
        return {
            track: ObjectBelief(
                Gaussian(_restricted(self.point, track), self.information[k], self.vector[k]),
                float(self.weights[k]),
            )
            for k, track in enumerate(self.tracks)
        }

    @classmethod
    def single(cls, track: int, own: ObjectBelief) -> ObjectBeliefs:
        """One object."""
        belief, biases = own.belief, own.belief.point.object_biases_px
        weights = np.array([own.weight])
        return cls(belief.point, (track,), belief.information[None], belief.vector[None], biases, weights)


@dataclass(frozen=True)
class ObjectBelief:
    """The matches of one object in many frames, and the sum of their robust weights."""

    belief: Gaussian
    weight: float

    def plus(self, other: ObjectBelief) -> ObjectBelief:
        """These matches and others."""
        return ObjectBelief(self.belief.plus(other.belief), self.weight + other.weight)


@dataclass
class ObjectSums:
    """Of frames that have left the window; matrices in the columns of the belief that took them in.

    Attributes:
        closed: (n, n) sum of squared scores that stand for the objects gone, over the unknowns.
        scores, total: (n + k, n + k), (n + k,) sums of the squares of their scores as they are, and of the
            scores; what the belief holds included.
        count: how many they are.
        weight, weight2: sums of their weights, and of the squares.
        live: the matches of each other object alone, by its track.
    """

    closed: FloatArray
    scores: FloatArray
    total: FloatArray
    count: int = 0
    weight: float = 0.0
    weight2: float = 0.0
    live: dict[int, ObjectBelief] = field(default_factory=dict)

    @classmethod
    def empty(cls, n: int, held: int = 0) -> ObjectSums:
        """n: unknowns; held: further parameters."""
        return cls(np.zeros((n, n)), np.zeros((n + held, n + held)), np.zeros(n + held))

    def add(self, objects: ObjectBeliefs) -> None:
        """Take in the objects of a frame."""
        for track, own in objects.one_by_one().items():
            self.live[track] = self.live[track].plus(own) if track in self.live else own

    def transform(self, T: FloatArray) -> None:
        """Follow the belief to other unknowns, by T over these and what is held."""
        held = len(self.scores) - len(self.closed)
        own = T[: len(T) - held, : T.shape[1] - held]
        self.closed, self.scores = own @ self.closed @ own.T, T @ self.scores @ T.T
        self.total = T @ self.total

    def close(self, seen: Container[int], information: FloatArray, naive: FloatArray, point: Point) -> None:
        """Forget the objects that are not ``seen`` any more, but not what leaving them out would change.

        Args:
            information, naive: (n, n) of everything, and its inverse.
            point: the estimate.
        """
        gone = {track: self.live.pop(track) for track in list(self.live) if track not in seen}
        if not gone:
            return
        beliefs = [ObjectBeliefs.single(track, own) for track, own in gone.items()]
        held = len(self.scores) - len(self.closed)
        tracks, informations, vectors = _summed(beliefs, point, held)
        m = informations.shape[1] - held
        steps = _steps_without(tracks, informations[:, :m, :m], vectors[:, :m], naive, point)
        scores = steps @ information
        self.closed = self.closed + scores.T @ scores
        rows = np.zeros((len(tracks), len(self.scores)))
        np.put_along_axis(rows, _places(tracks, point, m, held), vectors, axis=1)
        self.scores, self.total = self.scores + rows.T @ rows, self.total + rows.sum(axis=0)
        self.count += len(gone)
        self.weight += sum(own.weight for own in gone.values())
        self.weight2 += sum(own.weight**2 for own in gone.values())

    def spread(self, window: Sequence[ObjectBeliefs], naive: FloatArray, point: Point) -> ObjectSpread:
        """How the estimate varies with the objects.

        Args:
            window: objects of the frames beside those taken in.
            naive: (n, n) inverse of all information.
            point: the estimate.
        """
        beliefs = [*(ObjectBeliefs.single(track, own) for track, own in self.live.items()), *window]
        squares, count = naive @ self.closed @ naive, self.count
        weight, weight2 = self.weight, self.weight2
        if beliefs:
            tracks, informations, vectors = _summed(beliefs, point)
            steps = _steps_without(tracks, informations, vectors, naive, point)
            squares, count = squares + steps.T @ steps, count + len(tracks)
            weights = _weights_by_track(beliefs)
            weight, weight2 = weight + float(weights.sum()), weight2 + float(weights @ weights)
        return ObjectSpread.from_sums(squares, count, weight, weight2)

    def score_spread(
        self,
        window: Sequence[ObjectBeliefs],
        point: Point,
        directions: FloatArray,
        information: FloatArray,
        values: FloatArray,
    ) -> tuple[ObjectSpread, ...]:
        """How estimates of single parameters, all unknowns free, vary with the objects.

        What an object says is compared with its share of the estimate. The shares of objects that are gone
        are not kept: they are taken for alike.

        Args:
            window: objects of the frames beside those taken in.
            point: the estimate without these parameters.
            directions: (n + k, p) what each parameter's score takes of the scores of unknowns and held ones.
            information: (p,) of each parameter, all unknowns free.
            values: (p,) the estimates of the parameters.
        """
        beliefs = [*(ObjectBeliefs.single(track, own) for track, own in self.live.items()), *window]
        about = self.scores - np.outer(self.total, self.total) / max(self.count, 1)
        squares = np.einsum("np,nm,mp->p", directions, about, directions) / information**2
        count, weight, weight2 = self.count, self.weight, self.weight2
        if beliefs:
            held = len(self.scores) - len(self.closed)
            tracks, informations, vectors = _summed(beliefs, point, held)
            own = directions[_places(tracks, point, vectors.shape[1] - held, held)]
            shares = np.einsum("oip,oij,ojp->op", own, informations, own, optimize=True) / information
            alone = np.einsum("oip,oi->op", own, vectors) / information
            steps = (alone - shares * values) * growth_without(shares)
            squares, count = squares + (steps**2).sum(axis=0), count + len(tracks)
            weights = _weights_by_track(beliefs)
            weight, weight2 = weight + float(weights.sum()), weight2 + float(weights @ weights)
        return tuple(
            ObjectSpread.from_sums(np.array([[square]]), count, weight, weight2) for square in squares
        )

    def copy(self) -> ObjectSums:
        return replace(self, live=dict(self.live))


def _restricted(point: Point, track: int) -> Point:
    """A point with one object's bias, or none where it has none of its own."""
    return point.seen({track: 0}) if track in point.tracks else point.core()


def _weights_by_track(beliefs: Sequence[ObjectBeliefs]) -> FloatArray:
    """Weight of each object, summed over its frames."""
    tracks = np.concatenate([part.tracks for part in beliefs])
    weights = np.concatenate([part.weights for part in beliefs])
    return np.asarray(np.bincount(np.unique(tracks, return_inverse=True)[1].reshape(-1), weights))


def _summed(
    beliefs: Sequence[ObjectBeliefs], point: Point, held: int = 0
) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
    """(k) tracks, (k, m, m) informations and (k, m) vectors about a point, summed object by object.

    Args:
        held: how many of the held parameters are asked for: all or none.
    """
    counts = [len(part.tracks) for part in beliefs]
    by_object = any(len(part.biases_px) > 0 for part in beliefs)
    m = point.core_size + by_object
    information = np.concatenate([part.information[:, : m + held, : m + held] for part in beliefs])
    tracks = np.concatenate([part.tracks for part in beliefs])
    steps = np.repeat(core_steps([part.point for part in beliefs], point), counts, axis=0)
    if by_object:
        before = np.concatenate([part.biases_px for part in beliefs])
        known = dict(zip(point.tracks, point.object_biases_px.tolist(), strict=True))
        now = [known.get(track, bias) for track, bias in zip(tracks.tolist(), before.tolist(), strict=True)]
        steps = np.column_stack([steps, now - before])
    moved = (information[:, :, :m] @ steps[:, :, None])[:, :, 0]
    vectors = np.concatenate([part.vector[:, : m + held] for part in beliefs]) - moved
    order = np.argsort(tracks, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(tracks[order])) + 1)
    names = tuple(tracks[order[firsts]].tolist())
    return names, np.add.reduceat(information[order], firsts), np.add.reduceat(vectors[order], firsts)


def _places(tracks: Sequence[int], point: Point, unknowns: int, held: int = 0) -> IntArray:
    """(k, m) columns of objects: [extrinsic, offset, biases, parameters, its own bias if any, held ones]."""
    core, size = point.core_size, point.size
    own = [[core + point.tracks.index(track)] if unknowns > core else [] for track in tracks]
    return np.array([[*range(core), *bias, *range(size, size + held)] for bias in own], dtype=np.intp)


def _steps_without(
    tracks: Sequence[int], informations: FloatArray, vectors: FloatArray, naive: FloatArray, point: Point
) -> FloatArray:
    """(k, n) how far the linearized estimate moves without each of the objects.

    As :func:`~sst_graph.uncertainty.covariance.step_without` in the few columns of an object: with p its
    information, s its score there, and naive = C C' on them, f(p C C') = C^-T f(C' p C) C'.
    """
    sigmas, m = np.sqrt(np.diag(naive)), informations.shape[1]
    places = _places(tracks, point, m)
    scaled = naive / np.outer(sigmas, sigmas)
    scale = sigmas[places]
    C = np.linalg.cholesky(scaled[places[:, :, None], places[:, None, :]] + 1e-14 * np.eye(m))
    p = informations * (scale[:, :, None] * scale[:, None, :])
    Ct = np.swapaxes(C, 1, 2)
    shares, axes = np.linalg.eigh(Ct @ p @ C)
    score = np.swapaxes(axes, 1, 2) @ (Ct @ (-vectors * scale)[:, :, None])
    moved = np.linalg.solve(Ct, axes @ (growth_without(shares)[:, :, None] * score))
    return np.asarray((np.swapaxes(moved, 1, 2) @ scaled[places])[:, 0, :] * sigmas)
