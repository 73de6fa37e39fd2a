"""Noise models that come back from ``pickle`` and ``copy.deepcopy`` as they were.

gtsam 4.3 stores of a Tukey kernel its constant and not the square of it, with which it computes: one of 20
comes back as one of 4.7.
"""

from __future__ import annotations

import pickle
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gtsam

from ..arguments import described
from ..errors import FactorError

_DISTANCES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, -1.0, -30.0)
"""At which two kernels are compared, in standard deviations."""


@dataclass(frozen=True)
class StoredKernel:
    """A kernel by what it is made of.

    Attributes:
        kind: its class.
        constant: in standard deviations.
        scheme: number of its ``ReweightScheme``.
    """

    kind: Any
    constant: float
    scheme: int

    def restored(self) -> Any:
        """The kernel."""
        return self.kind(self.constant, gtsam.noiseModel.mEstimator.Base.ReweightScheme(self.scheme))


@dataclass(frozen=True)
class StoredNoise:
    """A robust noise model in parts that are stored whole: its kernel, and the noise model in it."""

    kernel: Any
    inner: Any

    def restored(self) -> Any:
        """The noise model."""
        kernel = self.kernel.restored() if isinstance(self.kernel, StoredKernel) else self.kernel
        return gtsam.noiseModel.Robust.Create(kernel, restored_noise(self.inner))


def stored_noise(noise: Any) -> Any:
    """The noise model as it can be stored: itself, or in parts.

    Raises:
        FactorError: it holds a kernel that cannot.
    """
    if not isinstance(noise, gtsam.noiseModel.Robust):
        return noise
    kernel, inner = _stored_kernel(noise.robust()), stored_noise(noise.noise())
    apart = isinstance(kernel, StoredKernel) or isinstance(inner, StoredNoise)
    return StoredNoise(kernel, inner) if apart else noise


def restored_noise(stored: Any) -> Any:
    """The noise model of :func:`stored_noise`."""
    return stored.restored() if isinstance(stored, StoredNoise) else stored


def _stored_kernel(kernel: Any) -> Any:
    # A kernel that is a function has no archive.
    with suppress(RuntimeError, TypeError, ValueError, AttributeError):
        if _same(kernel, pickle.loads(pickle.dumps(kernel))):
            return kernel
        # The last two numbers of the archive's text.
        scheme, constant = kernel.serialize().split()[-2:]
        stored = StoredKernel(type(kernel), float(constant), int(scheme))
        if _same(kernel, stored.restored()):
            return stored
    raise FactorError("noise", described(kernel), "a kernel that gtsam can store")


def _same(a: Any, b: Any) -> bool:
    return all(a.loss(d) == b.loss(d) and a.weight(d) == b.weight(d) for d in _DISTANCES)
