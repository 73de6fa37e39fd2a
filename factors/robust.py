"""Robust kernels on whitened residuals, vectorised."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from .arguments import FloatArray, as_numbers, checked_positive, described
from .errors import FactorError

KernelKind = Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"]


@dataclass(frozen=True)
class RobustKernel:
    """rho(x) of a whitened residual x, rho(x) ~ x^2 / 2 near zero; the same curves as gtsam's.

    Attributes:
        kind: "none" (least squares), "huber", "cauchy", "geman_mcclure" or "tukey"; the last two
            redescend and are bounded.
        scale: in units of sigma: where Huber turns linear, where the others' weight has fallen to
            1/2 (Cauchy), 1/4 (Geman-McClure), 0 (Tukey). Above 0; a settings file may give it within the
            bounds of the field's metadata.
    """

    kind: KernelKind = "none"
    scale: float = field(default=1.0, metadata={"at_least": 0.01, "at_most": 1e6})

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in get_args(KernelKind):
            raise FactorError(
                "robust kernel", described(self.kind), "one of " + ", ".join(get_args(KernelKind))
            )
        checked_positive("scale of the robust kernel", self.scale)

    def weight(self, x: ArrayLike) -> FloatArray:
        """w = rho'(x) / x, in [0, 1]; any shape."""
        return self.weight_and_loss(np.square(as_numbers("x", x)))[0]

    def loss(self, x: ArrayLike) -> FloatArray:
        """rho(x), any shape."""
        return self.weight_and_loss(np.square(as_numbers("x", x)))[1]

    def weight_and_loss(self, squares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Both from x^2, any shape: a linearization wants both, and most of their work is the same."""
        if self.kind == "none":
            return np.ones_like(squares), np.asarray(0.5 * squares)
        if self.kind == "huber":
            size = np.sqrt(squares)
            inside = np.minimum(size, self.scale)
            return np.asarray(self.scale / np.maximum(size, self.scale)), inside * (size - 0.5 * inside)
        z = squares * self.scale**-2.0
        half = 0.5 * self.scale**2
        if self.kind == "cauchy":
            return np.asarray(1.0 / (1.0 + z)), np.asarray(half * np.log1p(z))
        if self.kind == "geman_mcclure":
            root = 1.0 / (1.0 + z)
            return np.square(root), half * (z * root)
        rest = np.maximum(1.0 - z, 0.0)
        return np.square(rest), np.asarray(half / 3.0 * (1.0 - rest**3))

    def curvature(self, x: ArrayLike) -> FloatArray:
        """rho''(x), any shape: negative where a kernel redescends."""
        x = as_numbers("x", x)
        if self.kind == "none":
            return np.ones_like(x)
        if self.kind == "huber":
            return np.asarray(np.abs(x) <= self.scale, dtype=np.float64)
        z = np.square(x / self.scale)
        if self.kind == "cauchy":
            return np.asarray((1.0 - z) / np.square(1.0 + z))
        if self.kind == "geman_mcclure":
            return np.asarray((1.0 - 3.0 * z) / (1.0 + z) ** 3)
        return np.asarray(np.maximum(1.0 - z, 0.0) * (1.0 - 5.0 * z) * (z < 1.0))
