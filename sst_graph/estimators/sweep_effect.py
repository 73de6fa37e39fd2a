"""What an undecided sweep does to an answer: solved again with the times of each hypothesis that is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.estimators.joint import JointConfig, JointSolution
from sst_graph.odometry.sweep import REMEDY, SweepTiming
from sst_graph.problem.drive import Drive
from sst_graph.problem.graph import PairMatches, joint_graph
from sst_graph.problem.state import EXTRINSIC, delay_key

FloatArray = NDArray[np.float64]

MATTERS = 0.5
"""A sweep matters where it makes up more than this share of the sigma that is claimed for an unknown."""


@dataclass(frozen=True)
class SweepEffects:
    """Why the answer is not to be believed, and the (7, 7) covariance that undecided sweeps add to it."""

    doubts: tuple[str, ...]
    covariance: FloatArray


def sweep_effects(
    solution: JointSolution, drives: Sequence[Drive], covariance: FloatArray, config: JointConfig
) -> SweepEffects:
    """The effect of every sweep that the scans did not tell, one drive at a time.

    The covariance is the mean square of the changes under the hypotheses, by their probability.

    covariance: (7, 7) of the answer, without it.
    """
    doubts, added = [], np.zeros((7, 7))
    for number, drive in enumerate(drives):
        sweep = drive.sweep
        if sweep is None or sweep.kind != "undecided" or not sweep.others:
            continue
        steps = {timing.fraction: sweep_step(solution, {number: timing}, config) for timing in sweep.others}
        effect = sum(sweep.shares[fraction] * np.outer(step, step) for fraction, step in steps.items())
        added += effect
        if np.sqrt(np.diag(effect) / np.diag(covariance + effect)).max() > MATTERS:
            worst = max(steps.values(), key=lambda step: float((step**2 / np.diag(covariance)).max()))
            doubts.append(
                f"{drive.name}: whether its clouds are compensated for the sweep cannot be told from the "
                f"scans (share of the sweep in the points {sweep.fraction:+.2f} +- {sweep.sigma:.2f}), and "
                f"it matters: {np.degrees(np.linalg.norm(worst[:3])):.2f} deg, "
                f"{100.0 * np.linalg.norm(worst[3:6]):.1f} cm, {1e3 * abs(worst[6]):.1f} ms; {REMEDY}"
            )
    return SweepEffects(tuple(doubts), added)


def sweep_step(
    solution: JointSolution, timings: Mapping[int, SweepTiming], config: JointConfig
) -> FloatArray:
    """(7,) change of extrinsic and (first) offset when the points of some drives have other times.

    On the frozen matches; right perturbation, [rad, m, s].

    Args:
        timings: by number of the drive; the points of all others keep their times.
    """
    pairs = [
        _retimed(pair, timings[pair.drive]) if pair.drive in timings else pair for pair in solution.pairs
    ]
    states = []
    for used in (solution.pairs, pairs):
        graph, values = joint_graph(used, solution.state, config.graph)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_ITERATIONS)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
        states.append((values.atPose3(EXTRINSIC), float(values.atVector(delay_key())[0])))
    (before, offset_s), (after, other_s) = states
    return np.append(gtsam.Pose3.Logmap(before.between(after)), other_s - offset_s)


_ITERATIONS = 10


def _retimed(pair: PairMatches, timing: SweepTiming) -> PairMatches:
    """The matches with times by azimuth for points that shared the stamp."""
    matches = {}
    for c, found in pair.matches.items():
        alignment = found.alignment
        offsets_s = timing.offsets_s(alignment.lPs.astype(np.float32)).astype(np.float64)
        alignment = replace(alignment, base_taus_s=alignment.base_taus_s - offsets_s)
        matches[c] = replace(found, alignment=alignment)
    return replace(pair, matches=matches)
