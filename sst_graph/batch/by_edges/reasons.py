"""Whether calibration by edges has worked: how far its score stands out, and whether motion agrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import gtsam
import numpy as np

from sst_graph.edges.agreement import score
from sst_graph.edges.turns import turned_states
from sst_graph.graph.matching import DriveEdges
from sst_graph.graph.outer_loop import JointSolution, still_moved
from sst_graph.graph.state import State, difference, step_text
from sst_graph.hand_eye.solution import MotionSolution
from sst_graph.metrics import turn_rad
from sst_graph.stepwise import Stepwise
from sst_graph.types import FloatArray

SCORE_WORK = 5
"""A score of some scans, in units of work (:mod:`sst_graph.stepwise`)."""
BLUR_PX = 2.0
"""Blur of the scores that are compared [px]."""
_APART_DEG = 1.0
"""Other solutions farther than this are other optima [deg]."""
MIN_CONTRAST = 6.0
"""Least height of the estimate's score above those of the random rotations, in their standard deviations:
right ones have 7 to 25, wrong pictures 3 to 5."""
MIN_OVER_OTHER = 1.08
"""Least ratio of the estimate's score to that of the best other optimum."""
MAX_MOTION_CHI2 = 13.3
"""Chi-squared, of 4 (rotation and time offset), of the difference from motion beyond which the two
contradict: one in a hundred right ones exceeds it. Right ones on streets and the KITTI drives have 0.1 to 2,
a false optimum in a forest 16 to 40."""
_FLOOR = np.array([*np.radians([0.1] * 3), 0.005])
"""Added to the sigmas of that difference [rad, s]: with it, 1.2 deg of pitch or yaw contradict a motion that
knows them to 0.1 deg. The two differ by up to 0.11 deg on the KITTI drives; a false optimum in a forest lies
1.2 deg away from motion."""
_FLOOR_OF_MISFIT = np.array([*np.radians([0.5] * 3), 0.005])
"""In place of :data:`_FLOOR` for a motion that does not fit itself, whose covariance says less [rad, s]."""
_SETTLED_STEP = np.array([*np.radians([0.1] * 3), 0.025, 0.025, 0.025, 0.015])
"""(7,) farther apart, two solutions are not one optimum [rad, m, s]: right ones came back to within 0.01 deg,
a false one ended 0.4 deg away."""
MAX_FROM_GUESS_M = 0.35
"""Farthest that an estimate may lie from the guess: it is bound to it [m]."""


@dataclass(frozen=True)
class EdgeContrast:
    """How far an estimate's score stands out.

    Attributes:
        score: of the estimate.
        sigmas: its height above the mean at random rotations, in their standard deviations.
        ratio: to the highest of them.
        other: score of the best other optimum; 0 without one.
    """

    score: float
    sigmas: float
    ratio: float
    other: float

    def to_dict(self) -> dict[str, float]:
        """JSON-able, with what is expected of an estimate that is right."""
        return {**asdict(self), "least_sigmas": MIN_CONTRAST, "least_over_other": MIN_OVER_OTHER}


def edge_contrast_steps(
    edges: Sequence[DriveEdges], state: State, others: Sequence[State], seed: int
) -> Stepwise[EdgeContrast]:
    """Scores at the estimate, at random rotations around it, and at other solutions."""
    around = []
    for turned_state in turned_states(state, seed):
        around.append(score(edges, turned_state, BLUR_PX))
        yield SCORE_WORK
    own = score(edges, state, BLUR_PX)
    apart = [each for each in others if np.degrees(turn_rad(each.cTl, state.cTl)) > _APART_DEG]
    other = max((score(edges, each, BLUR_PX) for each in apart), default=0.0)
    yield SCORE_WORK * (1 + len(apart))
    height, spread = own - float(np.mean(around)), float(np.std(around)) + 1e-9
    return EdgeContrast(own, height / spread, own / max(max(around), 1e-9), other)


