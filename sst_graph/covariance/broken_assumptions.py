"""Deviation of an assumption's parameter, given the data, that is considered in the covariance.

Beforehand either all assumptions hold, or one of them is broken, which has probability ``prevalence``. The
parameter of one that holds is normal with its prior deviation s0. That of a broken one has a deviation tau of
its own, of which no more is known than its range, from s0 to the assumption's span: log tau is uniform
(Jeffreys). An estimate t with deviation s changes the odds of each tau by the Bayes factor

    B(tau) = N(t; 0, s^2 + tau^2) / N(t; 0, s^2 + s0^2),

and under each the parameter is normal:

    theta | t, tau ~ N(v t / s^2, v),   v = (s^-2 + tau^-2)^-1.

At most one assumption is broken, so a deviation in the data is shared among the assumptions that would
explain it. What may be then is a mixture, most of it narrow and a small part wide, and no one normal
distribution has both its mean square and its tails. The considered deviation c is the larger of two:

    c^2 = E[theta^2 | t],   P(|theta| > 2.33 c | t) = 2 % = P(|z| > 2.33),   z standard normal.

An assumption that holds keeps its prior s0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

FloatArray = NDArray[np.float64]

_SCALES = 24
"""Deviations of a broken assumption's parameter that the average runs over: a factor of 2 apart at most."""
_RARE, _RARE_SIGMAS = 0.02, 2.3263
"""A probability, and the sigmas that a normal variable exceeds with it, in either sense."""
_HALVINGS = 40
"""Of the interval in which the tail is sought."""


@dataclass(frozen=True)
class BrokenParameter:
    """The parameter of a broken assumption, given the data: a mixture of normal distributions.

    Attributes:
        factor: Bayes factor against the assumption.
        shares: (k,) of the parts; their sum is 1.
        means, variances: (k,) of the parts.
    """

    factor: float
    shares: FloatArray
    means: FloatArray
    variances: FloatArray

    @property
    def mean_square(self) -> float:
        """E[theta^2]."""
        return float(self.shares @ (self.variances + self.means**2))

    def beyond(self, size: float) -> float:
        """Probability that the parameter is larger than ``size`` in either sense."""
        deviations = np.sqrt(self.variances)
        outside = ndtr((self.means - size) / deviations) + ndtr((-self.means - size) / deviations)
        return float(self.shares @ outside)


@dataclass(frozen=True)
class Evidence:
    """What is known of one assumption's parameter.

    Attributes:
        estimate, deviation: by the data, while all other assumptions hold.
        prior: deviation where the assumption holds.
        span: largest deviation where it is broken.
        prevalence: probability beforehand that it is broken.
    """

    estimate: float
    deviation: float
    prior: float
    span: float
    prevalence: float

    def broken(self) -> BrokenParameter:
        """The parameter if the assumption is broken."""
        taus = np.geomspace(self.prior, self.span, _SCALES)
        logs = _log_normal(self.estimate, self.deviation**2 + taus**2)
        logs = logs - _log_normal(self.estimate, np.array([self.deviation**2 + self.prior**2]))
        most = float(logs.max())
        shares = np.exp(logs - most)
        variances = 1.0 / (self.deviation**-2.0 + taus**-2.0)
        factor = float(np.exp(min(most, _MOST_LOG)) * shares.mean())
        means = variances * self.estimate / self.deviation**2
        return BrokenParameter(factor, shares / shares.sum(), means, variances)


_MOST_LOG = 500.0
"""Largest logarithm of a Bayes factor, so that its exponential is finite."""


def _log_normal(value: float, variances: FloatArray) -> FloatArray:
    """Logarithm of a centred normal density, without its constant."""
    return np.asarray(-0.5 * (value**2 / variances + np.log(variances)))


def considered_sigmas(evidence: Mapping[str, Evidence]) -> dict[str, float]:
    """Deviation of each assumption's parameter from zero, by name, that the estimate is to be covered for.

    Never below the prior one; that stays 0 where it is 0: the assumption holds exactly.
    """
    open_ = {name: each for name, each in evidence.items() if 0.0 < each.prior < each.span}
    broken = {name: each.broken() for name, each in open_.items()}
    odds = {name: open_[name].prevalence * each.factor for name, each in broken.items()}
    none = max(1.0 - sum(each.prevalence for each in open_.values()), 0.0)
    total = none + sum(odds.values())
    sigmas = {name: each.prior for name, each in evidence.items()}
    for name, each in broken.items():
        share, prior = odds[name] / total, sigmas[name]
        root_mean_square = float(np.sqrt((1.0 - share) * prior**2 + share * each.mean_square))
        sigmas[name] = max(prior, root_mean_square, _sigma_of_tail(each, share, prior))
    return sigmas


def _sigma_of_tail(broken: BrokenParameter, share: float, prior: float) -> float:
    """The c whose 2.33-fold the parameter exceeds as often as a normal variable of that deviation.

    Args:
        share: probability that the assumption is broken.
        prior: deviation of the parameter where it holds.
    """

    def often(size: float) -> bool:
        return share * broken.beyond(size) + (1.0 - share) * 2.0 * float(ndtr(-size / prior)) > _RARE

    # Chebyshev's inequality bounds the size that is exceeded with 2 %.
    low, high = 0.0, 10.0 * float(np.sqrt(broken.mean_square + prior**2))
    for _ in range(_HALVINGS):
        size = 0.5 * (low + high)
        low, high = (size, high) if often(size) else (low, size)
    return high / _RARE_SIGMAS
