"""Sensitivity of an estimate to its assumptions, and what that adds to its covariance.

A parameter theta that is held at 0 but has deviation sigma shifts the estimate by (dx/dtheta) theta:
Schmidt's considered parameter (Bierman, Factorization methods for discrete sequential estimation, 1977, ch.
8). With J the matches' rows by the unknowns, motion marginalised out, c their column by theta and P the
covariance that the solve itself claims,

    dx/dtheta = -P J'c,      P_considered = sum sigma^2 (dx/dtheta)(dx/dtheta)'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS, held_at_zero, named_sigmas
from sst_graph.config import Settings, setting
from sst_graph.covariance.cluster_robust import RobustCovariance
from sst_graph.covariance.match_table import MatchTable
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.matching import DriveMatches, PairMatches
from sst_graph.graph.nuisances import residual_columns
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.graph.state import State, twist_key
from sst_graph.types import FloatArray

BUDGET = "sigma_budget"
"""Key of :func:`budget` among a result's diagnostics."""
SHIFTS = "shifts from image to image"
"""Name of the part of a budget by pictures that shift."""


_Sigmas = make_dataclass(
    "AssumptionSigmas",
    [
        (
            name,
            float,
            setting(
                each.sigma,
                at_least=0.0,
                at_most=100.0 * each.span,
                unit=each.unit,
                doc=f"{each.name}: deviation considered in the covariance ({each.source}). "
                "Raise it for a poorer set-up; 0: exact.",
            ),
        )
        for name, each in ASSUMPTIONS.items()
    ],
    bases=(Settings,),
    namespace={"__module__": __name__},
    frozen=True,
)
if TYPE_CHECKING:

    class AssumptionSigmas(Settings):
        """Deviation of each assumption's parameter, by its name, in its unit; 0: it holds exactly."""
else:
    AssumptionSigmas = _Sigmas


@dataclass(frozen=True)
class AssumptionConfig(AssumptionSigmas):
    """What is assumed, and how far it may be wrong.

    The defaults of the deviations are what a careful set-up leaves (``sst_graph.assumptions`` names their
    sources).
    """

    estimate: tuple[str, ...] = setting(
        (),
        doc="Assumptions whose parameters are estimated with the calibration: NAME, or NAME=SIGMA "
        "with the deviation from 0. Use where a test says that one is violated.",
    )
    test: bool = setting(True, doc="Test the assumptions against the data. Set to false to save time.")
    threshold: float = setting(
        3.3,
        at_least=1.0,
        at_most=100.0,
        unit="sigma",
        doc="Standard deviations from 0 beyond which a parameter contradicts its assumption. Raise it"
        " for fewer false alarms (3.3: one in a hundred drives).",
    )

    def __post_init__(self) -> None:
        named_sigmas(self.estimate)

    def sigma(self, name: str) -> float:
        """Deviation of an assumption's parameter."""
        return float(getattr(self, name))

    @property
    def estimated(self) -> tuple[tuple[str, float], ...]:
        """Assumptions whose parameters are variables, with the deviation of each beforehand."""
        return named_sigmas(self.estimate)

    @property
    def misleading_motion(self) -> tuple[str, ...]:
        """Names of the estimated parameters that mislead the calibration by motion alone."""
        return tuple(name for name, _ in self.estimated if ASSUMPTIONS[name].misleads_motion)


@dataclass(frozen=True)
class Considered:
    """What the assumptions add to a covariance.

    Attributes:
        sensitivities: derivative (n,) of extrinsic and offsets by each parameter, by name [rad, m, s per
            unit].
        sigmas: deviations of the parameters.
    """

    sensitivities: Mapping[str, FloatArray]
    sigmas: Mapping[str, float]

    def step(self, name: str) -> FloatArray:
        """(n,) step of the estimate by one deviation of a parameter."""
        return np.asarray(self.sigmas[name] * self.sensitivities[name])

    def steps(self) -> dict[str, FloatArray]:
        """(7,) step of extrinsic and first offset by one deviation of each parameter, by name."""
        return {name: self.step(name)[:7] for name in self.sigmas}

    def part(self, name: str) -> FloatArray:
        """(n, n) covariance by one assumption."""
        step = self.step(name)
        return np.outer(step, step)

    def covariance(self, size: int) -> FloatArray:
        """(size, size) covariance by all of them."""
        return np.asarray(sum((self.part(name) for name in self.sigmas), np.zeros((size, size))))


