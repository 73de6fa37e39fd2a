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

from sst_graph.covariance.jackknife import ObjectSpread, growth_without
from sst_graph.tracker.window.gaussian import Gaussian, Point, core_steps

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectInformation:
    """The matches of each object of a frame alone, on extrinsic, offset, mask biases, parameters and its own
    bias if any.

    Attributes:
        point: where the frame is linearized.
        tracks: (k) the objects' tracks.
        information, vector: (k, m, m), (k, m) as of :class:`~sst_graph.tracker.window.gaussian.Gaussian`.
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
    ) -> ObjectInformation:
        """From weighted rows J (m, n) at a point, and residuals, roots of the weights, tracks (m,)."""
        order = np.argsort(track, kind="stable")
        bounds = [0, *(np.flatnonzero(np.diff(track[order])) + 1).tolist(), len(track)]
        rows, residuals = J[order, : point.core_size], r[order]
        names = tuple(track[order[bounds[:-1]]].tolist())
        biases = np.zeros(0)
        if point.tracks:
            places = np.array([point.tracks.index(name) for name in names])
            own = J[order, np.repeat(point.core_size + places, np.diff(bounds))]
            rows, biases = np.column_stack([rows, own]), point.object_biases_px[places]
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
    def single(cls, track: int, own: ObjectBelief) -> ObjectInformation:
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
        closed: (n, n) sum of squared scores that stand for the objects gone.
        count: how many they are.
        weight, weight2: sums of their weights, and of the squares.
        live: the matches of each other object alone, by its track.
    """

    closed: FloatArray
    count: int = 0
    weight: float = 0.0
    weight2: float = 0.0
    live: dict[int, ObjectBelief] = field(default_factory=dict)

    @classmethod
    def empty(cls, n: int) -> ObjectSums:
        """Nothing yet, over n unknowns."""
        return cls(np.zeros((n, n)))

    def add(self, objects: ObjectInformation) -> None:
        """Take in the objects of a frame."""
        for track, own in objects.one_by_one().items():
            self.live[track] = self.live[track].plus(own) if track in self.live else own

    def transform(self, T: FloatArray) -> None:
        """Follow the belief to other unknowns."""
        self.closed = T @ self.closed @ T.T

    def close(self, seen: Container[int], information: FloatArray, naive: FloatArray, point: Point) -> None:
        """Forget the objects that are not ``seen`` any more, but not what leaving them out would change.

        Args:
            information, naive: (n, n) of everything, and its inverse.
            point: the estimate.
        """
        gone = {track: self.live.pop(track) for track in list(self.live) if track not in seen}
        if not gone:
            return
        beliefs = [ObjectInformation.single(track, own) for track, own in gone.items()]
        steps = _steps_without(*_summed(beliefs, point), naive, point)
        scores = steps @ information
        self.closed = self.closed + scores.T @ scores
        self.count += len(gone)
        self.weight += sum(own.weight for own in gone.values())
        self.weight2 += sum(own.weight**2 for own in gone.values())

    def spread(self, window: Sequence[ObjectInformation], naive: FloatArray, point: Point) -> ObjectSpread:
        """How the estimate varies with the objects.

        Args:
            window: objects of the frames beside those taken in.
            naive: (n, n) inverse of all information.
            point: the estimate.
        """
        beliefs = [*(ObjectInformation.single(track, own) for track, own in self.live.items()), *window]
        squares, count = naive @ self.closed @ naive, self.count
        weight, weight2 = self.weight, self.weight2
        if beliefs:
            tracks, informations, vectors = _summed(beliefs, point)
            steps = _steps_without(tracks, informations, vectors, naive, point)
            squares, count = squares + steps.T @ steps, count + len(tracks)
            weights = _weights_by_track(beliefs)
            weight, weight2 = weight + float(weights.sum()), weight2 + float(weights @ weights)
        return ObjectSpread.from_sums(squares, count, weight, weight2)

    def copy(self) -> ObjectSums:
        return replace(self, live=dict(self.live))


def _restricted(point: Point, track: int) -> Point:
    """A point with one object's bias, or none where it has none of its own."""
    return point.seen({track: 0}) if track in point.tracks else point.core()


def _weights_by_track(beliefs: Sequence[ObjectInformation]) -> FloatArray:
    """Weight of each object, summed over its frames."""
    tracks = np.concatenate([part.tracks for part in beliefs])
    weights = np.concatenate([part.weights for part in beliefs])
    return np.asarray(np.bincount(np.unique(tracks, return_inverse=True)[1].reshape(-1), weights))


def _summed(
    beliefs: Sequence[ObjectInformation], point: Point
) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
    """(k) tracks, (k, m, m) informations and (k, m) vectors about a point, summed object by object."""
    counts = [len(part.tracks) for part in beliefs]
    information = np.concatenate([part.information for part in beliefs])
    tracks = np.concatenate([part.tracks for part in beliefs])
    steps = np.repeat(core_steps([part.point for part in beliefs], point), counts, axis=0)
    if information.shape[1] > steps.shape[1]:
        before = np.concatenate([part.biases_px for part in beliefs])
        known = dict(zip(point.tracks, point.object_biases_px.tolist(), strict=True))
        now = [known.get(track, bias) for track, bias in zip(tracks.tolist(), before.tolist(), strict=True)]
        steps = np.column_stack([steps, now - before])
    moved = (information @ steps[:, :, None])[:, :, 0]
    vectors = np.concatenate([part.vector for part in beliefs]) - moved
    order = np.argsort(tracks, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(tracks[order])) + 1)
    names = tuple(tracks[order[firsts]].tolist())
    return names, np.add.reduceat(information[order], firsts), np.add.reduceat(vectors[order], firsts)


def _steps_without(
    tracks: Sequence[int], informations: FloatArray, vectors: FloatArray, naive: FloatArray, point: Point
) -> FloatArray:
    """(k, n) how far the linearized estimate moves without each of the objects.

    As :func:`~sst_graph.covariance.cluster_robust.step_without` in the few columns of an object: with p its
    information, s its score there, and naive = C C' on them, f(p C C') = C^-T f(C' p C) C'.
    """
    sigmas, m = np.sqrt(np.diag(naive)), informations.shape[1]
    core = point.core_size
    places = np.array([[*range(core), *([core + point.tracks.index(t)] if m > core else [])] for t in tracks])
    scaled = naive / np.outer(sigmas, sigmas)
    scale = sigmas[places]
    C = np.linalg.cholesky(scaled[places[:, :, None], places[:, None, :]] + 1e-14 * np.eye(m))
    p = informations * (scale[:, :, None] * scale[:, None, :])
    Ct = np.swapaxes(C, 1, 2)
    shares, axes = np.linalg.eigh(Ct @ p @ C)
    score = np.swapaxes(axes, 1, 2) @ (Ct @ (-vectors * scale)[:, :, None])
    moved = np.linalg.solve(Ct, axes @ (growth_without(shares)[:, :, None] * score))
    return np.asarray((np.swapaxes(moved, 1, 2) @ scaled[places])[:, 0, :] * sigmas)
