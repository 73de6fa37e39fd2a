"""The normal equations of a frozen problem, its motion to be eliminated.

Each twist occurs in the matches of its own image and one measurement: no factor has two of them, and each is
eliminated by itself (Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sst_graph.graph.linear import information_inverse
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class Unknowns:
    """Columns of the unknowns that are not motion: the extrinsic, the clocks, parameters of assumptions that
    are estimated, the mask biases."""

    keys: tuple[int, ...]

    @property
    def size(self) -> int:
        return 6 + len(self.keys) - 1

    @cached_property
    def _places(self) -> dict[int, int]:
        return {key: 0 if place == 0 else 5 + place for place, key in enumerate(self.keys)}

    def column(self, key: int) -> int:
        """First column of a key."""
        return self._places[key]


@dataclass(frozen=True)
class NormalEquations:
    """The linearized problem, H x = -g with x over the extrinsic (right perturbation), scalars and twists.

    Attributes:
        unknowns: all but the twists.
        twists: keys of the twists.
        cost: at the point.
        H, g: (n, n), (n,) of all unknowns but the twists.
        H_twists, g_twists: (f, 6, 6), (f, 6) of the twists; no factor has two of them.
        H_mixed: (f, 6, n) of each twist with the others.
    """

    unknowns: Unknowns
    twists: tuple[int, ...]
    cost: float
    H: FloatArray
    g: FloatArray
    H_twists: FloatArray
    g_twists: FloatArray
    H_mixed: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """(n,) and (f, 6): the step with ``damping`` added to the diagonal of the whole H."""
        inverse, H, g = self._reduced(damping)
        x = np.asarray(-np.linalg.solve(H, g), np.float64)
        followed = self.g_twists + self.H_mixed @ x
        return x, -(inverse @ followed[:, :, None])[:, :, 0]

    def step_along(self, unknown: int, length: float) -> tuple[FloatArray, FloatArray]:
        """(n,) and (f, 6): the step that moves one unknown so far and lets all others follow."""
        inverse, H, g = self._reduced(0.0)
        x, rest = np.zeros(len(g)), np.arange(len(g)) != unknown
        x[unknown] = length
        x[rest] = -np.linalg.solve(H[np.ix_(rest, rest)], g[rest] + H[rest, unknown] * length)
        followed = self.g_twists + self.H_mixed @ x
        return x, -(inverse @ followed[:, :, None])[:, :, 0]

    def covariance(self) -> FloatArray:
        """(n, n) of all unknowns but the twists.

        gtsam.Marginals gives up at condition numbers near 1e9, which metres and pixels in one matrix reach
        although every direction is observable.
        """
        return information_inverse(self._reduced(0.0)[1])

    def twist_responses(self) -> dict[int, FloatArray]:
        """(6, n) derivative of the optimum of each twist by the unknowns, by the twist's key."""
        return dict(zip(self.twists, -np.linalg.solve(self.H_twists, self.H_mixed), strict=True))

    def _reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Inverse of the twists' blocks, and H and g with the twists eliminated."""
        inverse = np.asarray(np.linalg.inv(self.H_twists + damping * np.eye(6)), np.float64)
        n = len(self.g)
        mixed = self.H_mixed.reshape(-1, n)
        H = self.H + damping * np.eye(n) - mixed.T @ (inverse @ self.H_mixed).reshape(-1, n)
        g = self.g - mixed.T @ (inverse @ self.g_twists[:, :, None]).reshape(-1)
        return inverse, H, g
