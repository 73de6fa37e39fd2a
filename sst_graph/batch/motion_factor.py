"""The hand-eye solution as one more factor of the joint graph, and as a check of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.contradictions import FALSE_ALARM
from sst_graph.batch.method_estimate import first_after, held_offsets
from sst_graph.batch.part_solver import CONTRADICTIONS, PartSolver, SolvedPart
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.covariance.contradiction import Difference, PartEstimate, name_step
from sst_graph.drive.preparation import Drive
from sst_graph.drive.stages import stage
from sst_graph.drive.stamp_intervals import Jump
from sst_graph.errors import EstimationError
from sst_graph.graph.known import KnownCalibration, motion_steps
from sst_graph.graph.outer_loop import KERNELS_PX, solve_joint
from sst_graph.graph.state import State, difference, nuisance_key
from sst_graph.hand_eye.solution import MotionSolution, alternative, solve_motion
from sst_graph.types import FloatArray, Guess

MAX_DISAGREEMENT_CHI2 = 40.0
"""Chi-squared, of 7, of the difference between labels and motion up to which the motion is used: both
covariances may be too small by a factor of 1.7 for an agreement that a 95 % quantile (14.07) would accept."""
UNLIKELY_CHI2 = 14.07
"""95 % quantile of chi-squared with 7 degrees of freedom: beyond it a covariance grows by Birge's ratio,
squared."""


@dataclass(frozen=True)
class WithMotion:
    """A joint estimate after it was compared with the motion.

    Attributes:
        estimate: with the motion in its graph, or as it was where the motion is not used.
        reasons: a sentence where labels and motion contradict each other.
        diagnostics: JSON-able numbers.
        remarks: a sentence where the motion was left out for a stretch of a drive that contradicts it.
    """

    estimate: JointEstimate
    reasons: tuple[str, ...] = ()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def may_use_motion(config: CalibrationConfig) -> bool:
    """Whether the settings allow motion in the joint graph."""
    return config.method == "joint" and config.use_motion != "never" and not config.time_offset_per_drive


def with_motion(
    problem: CalibrationProblem, labels: JointEstimate, stretches: Sequence[SolvedPart]
) -> WithMotion:
    """The estimate with the motion in its graph, where the settings allow it and the two agree.

    With ``use_motion=auto`` the motion is used where the points of a scan share one time: a rolling sweep is
    compensated by the very motion. Nor is it used where a parameter is estimated that misleads the motion,
    for it would hold it at zero.

    Args:
        labels: what the labels alone say.
        stretches: of the drives, each solved by itself; steps are from that solution.
    """
    config = problem.config
    if not may_use_motion(config):
        return WithMotion(labels)
    if config.use_motion == "auto":
        if misleading := config.assumptions.misleading_motion:
            why = f"the motion takes {' and '.join(misleading)} for zero"
            return WithMotion(labels, diagnostics={"left_out": why})
        if any(scan.offsets_s.any() for drive in problem.drives for scan in drive.scans):
            return WithMotion(labels, diagnostics={"left_out": "the scans are rolling sweeps"})
    return fuse_motion(problem, labels, stretches)


def fuse_motion(
    problem: CalibrationProblem, labels: JointEstimate, stretches: Sequence[SolvedPart]
) -> WithMotion:
    """The estimate with the hand-eye solution as a factor, where labels and motion agree.

    The labels determine translation, and the time offset by speed alone; the motion determines the time
    offset by turning, also where the speed is constant. Both depend on the LiDAR's odometry, whose noise
    counts as independent here.
    """
    # 1. The hand-eye solution from the joint one.
    config, state = problem.config, labels.solution.state
    try:
        reach_s = config.search.time_offset_s
        guess = Guess(*state.calibration())
        motion = solve_motion(problem.drives, guess, reach_s, problem.progress)[0]
    except EstimationError as error:
        return WithMotion(labels, diagnostics={"left_out": str(error)})
    # 2. Do they agree? Motion that does not fit itself contradicts nothing.
    steps = motion_steps(problem.drives[0].camera, motion.state.cTl)
    known = KnownCalibration(motion.state, motion.covariance, steps)
    step, covariance = _disagreement(known, labels)
    chi2 = float(step @ np.linalg.solve(covariance + motion.covariance, step))
    sigmas = np.sqrt(np.diag(motion.covariance))
    facts = {
        "chi2_of_7": chi2,
        "time_offset_s": motion.state.time_offsets_s[0],
        "sigma_time_offset_s": float(sigmas[6]),
    }
    if motion.misfit is not None:
        return _left_out(labels, f"the motion was left out: {motion.misfit}", facts)
    if chi2 > MAX_DISAGREEMENT_CHI2 or not motion.converged:
        return WithMotion(labels, _contradiction(step, chi2, motion), facts)
    with stage(problem.progress, CONTRADICTIONS):
        worst = _worst_stretch(PartSolver(problem, state), stretches, motion, step)
    if worst is not None:
        facts["stretch_p_value"] = worst[1].p_value * len(stretches)
        if facts["stretch_p_value"] < FALSE_ALARM:
            return _left_out(labels, _of_stretch(problem.drives, worst, state), facts)
    # 3. Outlines once more, the motion among the factors.
    joint = replace(problem.joint(), centre=problem.prior_centre(state), prior=known)
    solution = solve_joint(joint, state, KERNELS_PX[-1:], problem.progress)
    # 4. The covariance; Birge's ratio, squared, where labels and motion differ by more than theirs allow.
    inflation = chi2 / len(step) if chi2 > UNLIKELY_CHI2 else 1.0
    fused = JointEstimate.of(solution, problem.objects)
    fused = replace(fused, covariance=inflation * fused.covariance)
    return WithMotion(fused, diagnostics={"fused": True, **facts})


def _worst_stretch(
    parts: PartSolver, stretches: Sequence[SolvedPart], motion: MotionSolution, step: FloatArray
) -> tuple[SolvedPart, Difference] | None:
    """The stretch whose labels contradict the motion most, and the difference; None without stretches.

    Where it is significant, the stretch is solved from the motion's estimate, too: what it says is the
    optimum that contradicts the motion least, of those that it supports.

    Args:
        step: (7,) from the labels' estimate to what motion says.
    """
    own = PartEstimate(step, motion.covariance)

    def compared(stretch: SolvedPart) -> Difference:
        difference = Difference.of(stretch.step, own)
        if difference.p_value * len(stretches) >= FALSE_ALARM:
            return difference
        start = State(motion.state.cTl, (motion.state.time_offsets_s[0],))
        found = [Difference.of(each.step, own) for each in parts.estimates(stretch, start)]
        return max(found, key=lambda each: each.rank)

    every = [(stretch, compared(stretch)) for stretch in stretches]
    return min(every, key=lambda pair: pair[1].rank, default=None)


def _disagreement(motion: KnownCalibration, labels: JointEstimate) -> tuple[FloatArray, FloatArray]:
    """Step (7,) from the labels' estimate to what motion says under the parameters that they estimate, and
    its (7, 7) covariance by the labels."""
    state, unknowns = labels.solution.state, labels.robust.unknowns
    names = list(state.nuisances)
    follows = motion.columns(names)
    step = difference(state, motion.state) - follows @ np.array([state.nuisances[name] for name in names])
    jacobian = np.eye(7, unknowns.size)
    jacobian[:, [unknowns.column(nuisance_key(name)) for name in names]] = follows
    return step, jacobian @ labels.covariance @ jacobian.T


def _left_out(labels: JointEstimate, sentence: str, facts: Mapping[str, Any]) -> WithMotion:
    """The estimate as it was, and why."""
    return WithMotion(labels, diagnostics={"left_out": sentence, **facts}, remarks=(sentence,))


def _of_stretch(drives: Sequence[Drive], worst: tuple[SolvedPart, Difference], state: State) -> str:
    part, difference = worst[0].part, worst[1]
    scans = drives[part.drive].scans
    return (
        f"the motion was left out, for it contradicts the labels of {drives[part.drive].name}, frames "
        f"{scans[part.scans[0]].index} to {scans[part.scans[-1]].index}: it differs from them in "
        f"{name_step(difference, state.cTl).sentence}"
    )


def _contradiction(step: FloatArray, chi2: float, motion: MotionSolution) -> tuple[str, ...]:
    """A sentence about two solutions that differ; none where the motion did not converge by itself."""
    if not motion.converged:
        return ()
    degrees, metres = np.degrees(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:6]))
    return (
        f"motion alone gives another calibration, {degrees:.2f} deg, {100 * metres:.0f} cm and "
        f"{1e3 * step[6]:+.1f} ms away (chi-squared {chi2:.0f} of 7): labels or odometry are wrong",
    )


def offsets_held_by_motion(
    drives: Sequence[Drive], state: State, config: CalibrationConfig
) -> dict[str, str]:
    """:func:`~sst_graph.batch.method_estimate.held_offsets` by motion alone.

    Args:
        state: estimate of all frames.
    """

    def solved(number: int, jumps: Sequence[Jump]) -> list[PartEstimate | None]:
        parts = _between_jumps(drives[number], jumps, config.search.time_offset_s)
        return [_by_motion(part, state.of_drive(number), config) for part in parts]

    return held_offsets(drives, config, solved, "the motion")


def _between_jumps(drive: Drive, jumps: Sequence[Jump], margin_s: float) -> list[Drive]:
    """The drive with the motions of the sensors before, between and behind jumps of their stamps.

    Args:
        margin_s: by how much stamps of the other sensor may be off.
    """
    ends = [(jump.sensor, first_after(drive, jump).stamp_ns) for jump in jumps]
    margin_ns = round(1e9 * margin_s)

    def kept(sensor: str, from_ns: int, to_ns: int, part: int) -> bool:
        """Whether a motion of a sensor lies in a part, or may do so by the other sensor's stamps."""
        for k, (jumped, at_ns) in enumerate(ends):
            more_ns = 0 if jumped == sensor else margin_ns
            if (k >= part and to_ns >= at_ns + more_ns) or (k < part and from_ns < at_ns - more_ns):
                return False
        return True

    return [
        replace(
            drive,
            image_pairs=tuple(
                pair
                for pair in drive.image_pairs
                if kept("image", pair.tracks.from_ns, pair.tracks.to_ns, part)
            ),
            lidar_motions=tuple(
                motion for motion in drive.lidar_motions if kept("scan", motion.from_ns, motion.to_ns, part)
            ),
        )
        for part in range(len(ends) + 1)
    ]


def _by_motion(part: Drive, state: State, config: CalibrationConfig) -> PartEstimate | None:
    """A part's own estimate by motion, as a step from a state; None where it has none."""
    try:
        solutions = solve_motion([part], Guess(*state.calibration()), config.search.time_offset_s)
    except (EstimationError, np.linalg.LinAlgError):
        return None
    found = solutions[0]
    if not found.converged or found.misfit is not None or alternative(solutions) is not None:
        return None
    return PartEstimate(difference(state, found.state), found.covariance)
