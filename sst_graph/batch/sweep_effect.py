"""What an undecided sweep does to an answer: solved again with the times of each hypothesis that is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive
from sst_graph.graph.frozen_problem import FrozenProblem
from sst_graph.graph.matching import DriveMatches
from sst_graph.graph.outer_loop import JointConfig, JointSolution
from sst_graph.odometry.sweep import REMEDY, SweepTiming

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
    retimed = [
        _retimed(own, timings[own.number]) if own.number in timings else own for own in solution.matches
    ]
    before, after = (
        FrozenProblem(used, solution.state, config.graph).optimum(_ITERATIONS)[0]
        for used in (solution.matches, retimed)
    )
    step = gtsam.Pose3.Logmap(before.cTl.between(after.cTl))
    return np.append(step, after.scalars[0] - before.scalars[0])


_ITERATIONS = 10


def _retimed(matches: DriveMatches, timing: SweepTiming) -> DriveMatches:
    """The matches with times by azimuth for points that shared the stamp."""
    alignment = matches.alignment
    offsets_s = timing.offsets_s(alignment.lPs.astype(np.float32)).astype(np.float64)
    alignment = replace(alignment, base_taus_s=alignment.base_taus_s - offsets_s)
    return replace(matches, found=replace(matches.found, alignment=alignment))
