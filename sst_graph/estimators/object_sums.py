"""What each object says, frame by frame, for the jackknife over objects of the batch's covariance.

Objects of the window, and those that may be seen again, are kept one by one; of those gone for good only the
square of the step that the estimate would take without them.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.estimators.gaussian import Gaussian, Point
from sst_graph.uncertainty.covariance import step_without

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectBeliefs:
    """The matches of each object of a frame alone, on extrinsic, offset, mask biases and its own bias if any.

    Attributes:
        point: where the frame is linearized.
        tracks: (k) the objects' tracks.
        information, vector: (k, m, m), (k, m) as of :class:`~sst_graph.estimators.gaussian.Gaussian`.
    """

    point: Point
    tracks: tuple[int, ...]
    information: FloatArray
    vector: FloatArray

    @classmethod
    def of(cls, J: FloatArray, r: FloatArray, track: NDArray[np.intp], point: Point) -> ObjectBeliefs:
        """From weighted rows J (m, n) at a point, residuals and tracks (m,)."""
        names = tuple(int(name) for name in np.unique(track))
        informations, vectors = [], []
        for name in names:
            rows = np.flatnonzero(track == name)
            own = J[np.ix_(rows, point.columns([name] if name in point.tracks else []))]
            informations.append(own.T @ own)
            vectors.append(-own.T @ r[rows])
        return cls(point, names, np.stack(informations), np.stack(vectors))

    def gaussians(self) -> dict[int, Gaussian]:
        """One by one, by track."""
        return {
            track: Gaussian(_restricted(self.point, track), self.information[k], self.vector[k])
            for k, track in enumerate(self.tracks)
        }

    def vector_at(self, point: Point) -> FloatArray:
        """(k, m) the vectors about another, near point."""
        step = self.point.core().local(point.core())
        if self.information.shape[1] == len(step):
            return np.asarray(self.vector - self.information @ step)
        before, now = _biases(self.point), _biases(point)
        own = np.array([now.get(track, before[track]) - before[track] for track in self.tracks])
        steps = np.column_stack([np.tile(step, (len(own), 1)), own])
        return np.asarray(self.vector - np.einsum("kij,kj->ki", self.information, steps))


@dataclass
class ObjectSums:
    """Of frames that have left the window; matrices in the columns of the belief that took them in.

    Attributes:
        closed: (n, n) sum of squared scores that stand for the objects gone.
        count: how many they are.
        live: the matches of each other object alone, by its track.
    """

    closed: FloatArray
    count: int = 0
    live: dict[int, Gaussian] = field(default_factory=dict)

    def add(self, objects: ObjectBeliefs) -> None:
        """Take in the objects of a frame."""
        for track, own in objects.gaussians().items():
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
        at = [own.at(point) for own in gone.values()]
        parts = [own.information for own in at], [own.vector for own in at]
        steps = _steps_without(*parts, list(gone), naive, point)
        scores = steps @ information
        self.closed = self.closed + scores.T @ scores
        self.count += len(gone)

    def jackknife(
        self, window: Sequence[ObjectBeliefs], naive: FloatArray, point: Point
    ) -> FloatArray | None:
        """(n, n) covariance from leaving out one object after the other; None where there is but one.

        Args:
            window: objects of the frames beside those taken in.
            naive: (n, n) inverse of all information.
            point: the estimate.
        """
        sums = {track: (own.information, own.at(point).vector) for track, own in self.live.items()}
        for objects in window:
            for track, own, vector in zip(
                objects.tracks, objects.information, objects.vector_at(point), strict=True
            ):
                known = sums.get(track)
                sums[track] = (own, vector) if known is None else (known[0] + own, known[1] + vector)
        count = len(sums) + self.count
        if count < 2:
            return None
        total = naive @ self.closed @ naive
        if sums:
            informations, vectors = zip(*sums.values(), strict=True)
            steps = _steps_without(informations, vectors, list(sums), naive, point)
            total = total + steps.T @ steps
        return np.asarray((count - 1) / count * total)

    def copy(self) -> ObjectSums:
        return replace(self, live=dict(self.live))


def _restricted(point: Point, track: int) -> Point:
    """A point with one object's bias, or none where it has none of its own."""
    return point.seen({track: 0}) if track in point.tracks else point.core()


def _biases(point: Point) -> Mapping[int, float]:
    return dict(zip(point.tracks, point.object_biases_px.tolist(), strict=True))


def _steps_without(
    informations: Sequence[FloatArray],
    vectors: Sequence[FloatArray],
    tracks: Sequence[int],
    naive: FloatArray,
    point: Point,
) -> FloatArray:
    """(k, n) how far the linearized estimate moves without each of the objects."""
    n = len(naive)
    sigmas = np.sqrt(np.diag(naive))
    root = sigmas[:, None] * np.linalg.cholesky(naive / np.outer(sigmas, sigmas) + 1e-14 * np.eye(n))
    steps = []
    for part, vector, track in zip(informations, vectors, tracks, strict=True):
        columns = point.columns([track] if track in point.tracks else [])
        own, score = np.zeros((n, n)), np.zeros(n)
        own[np.ix_(columns, columns)] = part
        score[columns] = -vector
        steps.append(step_without(root, own, score))
    return np.stack(steps)
