"""How an answer follows the assumptions it rests on, and what that adds to its covariance.

A parameter theta that is held at 0 but has deviation sigma moves the answer by (dx/dtheta) theta: Schmidt's
considered parameter (Bierman, Factorization methods for discrete sequential estimation, 1977, ch. 8). With J
the matches' rows by the unknowns, motion marginalised out, c their column by theta and P the covariance that
the solve itself claims,

    dx/dtheta = -P J'c,      P_considered = sum sigma^2 (dx/dtheta)(dx/dtheta)'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.errors import ConfigError
from sst_graph.problem.graph import PairMatches
from sst_graph.problem.nuisances import residual_columns
from sst_graph.problem.state import State, twist_key
from sst_graph.uncertainty.covariance import MatchTable, RobustCovariance

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AssumptionConfig:
    """What is taken for granted, and how far it may be wrong.

    Attributes:
        sigmas: deviation of an assumption's parameter, by its name, in its unit; 0: it holds exactly. What is
            not named has the deviation that a careful set-up leaves (``sst_graph.assumptions``).
        estimate: assumptions whose parameters are variables of the answer, with the deviation of each from 0
            beforehand, in its unit.
        test: test the assumptions against the data.
        threshold: an estimate of a parameter farther from 0 than this many of its deviations contradicts
            the assumption; with ten tests, 3.3 gives one false alarm in a hundred drives.
    """

    sigmas: Mapping[str, float] = field(default_factory=dict)
    estimate: Mapping[str, float] = field(default_factory=dict)
    test: bool = True
    threshold: float = 3.3

    def __post_init__(self) -> None:
        for part, least in ((self.sigmas, "0 or more"), (self.estimate, "more than 0")):
            check_names(part)
            for name, sigma in part.items():
                if not 0.0 <= sigma < np.inf or (part is self.estimate and sigma == 0.0):
                    raise ValueError(f"{name} {sigma:g}: expected {least}")
        if not 1.0 <= self.threshold < np.inf:
            raise ValueError(f"threshold {self.threshold:g}: expected 1 or more")

    def sigma(self, name: str) -> float:
        """Deviation of an assumption's parameter."""
        return self.sigmas.get(name, ASSUMPTIONS[name].sigma)


def check_names(names: Sequence[str] | Mapping[str, float]) -> None:
    """Raises ConfigError: a name is no assumption's."""
    for name in names:
        if name not in ASSUMPTIONS:
            raise ConfigError(f"assumption '{name}': expected one of {', '.join(ASSUMPTIONS)}")


@dataclass(frozen=True)
class Considered:
    """What the assumptions add to a covariance.

    Attributes:
        sensitivities: how extrinsic and offsets (n,) follow each parameter, by name [rad, m, s per unit].
        sigmas: deviations of the parameters.
    """

    sensitivities: Mapping[str, FloatArray]
    sigmas: Mapping[str, float]

    def part(self, name: str) -> FloatArray:
        """(n, n) covariance by one assumption."""
        step = self.sigmas[name] * self.sensitivities[name]
        return np.outer(step, step)

    def covariance(self, size: int) -> FloatArray:
        """(size, size) covariance by all of them."""
        return np.asarray(sum((self.part(name) for name in self.sigmas), np.zeros((size, size))))


def columns_of(
    pairs: Sequence[PairMatches], values: gtsam.Values, state: State, names: Sequence[str]
) -> FloatArray:
    """(m, k) derivatives of all matches' residuals by assumptions' parameters [px per unit], unweighted.

    In the order of :func:`~sst_graph.uncertainty.covariance.match_table`.
    """
    blocks = [np.zeros((0, len(names)))]
    for pair in pairs:
        assert pair.scene is not None
        c_twist = values.atVector(twist_key(pair.drive, pair.pair.image))
        at = state.cTl, state.offset_s(pair.drive), c_twist
        for matches in pair.matches.values():
            found = residual_columns(matches.alignment, pair.scene, pair.pair.base_tau_s, at, names)
            blocks.append(np.stack([found[name] for name in names], axis=1))
    return np.concatenate(blocks)


def weighted_columns(table: MatchTable, pairs: Sequence[PairMatches], columns: FloatArray) -> FloatArray:
    """Columns (m, k) multiplied by sqrt(weight) / sigma, as the table's rows are."""
    sigmas = np.concatenate([m.alignment.sigmas_px for pair in pairs for m in pair.matches.values()])
    return np.asarray(columns * (table.root_weights / sigmas)[:, None])


def consider(
    robust: RobustCovariance,
    pairs: Sequence[PairMatches],
    values: gtsam.Values,
    state: State,
    config: AssumptionConfig,
    estimated: Sequence[str] = (),
) -> Considered:
    """How an answer follows every assumption that is not estimated beside it.

    Args:
        robust: its covariance and matches.
        pairs, values, state: its last frozen problem.
        estimated: assumptions whose parameters are unknowns of the answer.
    """
    names = [name for name in ASSUMPTIONS if name not in estimated]
    columns = weighted_columns(robust.table, pairs, columns_of(pairs, values, state, names))
    size = 6 + len(state.offsets_s)
    steps = -(robust.bread @ (robust.table.J.T @ columns))[:size]
    return Considered(dict(zip(names, steps.T, strict=True)), {name: config.sigma(name) for name in names})