def unsettled_reasons(step: FloatArray) -> tuple[str, ...]:
    """Why an estimate may be wrong from which an optimum nearby lies by a step (7,)."""
    if (np.abs(step) <= _SETTLED_STEP).all():
        return ()
    return (
        "solved again with edges farther away, and from there with near ones, the estimate ends "
        f"{step_text(step)} away: it has not settled on one set of edges",
    )


def edges_reasons(solution: JointSolution, of_pose: Sequence[str], centre: State) -> tuple[str, ...]:
    """Why the estimate may be wrong altogether; none where nothing says so.

    Args:
        of_pose: :func:`pose_reasons`.
    """
    moved = () if solution.converged else (still_moved(solution.outer_iterations),)
    return (*moved, *of_pose, *far_reasons(solution.state.cTl, centre.cTl))


def pose_reasons(
    state: State, contrast: EdgeContrast, motion: MotionSolution | None, covariance: FloatArray
) -> tuple[str, ...]:
    """Why the pose may be another one altogether.

    Args:
        covariance: (7, 7) of the estimate.
    """
    return (*contrast_reasons(contrast), *_motion_reasons(state, motion, covariance))


def _motion_reasons(state: State, motion: MotionSolution | None, covariance: FloatArray) -> list[str]:
    """Why an estimate may be wrong that motion contradicts."""
    if motion is None:
        return []
    step = difference(motion.state, state)[[0, 1, 2, 6]]
    floor = _FLOOR if motion.misfit is None else _FLOOR_OF_MISFIT
    total = (motion.covariance + covariance)[np.ix_([0, 1, 2, 6], [0, 1, 2, 6])] + np.diag(floor**2)
    chi2 = float(step @ np.linalg.solve(total, step))
    if chi2 <= MAX_MOTION_CHI2:
        return []
    why = "" if motion.misfit is None else f" ({motion.misfit})"
    return [
        f"motion alone gives another calibration, {np.degrees(np.linalg.norm(step[:3])):.2f} deg and "
        f"{1e3 * step[3]:+.1f} ms away (chi-squared {chi2:.0f} of 4){why}"
    ]


def with_lens_reasons(
    reasons: Sequence[str], of_lens: Sequence[str], of_pose: Sequence[str]
) -> tuple[str, ...]:
    """All reasons, the most important first. Where the pose may be another one altogether, those against the
    lens are no causes: at a wrong pose some wrong lens always fits better.

    Args:
        of_pose: those of the reasons that say so (:func:`pose_reasons`).
    """
    return (*reasons, *of_lens) if of_pose else (*of_lens, *reasons)


def contrast_reasons(contrast: EdgeContrast) -> list[str]:
    """Why a score that stands out so little may be that of a wrong pose."""
    reasons = []
    if contrast.sigmas < MIN_CONTRAST:
        reasons.append(
            f"edges of LiDAR and pictures agree hardly better than at rotations 2 to 4 deg away "
            f"({contrast.sigmas:.1f} standard deviations, expected {MIN_CONTRAST:g} or more): "
            "the pose may be wrong altogether"
        )
    if contrast.other > 0.0 and contrast.score < MIN_OVER_OTHER * contrast.other:
        reasons.append(
            "another pose agrees with the pictures almost as well "
            f"(score {contrast.score:.0f} against {contrast.other:.0f}): "
            "give a closer guess or a richer drive"
        )
    return reasons


def far_reasons(cTl: gtsam.Pose3, guess: gtsam.Pose3) -> list[str]:
    """Why an estimate far from the guess may be wrong."""
    away = float(np.linalg.norm(cTl.translation() - guess.translation()))
    if away <= MAX_FROM_GUESS_M:
        return []
    return [
        f"the estimate lies {away:.2f} m from the guess, farther than edges can tell (at most "
        f"{MAX_FROM_GUESS_M:g} m)"
    ]
