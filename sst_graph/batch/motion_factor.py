"""What motion alone says, as one more factor of the joint graph, and as a check of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.parts import SolvedPart
from sst_graph.covariance.contradiction import Difference, PartAnswer, name_step
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.graph.building import Tracks
from sst_graph.graph.outer_loop import JointSolution, solve_joint
from sst_graph.graph.state import EXTRINSIC, State, time_offset_key
from sst_graph.hand_eye.solution import difference, solve_motion

FloatArray = NDArray[np.float64]

_UNLIKELY_CHI2 = 14.07
"""95 % quantile of chi-squared with 7 degrees of freedom."""


@dataclass(frozen=True)
class Labels:
    """What the labels alone say.

    Attributes:
        solution: of the joint graph.
        covariance: (7, 7) of it.
        stretches: of the drives, each solved by itself; steps are from the solution.
    """

    solution: JointSolution
    covariance: FloatArray
    stretches: Sequence[SolvedPart] = ()


@dataclass(frozen=True)
class WithMotion:
    """A joint solution after motion was heard.

    Attributes:
        solution: with the motion in its graph, or as it was where motion says nothing or something else.
        doubts: a sentence where the two contradict each other.
        inflation: of the covariance of what both say together: 1 where they agree as their covariances
            claim, else the chi-squared of their difference over its dimension (Birge's ratio, squared).
        diagnostics: JSON-able numbers.
        remarks: a sentence where the motion was left out for a stretch of a drive that contradicts it.
    """

    solution: JointSolution
    doubts: tuple[str, ...] = ()
    inflation: float = 1.0
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def with_motion(
    drives: Sequence[Drive],
    tracks: Tracks,
    labels: Labels,
    guess: State,
    config: CalibrationConfig,
    progress: Progress | None = None,
) -> WithMotion:
    """The joint solution with the hand-eye solution as a factor, where the two agree.

    The labels see translation, and the time offset by speed alone; the motion sees the time offset by
    turning, also where the speed is constant. Both lean on the LiDAR's odometry, whose noise counts as
    independent here.

    Args:
        labels: what they say alone.
        guess: what the weak priors are centred on.
    """
    # 1. The hand-eye solution from the joint one.
    solution, state = labels.solution, labels.solution.state
    try:
        motion = solve_motion(drives, state.cTl, state.offsets_s[0], config.motion, progress)[0]
    except EstimationError as error:
        return WithMotion(solution, diagnostics={"left_out": str(error)})
    # 2. Do they agree?
    step = difference(state, motion.state)
    apart = float(step @ np.linalg.solve(labels.covariance + motion.covariance, step))
    sigmas = np.sqrt(np.diag(motion.covariance))
    facts = {"chi2_of_7": apart, "offset_s": motion.state.offsets_s[0], "sigma_offset_s": float(sigmas[6])}
    if apart > config.motion.max_disagreement or not motion.converged:
        return WithMotion(solution, _contradiction(step, apart, motion.converged), diagnostics=facts)
    worst = _worst_stretch(labels.stretches, PartAnswer(step, motion.covariance))
    if worst is not None:
        facts["stretch_p_value"] = worst[1].p_value * len(labels.stretches)
        if facts["stretch_p_value"] < config.contradictions.false_alarm:
            said = _of_stretch(drives, worst, state)
            return WithMotion(solution, diagnostics={"left_out": said, **facts}, remarks=(said,))
    # 3. Silhouettes once more, the motion among the factors.
    belief = gaussian_factor(motion.state, motion.covariance)
    last_scale = replace(config.joint, kernel_px=config.joint.kernel_px[-1:])
    fused = solve_joint(drives, state, last_scale, progress, guess, tracks, belief)
    inflation = apart / len(step) if apart > _UNLIKELY_CHI2 else 1.0
    return WithMotion(fused, inflation=inflation, diagnostics={"fused": True, **facts})


def gaussian_factor(state: State, covariance: FloatArray) -> gtsam.LinearContainerFactor:
    """[Log(E_0^-1 E); D - D_0] with a (7, 7) covariance, linear about the state (E_0, D_0)."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    unit = gtsam.noiseModel.Unit.Create(7)
    linear = gtsam.JacobianFactor(EXTRINSIC, root[:, :6], time_offset_key(), root[:, 6:], np.zeros(7), unit)
    point = gtsam.Values()
    point.insert(EXTRINSIC, state.cTl)
    point.insert(time_offset_key(), np.array(state.offsets_s[:1]))
    return gtsam.LinearContainerFactor(linear, point)


def _worst_stretch(
    stretches: Sequence[SolvedPart], motion: PartAnswer
) -> tuple[SolvedPart, Difference] | None:
    """The stretch whose labels contradict the motion most; None without stretches."""
    compared = [(stretch, Difference.of(stretch.answer, motion)) for stretch in stretches]
    return min(compared, key=lambda pair: pair[1].rank, default=None)


def _of_stretch(drives: Sequence[Drive], worst: tuple[SolvedPart, Difference], state: State) -> str:
    part, difference = worst[0].part, worst[1]
    scans = drives[part.drive].scans
    return (
        f"the motion was left out, for it contradicts the labels of {drives[part.drive].name}, frames "
        f"{scans[part.scans[0]].index} to {scans[part.scans[-1]].index}: it differs from them in "
        f"{name_step(difference, state.cTl).sentence}"
    )


def _contradiction(step: FloatArray, chi2: float, converged: bool) -> tuple[str, ...]:
    """A sentence about two solutions that lie apart; none where the motion found no end by itself."""
    if not converged:
        return ()
    degrees, metres = np.degrees(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:6]))
    return (
        f"motion alone says another calibration, {degrees:.2f} deg, {100 * metres:.0f} cm and "
        f"{1e3 * step[6]:+.1f} ms away (chi-squared {chi2:.0f} of 7): labels or odometry are wrong",
    )
