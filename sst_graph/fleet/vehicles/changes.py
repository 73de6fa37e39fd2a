"""Where a vehicle's calibration changes by a step, and which of its drives contradicts the others.

Two kinds of hypotheses are tested against the random walk (:mod:`sst_graph.fleet.vehicles.walk`), both with
seven unknowns and so with one chi-squared of 7 degrees of freedom, whatever the direction:

- a step between two consecutive drives: the drives before it against those after it;
- a drive that contradicts: that drive against all others of its stretch.

An assumption that is off, such as a principal point, moves all drives of a vehicle nearly alike: it explains
a difference between two sides only as far as it moves them differently.

The least likely one is taken if its probability, times the number of hypotheses, is below the false-alarm
rate; then the rest is tested with that one in place, until nothing is left. A step before the last drive and
a last drive that contradicts are one and the same in the data: it is called a change with one drive on a
side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam

from sst_graph.covariance.contradiction import Difference, PartEstimate, name_step
from sst_graph.fleet.vehicles.walk import DriveEstimate, Passes, WalkConfig, passes
from sst_graph.marginal import Separated, separated


@dataclass(frozen=True, eq=False)
class VehicleChange:
    """A step, or a drive that contradicts the others.

    Attributes:
        difference: from the earlier drives to the later ones, or from the others to the drive.
        cTl: the extrinsic before it.
        p_value: probability that a hypothesis of a vehicle without any looks so, all of them counted.
    """

    difference: Difference
    cTl: gtsam.Pose3
    p_value: float

    @property
    def words(self) -> str:
        """Its size with its sigma, by the fewest of rotation, translation and time offset."""
        return name_step(self.difference, self.cTl).sentence

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which of rotation, translation and offset changed."""
        return name_step(self.difference, self.cTl).kinds


@dataclass(frozen=True)
class Findings:
    """What was found in the drives of one vehicle.

    Attributes:
        steps: by k, a step between drive k - 1 and drive k of those that are left.
        contradicting: by the name of the drive that was left out.
        left: the drives that are left.
    """

    steps: dict[int, VehicleChange]
    contradicting: dict[str, VehicleChange]
    left: tuple[DriveEstimate, ...]


def find_changes(drives: Sequence[DriveEstimate], config: WalkConfig) -> Findings:
    """Steps and contradicting drives of one vehicle.

    Args:
        drives: in the order of their days.

    Raises:
        EstimationError: a marginal without an optimum.
    """
    hypotheses = max(2 * len(drives) - 1, 1)
    state = Findings({}, {}, tuple(drives))
    while (found := _next(state, config, hypotheses)) is not None:
        state = _merged(found, config, hypotheses)
    return _confirmed(state, config, hypotheses)


def _next(state: Findings, config: WalkConfig, hypotheses: int) -> Findings | None:
    """With the least likely hypothesis that is left taken as true, or None where none is unlikely enough."""
    left, both_ways = state.left, passes(state.left, state.steps, config)
    candidates: list[tuple[tuple[float, float], int, bool, VehicleChange]] = []
    for k in range(len(left)):
        for a_step, finding in (
            (True, _step(both_ways, k, hypotheses)),
            (False, _alone(both_ways, left, k, hypotheses)),
        ):
            if finding is not None:
                candidates.append((finding.difference.rank, k, a_step, finding))
    if not candidates:
        return None
    # A step at an end and the drive at that end are equally likely but for rounding: it is called a step.
    least = min(candidates, key=lambda one: one[0])
    equal = [one for one in candidates if one[2] and one[0][1] <= least[0][1] * (1.0 - _ROUNDING)]
    _, k, a_step, finding = equal[0] if equal else least
    if finding.p_value >= config.false_alarm_rate:
        return None
    if a_step:
        return replace(state, steps={**state.steps, k: finding})
    return _without(state, k, finding)


_ROUNDING = 1e-3
"""Relative difference of two chi-squared of the same hypothesis: what linearization leaves of it."""


def _step(both_ways: Passes, k: int, hypotheses: int) -> VehicleChange | None:
    """A step between drive k - 1 and drive k, if they are tied."""
    earlier = both_ways.before[k]
    return None if earlier is None else _compared(earlier, both_ways.since[k], hypotheses)


def _alone(both_ways: Passes, left: Sequence[DriveEstimate], k: int, hypotheses: int) -> VehicleChange | None:
    """Drive k against all others of its stretch, if there are any."""
    earlier, later = both_ways.before[k], both_ways.after[k]
    if earlier is None or later is None:
        others = later if earlier is None else earlier
    else:
        others = earlier.plus(later)
    return None if others is None else _compared(others, separated(left[k].marginal), hypotheses)


def _compared(one: Separated, other: Separated, hypotheses: int) -> VehicleChange:
    best = one.own.best()
    parts = []
    for separate in (one, other):
        there = separate.carried(best)
        covariance = there.own.covariance()
        parts.append(PartEstimate(covariance @ there.own.vector, covariance, common=there.errors))
    difference = Difference.of(parts[0], parts[1])
    return VehicleChange(difference, best.cTl, min(1.0, hypotheses * difference.p_value))


def _without(state: Findings, k: int, finding: VehicleChange) -> Findings:
    """Drive k left out; a step before it stands before the next one."""
    steps = {at - (at > k): step for at, step in state.steps.items()}
    left = (*state.left[:k], *state.left[k + 1 :])
    return Findings(steps, {**state.contradicting, state.left[k].name: finding}, left)


def _merged(state: Findings, config: WalkConfig, hypotheses: int) -> Findings:
    """Two steps around a single drive whose neighbours agree are one drive that contradicts."""
    for k in sorted(state.steps):
        if k + 1 not in state.steps or k == 0 or k + 1 >= len(state.left):
            continue
        steps = {at: step for at, step in state.steps.items() if at not in (k, k + 1)}
        without = _without(replace(state, steps=steps), k, state.steps[k])
        finding = _step(passes(without.left, without.steps, config), k, hypotheses)
        if finding is not None and finding.p_value >= config.false_alarm_rate:
            both_ways = passes(state.left, steps, config)
            alone = _alone(both_ways, state.left, k, hypotheses)
            if alone is not None:
                return _without(replace(state, steps=steps), k, alone)
    return state


def _confirmed(state: Findings, config: WalkConfig, hypotheses: int) -> Findings:
    """Each step tested once more with all the others in place; what is not needed with them is dropped."""
    steps = dict(state.steps)
    for k in sorted(state.steps):
        others = [at for at in steps if at != k]
        finding = _step(passes(state.left, others, config), k, hypotheses)
        if finding is None or finding.p_value >= config.false_alarm_rate:
            del steps[k]
        else:
            steps[k] = finding
    return replace(state, steps=steps)