def columns_of(
    pairs: Sequence[PairMatches], values: gtsam.Values, state: State, names: Sequence[str]
) -> FloatArray:
    """(m, k) derivatives of all matches' residuals by assumptions' parameters [px per unit], unweighted.

    In the order of :func:`~sst_graph.covariance.match_table.match_table`.
    """
    blocks = [np.zeros((0, len(names)))]
    for pair in pairs:
        assert pair.scene is not None
        c_twist = values.atVector(twist_key(pair.drive, pair.pair.image))
        at = state.cTl, state.time_offset_s(pair.drive), c_twist
        for matches in pair.matches.values():
            found = residual_columns(matches.alignment, pair.scene, matches.offsets_s, at, names)
            rows = np.array(list(found.values())).reshape(len(names), len(matches.alignment))
            blocks.append(rows.T)
    return np.concatenate(blocks)


def weighted_columns(table: MatchTable, pairs: Sequence[PairMatches], columns: FloatArray) -> FloatArray:
    """Columns (m, k) multiplied by sqrt(weight) / sigma, as the table's rows are."""
    sigmas = np.concatenate([m.alignment.sigmas_px for pair in pairs for m in pair.matches.values()])
    return np.asarray(columns * (table.root_weights / sigmas)[:, None])


def considered_by_matches(
    robust: RobustCovariance,
    pairs: Sequence[PairMatches],
    values: gtsam.Values,
    state: State,
    config: AssumptionConfig,
    known: KnownCalibration | None = None,
) -> Considered:
    """Sensitivity of an estimate to every assumption that is not estimated, from its matches.

    Args:
        robust: its covariance and matches.
        pairs, values, state: its last frozen problem.
        known: what it knew beside the matches.
    """
    names = held_at_zero(config.estimate)
    columns = weighted_columns(robust.table, pairs, columns_of(pairs, values, state, names))
    size = 6 + len(state.time_offsets_s)
    shared = robust.table.J.T @ columns
    if known is not None:
        shared[:7] += known.shared(names)
    steps = steps_by(names, robust.bread, shared, size)
    return considered_by_steps(steps, config)


def steps_by(names: Sequence[str], bread: FloatArray, shared: FloatArray, size: int) -> dict[str, FloatArray]:
    """Sensitivity dx/dtheta (size,) of the first ``size`` unknowns to each parameter held at 0, by name.

    Args:
        bread: (n, n) inverse of the information of the unknowns, motion marginalised out.
        shared: (n, k) information that the unknowns share with the parameters.
    """
    return dict(zip(names, -(bread @ shared)[:size].T, strict=True))


def considered_by_steps(steps: Mapping[str, FloatArray], config: AssumptionConfig) -> Considered:
    """What parameters held at 0 add to a covariance, from the sensitivities.

    Args:
        steps: by :func:`steps_by`.
    """
    return Considered(steps, {name: config.sigma(name) for name in steps})


def motion_covariance(robust: RobustCovariance, solution: JointSolution) -> FloatArray:
    """(n, n) part of the covariance that is there because the LiDAR's motion is measured, not known.

    The difference to the same problem with a motion a thousand times as well known.
    """
    known = solution.frozen_with([_with_known_motion(own) for own in solution.matches])
    return np.asarray(robust.bread - known.linearized(solution.optimum).covariance())


def _with_known_motion(matches: DriveMatches) -> DriveMatches:
    """The matches with the motion a thousand times as well known."""
    twists = matches.motions.l_twists
    if twists is None:
        return matches
    known = replace(twists, covariances=1e-6 * twists.covariances)
    return replace(matches, motions=replace(matches.motions, l_twists=known))


def budget(
    covariance: FloatArray, motion: FloatArray, shifts: FloatArray, considered: Considered
) -> dict[str, list[float]]:
    """JSON-able: the contribution of each part to the covariance of extrinsic and first offset, as sigmas
    (7).

    Args:
        covariance: (n, n) of matches and motion.
        motion: (n, n) part of it, by :func:`motion_covariance`.
        shifts: (s, s) by pictures that shift from image to image.
        considered: by the assumptions.
    """
    moved = np.clip(np.diag(motion)[:7], 0.0, np.diag(covariance)[:7])
    parts = {"matches": np.diag(covariance)[:7] - moved, "motion": moved}
    parts[SHIFTS] = np.diag(shifts)[:7]
    parts |= {name: np.diag(considered.part(name))[:7] for name in considered.sigmas}
    return {name: [float(f"{value:.6g}") for value in np.sqrt(part)] for name, part in parts.items()}


def remainder(total: FloatArray, explained: FloatArray) -> dict[str, list[float]]:
    """JSON-able part of a budget: what a covariance (7, 7) has beyond another (n, n), where there is any.

    The motion around single scans that nothing measures, and sweeps that nothing determines.
    """
    left = np.clip(np.diag(total) - np.diag(explained)[:7], 0.0, None)
    if not left.any():
        return {}
    return {"unmeasured motion and sweep": [float(f"{value:.6g}") for value in np.sqrt(left)]}
