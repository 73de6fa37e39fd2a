"""The matches of each object by themselves, frame by frame, for the jackknife over objects.

Objects of the window, and those that may be seen again, are kept one by one; of those gone for good only the
square of the step that the estimate would take without them.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.jackknife import ObjectSpread, steps_without
from sst_graph.tracker.window.gaussian import Gaussian, Point, core_steps
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class ObjectInformation:
    """The matches of each object of a frame by themselves, on extrinsic, offset, mask biases, parameters and
    the object's own bias if it has one.

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

    @classmethod
    def single(cls, track: int, own: SingleObject) -> ObjectInformation:
        """One object."""
        gaussian, biases = own.gaussian, own.gaussian.point.object_biases_px
        weights = np.array([own.weight])
        return cls(
            gaussian.point, (track,), gaussian.information[None], gaussian.vector[None], biases, weights
        )


@dataclass(frozen=True)
class SingleObject:
    """The matches of one object in many frames, and the sum of their robust weights."""

    gaussian: Gaussian
    weight: float

    def plus(self, other: SingleObject) -> SingleObject:
        """The sums over these matches and over others of the object."""
        return SingleObject(self.gaussian.plus(other.gaussian), self.weight + other.weight)


@dataclass
class ObjectSums:
    """Sums over frames that have left the window; matrices in the columns of the Gaussian that holds them.

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
    live: dict[int, SingleObject] = field(default_factory=dict)

    @classmethod
    def empty(cls, n: int) -> ObjectSums:
        """Nothing yet, over n unknowns."""
        return cls(np.zeros((n, n)))

    def add(self, objects: ObjectInformation) -> None:
        """Add the objects of a frame."""
        for k, track in enumerate(objects.tracks):
            # With its own bias, if it has one.
            point = objects.point.seen({track: 0} if track in objects.point.tracks else {})
            matches = Gaussian(point, objects.information[k], objects.vector[k])
            own = SingleObject(matches, float(objects.weights[k]))
            self.live[track] = self.live[track].plus(own) if track in self.live else own

    def transform(self, T: FloatArray) -> None:
        """Follow the Gaussian to other unknowns."""
        self.closed = T @ self.closed @ T.T

    def close(self, seen: Container[int], information: FloatArray, naive: FloatArray, point: Point) -> None:
        """Drop the objects that are not ``seen``, but keep their jackknife steps in the sums.

        Args:
            information, naive: (n, n) of everything, and its inverse.
            point: the estimate.
        """
        gone = {track: self.live.pop(track) for track in list(self.live) if track not in seen}
        if not gone:
            return
        parts = [ObjectInformation.single(track, own) for track, own in gone.items()]
        steps = _steps_without(*_summed(parts, point), naive, point)
        scores = steps @ information
        self.closed = self.closed + scores.T @ scores
        self.count += len(gone)
        self.weight += sum(own.weight for own in gone.values())
        self.weight2 += sum(own.weight**2 for own in gone.values())

    def spread(self, window: Sequence[ObjectInformation], naive: FloatArray, point: Point) -> ObjectSpread:
        """The spread of the estimate over the objects.

        Args:
            window: objects of the frames beside those added.
            naive: (n, n) inverse of all information.
            point: the estimate.
        """
        parts = [*(ObjectInformation.single(track, own) for track, own in self.live.items()), *window]
        squares, count = naive @ self.closed @ naive, self.count
        weight, weight2 = self.weight, self.weight2
        if parts:
            tracks, informations, vectors = _summed(parts, point)
            steps = _steps_without(tracks, informations, vectors, naive, point)
            squares, count = squares + steps.T @ steps, count + len(tracks)
            weights = _weights_by_track(parts)
            weight, weight2 = weight + float(weights.sum()), weight2 + float(weights @ weights)
        return ObjectSpread.from_sums(squares, count, weight, weight2)

    def copy(self) -> ObjectSums:
        return replace(self, live=dict(self.live))


def _weights_by_track(parts: Sequence[ObjectInformation]) -> FloatArray:
    """Weight of each object, summed over its frames."""
    tracks = np.concatenate([part.tracks for part in parts])
    weights = np.concatenate([part.weights for part in parts])
    return np.asarray(np.bincount(np.unique(tracks, return_inverse=True)[1].reshape(-1), weights))


def _summed(
    parts: Sequence[ObjectInformation], point: Point
) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
    """(k) tracks, (k, m, m) informations and (k, m) vectors about a point, summed object by object."""
    counts = [len(part.tracks) for part in parts]
    information = np.concatenate([part.information for part in parts])
    tracks = np.concatenate([part.tracks for part in parts])
    steps = np.repeat(core_steps([part.point for part in parts], point), counts, axis=0)
    if information.shape[1] > steps.shape[1]:
        before = np.concatenate([part.biases_px for part in parts])
        known = dict(zip(point.tracks, point.object_biases_px.tolist(), strict=True))
        now = [known.get(track, bias) for track, bias in zip(tracks.tolist(), before.tolist(), strict=True)]
        steps = np.column_stack([steps, now - before])
    moved = (information @ steps[:, :, None])[:, :, 0]
    vectors = np.concatenate([part.vector for part in parts]) - moved
    order = np.argsort(tracks, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(tracks[order])) + 1)
    names = tuple(tracks[order[firsts]].tolist())
    return names, np.add.reduceat(information[order], firsts), np.add.reduceat(vectors[order], firsts)


def _steps_without(
    tracks: Sequence[int], informations: FloatArray, vectors: FloatArray, naive: FloatArray, point: Point
) -> FloatArray:
    """(k, n) how far the linearized estimate moves without each of the objects."""
    core, m = point.core_size, informations.shape[1]
    columns = np.array(
        [[*range(core), *([core + point.tracks.index(t)] if m > core else [])] for t in tracks]
    )
    return steps_without(informations, -vectors, columns, naive)
