"""Scans that left the window while their pairing with an image was not certain.

A scan half way between two images is paired with the one or the other as the time offset moves by its own
sigma. The batch pairs by its estimate. So for a scan that leaves, its information with the other image is
kept too, and the marginal of the past is switched to it when the offset passes the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.tracker.window.gaussian import Gaussian, Point

FloatArray = NDArray[np.float64]

REACH_SIGMAS = 4.0
"""A pairing is certain where the offset is farther from the middle, in its standard deviations."""
MOST = 100
"""Latest scans that are kept; older ones stay as they are."""


@dataclass(frozen=True)
class OtherPairing:
    """A scan linearized with the other image.

    Attributes:
        information: on the unknowns of the scan.
        middle_s: time offset at which the scan lies half way between its two images [s].
        early: whether the pairing in use is with the earlier image, as it is from ``middle_s`` on.
    """

    information: Gaussian
    middle_s: float
    early: bool


@dataclass(frozen=True)
class PendingPairs:
    """Other pairings less those in use, one row a scan, about a point, in the columns of the past and of what
    it holds.

    Attributes:
        middles_s: (k,) time offsets at which the scans lie half way between their images [s].
        early: (k,) whether the earlier image is in use.
        information, vector: (k, n, n), (k, n).
    """

    middles_s: FloatArray
    early: NDArray[np.bool_]
    information: FloatArray
    vector: FloatArray

    @classmethod
    def none(cls, n: int) -> PendingPairs:
        return cls(np.zeros(0), np.zeros(0, np.bool_), np.zeros((0, n, n)), np.zeros((0, n)))

    def plus(self, used: Gaussian, other: OtherPairing, point: Point) -> PendingPairs:
        """One more scan; objects of the other pairing that are not known at the point are left out."""
        n = point.size + used.held
        difference = np.zeros((n, n)), np.zeros(n)
        for gaussian, sign in ((other.information, 1.0), (used, -1.0)):
            unknown = [track for track in gaussian.point.tracks if track not in point.tracks]
            gaussian = (gaussian.without(unknown)[0] if unknown else gaussian).at(point)
            columns = point.columns(gaussian.point.tracks, gaussian.held)
            difference[0][np.ix_(columns, columns)] += sign * gaussian.information
            difference[1][columns] += sign * gaussian.vector
        return PendingPairs(
            np.append(self.middles_s, other.middle_s)[-MOST:],
            np.append(self.early, other.early)[-MOST:],
            np.concatenate([self.information, difference[0].reshape(1, n, n)])[-MOST:],
            np.concatenate([self.vector, difference[1].reshape(1, n)])[-MOST:],
        )

    def moved(self, step: FloatArray) -> PendingPairs:
        """About a point that lies a step away; (m,) of the unknowns, without what is held."""
        moved = self.information[:, :, : len(step)] @ step
        return PendingPairs(self.middles_s, self.early, self.information, self.vector - moved)

    def through(self, T: FloatArray) -> PendingPairs:
        """In other unknowns: scores follow T (m, n), as of :meth:`Gaussian.without`."""
        return PendingPairs(self.middles_s, self.early, T @ self.information @ T.T, self.vector @ T.T)

    def resolved(self, past: Gaussian, offset_s: float) -> tuple[PendingPairs, Gaussian]:
        """Pairings as they are under a time offset, and the past with them; both about the past's point."""
        changed = (offset_s >= self.middles_s) != self.early
        if not changed.any():
            return self, past
        information, n = past.information + self.information[changed].sum(axis=0), past.point.size
        if np.linalg.eigvalsh(information[:n, :n])[0] <= 0.0:
            return self, past
        past = Gaussian(past.point, information, past.vector + self.vector[changed].sum(axis=0))
        sign = np.where(changed, -1.0, 1.0)
        flipped = PendingPairs(
            self.middles_s,
            self.early ^ changed,
            sign[:, None, None] * self.information,
            sign[:, None] * self.vector,
        )
        return flipped, past
