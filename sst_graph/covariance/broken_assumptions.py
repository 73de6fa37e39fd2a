"""Deviation of an assumption's parameter, given the data, that is considered in the covariance.

Beforehand either all assumptions hold, or one of them is broken, which has probability ``prevalence``. The
parameter of one that holds is normal with its prior deviation s0. That of a broken one has a deviation tau of
its own, of which no more is known than its range, from s0 to the assumption's span: log tau is uniform
(Jeffreys). An estimate t with deviation s changes the odds of each by the Bayes factor

    B(tau) = N(t; 0, s^2 + tau^2) / N(t; 0, s^2 + s0^2),

and the estimate, which holds the parameter at zero, is to be covered for the mean square of it,

    E[theta^2 | t] = v (1 + v t^2 / s^4),   v = (s^-2 + tau^-2)^-1,

averaged over all that may be. An assumption that holds keeps its prior s0. At most one assumption is broken,
so a deviation in the data is shared among the assumptions that would explain it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sst_graph.types import FloatArray

_SCALES = 24
"""Deviations of a broken assumption's parameter that the average runs over: a factor of 2 apart at most."""


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

    @classmethod
    def none(cls, prior: float, span: float, prevalence: float) -> Evidence:
        """Of a parameter of which the data say nothing."""
        return cls(0.0, _NO_INFORMATION * span, prior, span, prevalence)


_NO_INFORMATION = 1e4
"""Deviation of an estimate without information, in spans."""
_MOST_LOG = 500.0
"""Largest logarithm of a Bayes factor, so that its exponential is finite."""


def _log_normal(value: float, variances: FloatArray) -> FloatArray:
    """Logarithm of a centred normal density, without its constant."""
    return np.asarray(-0.5 * (value**2 / variances + np.log(variances)))


@lru_cache(maxsize=64)
def _broken(evidence: Evidence) -> tuple[float, float]:
    """The Bayes factor for a broken assumption, and the mean square of its parameter if it is.

    Between two tests a tracker asks for the same several times a frame.
    """
    estimate, deviation = evidence.estimate, evidence.deviation
    taus = np.geomspace(evidence.prior, evidence.span, _SCALES)
    logs = _log_normal(estimate, deviation**2 + taus**2)
    logs = logs - _log_normal(estimate, np.array([deviation**2 + evidence.prior**2]))
    most = float(logs.max())
    shares = np.exp(logs - most)
    variances = 1.0 / (deviation**-2.0 + taus**-2.0)
    squares = variances * (1.0 + variances * estimate**2 / deviation**4)
    factor = float(np.exp(min(most, _MOST_LOG)) * shares.mean())
    return factor, float((shares * squares).sum() / shares.sum())


def considered_sigmas(evidence: Mapping[str, Evidence]) -> dict[str, float]:
    """Deviation of each assumption's parameter from zero, by name, that the estimate is to be covered for.

    Never below the prior one; that stays 0 where it is 0: the assumption holds exactly.
    """
    open_ = {name: each for name, each in evidence.items() if 0.0 < each.prior < each.span}
    broken = {name: _broken(each) for name, each in open_.items()}
    odds = {name: open_[name].prevalence * factor for name, (factor, _) in broken.items()}
    none = max(1.0 - sum(each.prevalence for each in open_.values()), 0.0)
    total = none + sum(odds.values())
    sigmas = {name: each.prior for name, each in evidence.items()}
    for name, (_, square) in broken.items():
        share, prior = odds[name] / total, sigmas[name]
        sigmas[name] = max(prior, float(np.sqrt((1.0 - share) * prior**2 + share * square)))
    return sigmas
