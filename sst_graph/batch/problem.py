"""The problem of the joint method, and an estimate with its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.lower_edges import WithLowerEdges, with_lower_edges
from sst_graph.covariance.cluster_robust import RobustCovariance, robust_covariance
from sst_graph.covariance.considered import AssumptionConfig, Considered, considered_by_matches
from sst_graph.covariance.static_objects import static_covariance
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.drive.stages import run_stage
from sst_graph.fit import Fit, OuterIteration, Profile
from sst_graph.graph.drive_motion import DriveMotion, motions_of
from sst_graph.graph.outer_loop import (
    KERNELS_PX,
    NARROW_KERNELS_PX,
    JointProblem,
    JointSolution,
    solve_all,
)
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartProblem, prior_centre
from sst_graph.initialization.selection import Selection, alternatives, select_start_steps
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.quality.fit_of_solution import FitOfDrives
from sst_graph.types import Calibration, FloatArray, Guess


@dataclass(frozen=True)
class CalibrationProblem:
    """Drives that share one extrinsic, and the settings to solve them with.

    Attributes:
        drives: what is kept of them.
        motions: of each drive: its LiDAR's, and its objects' where those have mask biases.
        objects: tracks of the objects of each drive.
        guess: what is known beforehand.
        config: settings, the estimated parameters among those of the graph.
        progress: called with (stage, steps done, steps in all).
    """

    drives: Sequence[Drive]
    motions: Sequence[DriveMotion]
    objects: Sequence[dict[ObjectId, int]]
    guess: Guess
    config: CalibrationConfig
    progress: Progress | None = None

    @classmethod
    def of(
        cls,
        drives: Sequence[Drive],
        guess: Guess,
        config: CalibrationConfig,
        progress: Progress | None = None,
    ) -> CalibrationProblem:
        """The problem with objects tracked."""
        config = config.estimating
        config = replace(config, noise=replace(config.noise, every_image=True))
        objects = [object_tracks(drive) for drive in drives]
        by_object = config.noise.object_bias_sigma_px > 0.0
        motions = motions_of(drives, objects if by_object else None)
        return cls(drives, motions, objects, guess, config, progress)

    def prior_centre(self, state: State) -> State:
        """What the weak priors of a solution from or at a state are centred on."""
        return prior_centre(self.guess, state)

    def at_guess(self, state: State) -> State | None:
        """A state with the guess's extrinsic and time offset; None where no extrinsic was guessed."""
        if self.guess.cTl is None:
            return None
        offsets_s = (self.guess.time_offset_s,) * len(state.time_offsets_s)
        return replace(state, cTl=self.guess.cTl, time_offsets_s=offsets_s)

    @cached_property
    def fit_of_drives(self) -> FitOfDrives:
        """What measures how states fit the drives: their labels, or edges of their pictures."""
        graph = self.config.joint.graph
        return FitOfDrives(self.drives, self.motions, self.objects, graph, self.config.seed)

    def fit_at(
        self, state: State, iterations: Sequence[OuterIteration] = (), profiles: Sequence[Profile] = ()
    ) -> Fit | None:
        """How a state fits the drives; None where no boundary point has a contour or an edge nearby.

        Args:
            iterations: how the state was reached.
            profiles: along the unknowns.
        """
        return self.fit_of_drives.fit(state, self.at_guess(state), iterations, profiles)

    def joint(self) -> JointProblem:
        """The graph's part of the problem."""
        return JointProblem(self.drives, self.motions, self.config.joint)

    def start(self) -> Selection:
        """The best starts of a global search around the guess, compared on a few scans.

        Raises:
            EstimationError: no candidate leads anywhere.
        """
        # Objects have no bias of their own yet.
        problem = StartProblem(self.drives, motions_of(self.drives), self.config.classes, self.guess)
        steps = select_start_steps(problem, self.config.noise, self.config.search)
        return run_stage(steps, self.progress, "search of the start")

    def with_lower_edges(self, solutions: Sequence[JointSolution]) -> WithLowerEdges:
        """Solutions with the lower edges of classes whose labels agree about them.

        Args:
            solutions: without them, the one that agrees best with the labels first.
        """
        kept = [(one, self.prior_centre(one.state)) for one in alternatives(solutions)]
        return with_lower_edges(self.joint(), kept, self.config.lower_edges, self.progress)

    def solve_from(self, selection: Selection) -> Sequence[JointSolution]:
        """Solutions from every selected start, the one that agrees best with the labels first.

        Raises:
            EstimationError: none of them leads anywhere.
        """
        clocks = len(self.drives) if self.config.time_offset_per_drive else 1
        kernels_px = NARROW_KERNELS_PX if self.config.search.enabled else KERNELS_PX
        starts = [State(cTl, (time_offset_s,) * clocks) for cTl, time_offset_s in selection.starts]
        centred = [(start, self.prior_centre(start)) for start in starts]
        return solve_all(self.joint(), centred, kernels_px, self.progress)


@dataclass(frozen=True)
class MatchedDrives:
    """What an estimate was matched with: how other calibrations fit the same can be measured.

    Attributes:
        problem: drives with the boundary points that were matched.
        state: the estimate, with the mask biases.
    """

    problem: CalibrationProblem
    state: State

    def started_at(self, guess: Guess) -> MatchedDrives:
        """These drives, whose fit is compared with that of another start."""
        return replace(self, problem=replace(self.problem, guess=guess))

    def fit_at(self, at: Calibration) -> Fit | None:
        """The fit of a calibration, under the same mask biases."""
        return self.problem.fit_at(replace(self.state, cTl=at.cTl, time_offsets_s=(at.time_offset_s,)))


def robust_of(solution: JointSolution, objects: Sequence[dict[ObjectId, int]]) -> RobustCovariance:
    """The cluster-robust covariance of a solution."""
    made_at, prior = solution.frozen.state, solution.problem.prior
    return robust_covariance(solution.system, solution.values, solution.pairs, made_at, objects, prior)


@dataclass(frozen=True)
class JointEstimate:
    """A solution and its covariance by the matches.

    Attributes:
        solution: of the joint graph.
        robust: its cluster-robust covariance.
        covariance: (n, n) the same of all unknowns, inflated where labels and motion differ.
        by_static_objects: (n, n) by static objects alone.
    """

    solution: JointSolution
    robust: RobustCovariance
    covariance: FloatArray
    by_static_objects: FloatArray

    @classmethod
    def of(cls, solution: JointSolution, objects: Sequence[dict[ObjectId, int]]) -> JointEstimate:
        """The solution with the covariance of its last matches."""
        robust = robust_of(solution, objects)
        return cls(solution, robust, robust.matrix, static_covariance(robust, solution.pairs))

    def considered(self, config: AssumptionConfig) -> Considered:
        """What the assumptions that are not estimated add to the covariance."""
        last, known = self.solution, self.solution.problem.prior
        return considered_by_matches(self.robust, last.pairs, last.values, last.state, config, known)


@dataclass(frozen=True)
class JointOutcome:
    """The estimate of a problem, with the matches, the graph and the covariance's parts.

    Attributes:
        estimate: with the problem's solution.
        considered: what assumptions add to the covariance.
    """

    estimate: JointEstimate
    considered: Considered
