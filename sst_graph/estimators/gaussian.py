"""A Gaussian belief on extrinsic, time offset and mask biases, in information form at a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.problem.state import State
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Point:
    """A value of the unknowns; tangent order [extrinsic 6, offset 1, biases], as the covariance.

    Attributes:
        cTl: extrinsic.
        offset_s: time offset [s].
        biases_px: (c,) mask bias of each class [px].
    """

    cTl: gtsam.Pose3
    offset_s: float
    biases_px: FloatArray

    @property
    def size(self) -> int:
        return 7 + len(self.biases_px)

    def local(self, other: Point) -> FloatArray:
        """(n,) step from here to another point."""
        turn = gtsam.Pose3.Logmap(self.cTl.between(other.cTl))
        return np.concatenate(
            [turn, [other.offset_s - self.offset_s], np.subtract(other.biases_px, self.biases_px)]
        )

    def moved(self, step: FloatArray) -> Point:
        """The point a step (n,) away."""
        return Point(
            self.cTl.compose(gtsam.Pose3.Expmap(step[:6])),
            self.offset_s + float(step[6]),
            self.biases_px + step[7:],
        )

    def state(self, classes: Sequence[SemanticClass]) -> State:
        """As the state that matches are made at."""
        biases = {(0, c): float(bias) for c, bias in zip(classes, self.biases_px, strict=True)}
        return State(self.cTl, (self.offset_s,), biases)


@dataclass(frozen=True)
class Gaussian:
    """exp(-1/2 d' information d + vector' d) of the step d from a point.

    Attributes:
        point: where it was linearized.
        information: (n, n).
        vector: (n,).
    """

    point: Point
    information: FloatArray
    vector: FloatArray

    def at(self, point: Point) -> Gaussian:
        """The same belief about another, near point."""
        return Gaussian(point, self.information, self.vector - self.information @ self.point.local(point))

    def plus(self, other: Gaussian) -> Gaussian:
        """Both beliefs together, at this one's point."""
        other = other.at(self.point)
        return Gaussian(self.point, self.information + other.information, self.vector + other.vector)

    def transition(self, variances: FloatArray) -> FloatArray:
        """A (n, n) = (I + information Q)^-1 of a random walk with Q = diag(variances (n,))."""
        return np.asarray(np.linalg.inv(np.eye(self.point.size) + self.information * variances[None, :]))

    def drifted(self, variances: FloatArray) -> Gaussian:
        """The belief after a random walk."""
        A = self.transition(variances)
        information = A @ self.information
        return Gaussian(self.point, 0.5 * (information + information.T), A @ self.vector)

    def mean(self) -> Point:
        """The most likely value."""
        return self.point.moved(scaled_inverse(self.information) @ self.vector)

    def factor(self, keys: Sequence[int]) -> gtsam.LinearContainerFactor:
        """As a factor on [extrinsic, offset, biases...]; it can be pickled and serialized."""
        linear, starts = gtsam.GaussianFactorGraph(), [0, 6, *range(7, self.point.size + 1)]
        blocks = [slice(a, b) for a, b in pairwise(starts)]
        # The constant makes the least cost 0: optimizers stop where a cost is not positive.
        constant = float(self.vector @ (scaled_inverse(self.information) @ self.vector))
        for i, (key, a) in enumerate(zip(keys, blocks, strict=True)):
            f = constant if i == 0 else 0.0
            linear.add(gtsam.HessianFactor(key, self.information[a, a], self.vector[a], f))
            for other, b in zip(keys[i + 1 :], blocks[i + 1 :], strict=True):
                m, k = a.stop - a.start, b.stop - b.start
                zero_a, zero_b = np.zeros((m, m)), np.zeros((k, k))
                linear.add(
                    gtsam.HessianFactor(
                        key, other, zero_a, self.information[a, b], np.zeros(m), zero_b, np.zeros(k), 0.0
                    )
                )
        values = gtsam.Values()
        insert_point(values, keys, self.point)
        return gtsam.LinearContainerFactor(gtsam.HessianFactor(linear), values)


def insert_point(values: gtsam.Values, keys: Sequence[int], point: Point) -> None:
    """Put a point into values under [extrinsic, offset, biases...], where a key is not there yet."""
    scalars = [point.offset_s, *point.biases_px]
    if not values.exists(keys[0]):
        values.insert(keys[0], point.cTl)
    for key, scalar in zip(keys[1:], scalars, strict=True):
        if not values.exists(key):
            values.insert(key, np.array([float(scalar)]))


def scaled_inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of an information matrix whose units differ by orders of magnitude.

    Raises:
        np.linalg.LinAlgError: it is singular or not finite.
    """
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all() or (diagonal <= 0.0).any():
        raise np.linalg.LinAlgError("an information matrix that is not positive")
    scale = 1.0 / np.sqrt(diagonal)
    inverse = np.linalg.inv(matrix * np.outer(scale, scale) + 1e-14 * np.eye(len(matrix)))
    inverse = inverse * np.outer(scale, scale)
    return np.asarray(0.5 * (inverse + inverse.T))
