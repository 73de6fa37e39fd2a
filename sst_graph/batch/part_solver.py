"""Estimates of parts of the data by themselves: each solved again from the estimate of all data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.covariance.contradiction import PartEstimate
from sst_graph.drive.preparation import Drive
from sst_graph.drive.stages import begin
from sst_graph.errors import EstimationError
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.matching import edges_of, match_all
from sst_graph.graph.outer_loop import JointProblem, JointSolution, robust_weights, solve_joint
from sst_graph.graph.state import State, difference
from sst_graph.objects.tracks import tracks_of_scans
from sst_graph.types import FloatArray

CONTRADICTIONS = "contradictions between frames"
"""Name of the stage of a calibration that solves parts by themselves."""

_KERNELS_PX = (20.0, 12.0, 8.0, 5.0, 4.0, 3.0)
"""Scales of the robust kernel of a part's solution, outer iteration by outer iteration [px]."""

_MOST_AT_LAST_SCALE = 3
"""Most further outer iterations at the last kernel scale: what is left of a step then is within a sigma."""

_FAR_MORE = 2.0
"""A solution one frame away must begin with this many times the support of the one found. Where a scan was
lost at 9 m/s it has four times that."""

_NEARLY = 0.9
"""Share of the support of one optimum that another has which a part leaves open, too. Two optima of five
frames of a clean street, 34 cm and 0.6 deg apart, had 229 and 227 matches."""


@dataclass(frozen=True)
class Part:
    """Some scans of one drive, by ascending position."""

    drive: int
    scans: tuple[int, ...]


@dataclass(frozen=True)
class SolvedPart:
    """A part and its own estimate.

    Attributes:
        part: which.
        state: its own estimate, on one clock.
        step: the same as a step from the reference, with its covariance.
    """

    part: Part
    state: State
    step: PartEstimate


@dataclass(frozen=True)
class PartSolver:
    """Solves parts of drives by themselves.

    Attributes:
        problem: the drives, and how all of them were solved together.
        reference: the estimate of all drives together, where the parts start and what their weak priors are
            centred on.
    """

    problem: CalibrationProblem
    reference: State

    @property
    def drives(self) -> Sequence[Drive]:
        return self.problem.drives

    def solve(self, part: Part) -> SolvedPart | None:
        """A part's own estimate, from the reference; None where it has none."""
        found = self._solved(part, self.reference_of(part), _KERNELS_PX)
        own = 0.0 if found is None else self.total_support(part, found.state)
        # Where an image or a scan is lost and the numbering goes on, outlines of close objects move too far
        # for a kernel to reach: one frame earlier or later has far more support than what is found here.
        beside = [(self.total_support(part, state), state) for state in self._frames_beside(part)]
        support, start = max(beside, key=lambda one: one[0])
        if support > _FAR_MORE * own:
            return self._solved(part, start, _KERNELS_PX) or found
        return found

    def _frames_beside(self, part: Part) -> list[State]:
        """The reference, one image or one scan earlier or later."""
        reference, drive = self.reference_of(part), self.drives[part.drive]
        periods_s = {round(period_s, 3) for period_s in (drive.image_period_s, drive.scan_period_s)}
        return [reference.later(sign * period_s) for period_s in sorted(periods_s) for sign in (-1.0, 1.0)]

    def total_support(self, part: Part, state: State) -> float:
        """:meth:`support` of all scans of a part together."""
        return float(self.support(part, state).sum())

    def solve_from(self, part: Part, start: State) -> SolvedPart | None:
        """A part solved by itself from a start that is nearly right; None where it has no estimate."""
        return self._solved(part, start, _KERNELS_PX[len(_KERNELS_PX) // 2 :])

    def estimates(self, found: SolvedPart, start: State) -> tuple[SolvedPart, ...]:
        """A part's estimate, and the one from another start where the part supports that nearly as well: the
        few objects of some frames may leave two optima open."""
        part = found.part
        other = self.solve_from(part, start)
        if other is None:
            return (found,)
        enough = _NEARLY * self.total_support(part, found.state)
        return (found, other) if self.total_support(part, other.state) >= enough else (found,)

    def best_start(self, part: Part, starts: Sequence[State]) -> State:
        """The reference, or the one of other states, with the largest support of the part."""
        candidates = [self.reference_of(part), *starts]
        return max(candidates, key=lambda start: self.total_support(part, start))

    def _solved(self, part: Part, start: State, kernels_px: tuple[float, ...]) -> SolvedPart | None:
        joint = replace(self.problem.config.joint, max_outer=len(kernels_px) + _MOST_AT_LAST_SCALE)
        drive, motion = self._data(part)
        try:
            problem = JointProblem([drive], [motion], joint, self.reference_of(part))
            begin(self.problem.progress, CONTRADICTIONS)
            solution = solve_joint(problem, start, kernels_px)
            return SolvedPart(part, solution.state, self._step(part, solution))
        except (EstimationError, np.linalg.LinAlgError):
            return None

    def reference_of(self, part: Part) -> State:
        """The reference on the part's clock alone."""
        return self.reference.of_drive(part.drive)

    def _step(self, part: Part, solution: JointSolution) -> PartEstimate:
        objects = [tracks_of_scans(self.problem.objects[part.drive], part.scans)]
        estimate = JointEstimate.of(solution, objects)
        considered = estimate.considered(self.problem.config.assumptions)
        # By static objects alone: a vehicle that brakes looks like another time offset.
        covariance = estimate.by_static_objects[:7, :7]
        step = difference(self.reference_of(part), solution.state)
        return PartEstimate(step, covariance, estimate.robust.table.clusters, considered.steps())

    def _data(self, part: Part) -> tuple[Drive, DriveMotion]:
        """The drive and its motion, of the part's scans alone."""
        drive, motion = self.drives[part.drive], self.problem.motions[part.drive]
        return drive.part(part.scans), motion.part(part.scans)

    def support(self, part: Part, state: State) -> FloatArray:
        """(scans,) how much each scan of a part agrees with a state: matches, counted by robust weight."""
        drive, motion = self._data(part)
        kernel = RobustKernel("geman_mcclure", _KERNELS_PX[-1])
        found = np.zeros(len(part.scans))
        for own in match_all(edges_of([drive], [motion], self.problem.config.noise), state, kernel):
            scans = np.array([pair.scan for pair in own.pairs])[own.pair_of]
            found += np.bincount(scans, robust_weights(own, state), len(found))
        return found
