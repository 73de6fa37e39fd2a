"""The total covariance of a joint estimate.

It is the sum of the parts by matches, by pictures that shift from image to image, by assumptions, by
unmeasured motion, and by sweeps that the scans leave undecided: for these the problem is solved again with
the point times of each remaining hypothesis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.batch.method_estimate import DriveCovariance
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.covariance.considered import Considered, budget, motion_covariance, remainder
from sst_graph.covariance.image_shifts import ImageShifts, image_shifts
from sst_graph.covariance.undecided_sweep import SweepEffect
from sst_graph.covariance.unknown_motion import unknown_motion_covariance
from sst_graph.graph.matching import DriveMatches
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.odometry.sweep import SweepTiming
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class TotalCovariance:
    """How well a joint estimate is known.

    Attributes:
        unknowns: (n, n) of the extrinsic and all offsets, by matches, shifts of the pictures and assumptions.
        covariance: (7, 7) of the extrinsic and the first offset, by everything.
        by_drive: where drives have an offset each, of the extrinsic and that offset.
        budget: sigmas (7) by each part, JSON-able.
        reasons: sweeps that nothing decides and that matter.
        by_sweeps: (7, 7) part of it by sweeps that the scans leave undecided.
        shifts: of the pictures and their stamps from image to image.
    """

    unknowns: FloatArray
    covariance: FloatArray
    by_drive: tuple[DriveCovariance, ...]
    budget: dict[str, list[float]]
    shifts: ImageShifts
    reasons: tuple[str, ...] = ()
    by_sweeps: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences that say that pictures shift, or stamps jitter; none where it does not matter."""
        return self.shifts.sentences(self.covariance)


def total_covariance(
    problem: CalibrationProblem, estimate: JointEstimate, considered: Considered
) -> TotalCovariance:
    """The covariance by matches, shifts of the pictures, assumptions, unknown motion and undecided sweeps.

    Args:
        considered: what the assumptions add.
    """
    solution = estimate.solution
    size = 6 + len(solution.state.time_offsets_s)
    # 1. Matches, pictures that shift from image to image, and assumptions.
    motion = motion_covariance(estimate.robust, solution)
    shifts = image_shifts(estimate.robust, solution.pairs, solution.values, solution.state)
    parts = budget(estimate.covariance, motion, shifts.covariance, considered)
    unknowns = estimate.covariance[:size, :size] + shifts.covariance + considered.covariance(size)
    # 2. Motion that nothing measures.
    known = unknowns[:7, :7] + _unknown_motion(problem, solution, float(unknowns[6, 6]))
    # 3. Sweeps.
    sweeps = sweep_effects(problem, solution, known)
    total = known + sweeps.covariance
    by_drive = _by_drive(problem, estimate, unknowns)
    spent = parts | remainder(total, unknowns)
    return TotalCovariance(unknowns, total, by_drive, spent, shifts, sweeps.reasons, sweeps.covariance)


def _unknown_motion(problem: CalibrationProblem, solution: JointSolution, variance_s2: float) -> FloatArray:
    """(7, 7) by motion that nothing measures; variance_s2: of the time offset [s^2]."""
    config = problem.config.unknown_motion
    return unknown_motion_covariance(solution.pairs, solution.state, variance_s2, config)


def _by_drive(
    problem: CalibrationProblem, estimate: JointEstimate, unknowns: FloatArray
) -> tuple[DriveCovariance, ...]:
    """Covariances of the extrinsic and each drive's own offset, where drives have one each."""
    drives = problem.drives if len(estimate.solution.state.time_offsets_s) > 1 else ()
    found = []
    for number, drive in enumerate(drives):
        own = [*range(6), 6 + number]
        block = unknowns[np.ix_(own, own)]
        block = block + _unknown_motion(problem, estimate.solution, float(block[6, 6]))
        static = estimate.by_static_objects[np.ix_(own, own)]
        found.append(DriveCovariance(drive.name, block, static))
    return tuple(found)


@dataclass(frozen=True)
class SweepEffects:
    """Sweeps that nothing decides and that matter, and the (7, 7) covariance that undecided sweeps add."""

    reasons: tuple[str, ...]
    covariance: FloatArray


def sweep_effects(
    problem: CalibrationProblem, solution: JointSolution, covariance: FloatArray
) -> SweepEffects:
    """The effect of every sweep that the scans leave undecided, one drive at a time.

    Args:
        covariance: (7, 7) of the estimate, without it.
    """
    reasons, added = [], np.zeros((7, 7))
    for number, drive in enumerate(problem.drives):
        sweep = drive.sweep
        if sweep is None or sweep.kind != "undecided" or not sweep.others:
            continue
        steps = {timing.fraction: sweep_step(solution, {number: timing}) for timing in sweep.others}
        effect = SweepEffect.of(sweep, steps, covariance)
        added += effect.covariance
        if effect.sentence:
            reasons.append(f"{drive.name}: {effect.sentence}")
    return SweepEffects(tuple(reasons), added)


def sweep_step(solution: JointSolution, timings: Mapping[int, SweepTiming]) -> FloatArray:
    """(7,) change of extrinsic and (first) offset when the points of some drives have other times.

    On the frozen matches; right perturbation, [rad, m, s].

    Args:
        timings: by number of the drive; the points of all others keep their times.
    """
    retimed = [
        _retimed(own, timings[own.number]) if own.number in timings else own for own in solution.matches
    ]
    before, after = (
        frozen.optimum(_ITERATIONS)[0] for frozen in (solution.frozen, solution.frozen_with(retimed))
    )
    step = gtsam.Pose3.Logmap(before.cTl.between(after.cTl))
    return np.append(step, after.scalars[0] - before.scalars[0])


_ITERATIONS = 10
"""Levenberg-Marquardt iterations on frozen matches: they begin at the optimum under the other times."""


def _retimed(matches: DriveMatches, timing: SweepTiming) -> DriveMatches:
    """The matches with times by azimuth for points that shared the stamp."""
    alignment = matches.alignment
    offsets_s = timing.offsets_s(alignment.lPs.astype(np.float32)).astype(np.float64)
    alignment = replace(alignment, base_taus_s=alignment.base_taus_s - offsets_s)
    return replace(matches, found=replace(matches.found, alignment=alignment))
