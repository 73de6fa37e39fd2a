"""The lens tested by edges: focal length, principal point and distortion as further unknowns.

Matches with the picture's edges are soft: they follow a wrong lens, and with the matches frozen hardly
anything of it shows. So the problem is solved again, and matched again, with these parameters free, all
together. Their deviations are those of its half-samples (:mod:`sst_graph.batch.by_edges.covariance`), and the
estimate over its deviation decides (Wald), by Student's t with one degree of freedom less than there are
half-samples.

A lens that is contradicted is a reason against the estimate where it matters: where the estimate moves
farther than it is known when those parameters are free that are contradicted. Where it moves less far, that
step is added to the covariance. What the others leave open is considered.

An estimate by labels is tested, too, by edges of some of its frames: those know the principal point several
times as well as the outlines of a few vehicles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS, named_sigmas
from sst_graph.batch.assumption_tests import ParameterTest, few_objects_factor, with_further_tests
from sst_graph.batch.by_edges.covariance import SAMPLES, half_sample_steps
from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX, START_KERNELS_PX
from sst_graph.batch.by_edges.problem import (
    EdgesProblem,
    LabelEstimate,
    edges_problem,
    problem_of_some_frames,
)
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.shared_errors import FEWEST
from sst_graph.drive.stages import begin, stage
from sst_graph.errors import EstimationError
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.known import motion_steps
from sst_graph.graph.matching import edges_of, match_all
from sst_graph.graph.outer_loop import JointProblem, solve_joint_steps, support_of
from sst_graph.graph.state import State, difference, step_text
from sst_graph.objects.tracks import ObjectId
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.types import FloatArray, Guess

MATTERS_SIGMAS = 2.0
"""A step longer than this many standard deviations, on any axis, is a reason against an estimate; one that is
shorter is less than one of the covariance that it is added to. Without this limit the rectified pictures of
KITTI, which are distorted by a few pixels at the border, would refuse estimates that they move by less than
0.1 deg and 1 cm."""

_LOST = 0.99
"""A solution that meets fewer edges than this share of the estimate's, which is one with the right lens, is
another optimum: wide kernels have led there, past edges that lie closer. Where the lens is wrong, more are
met (by 1 to 13 %), and two solutions of one optimum differ by less than 0.1 %."""


LENS = "lens by edges"
"""Name of this stage of a calibration."""
_BESIDE_LABELS = ("cx", "cy")
"""What edges test of it. Outlines of a few vehicles know the principal point to 3 to 9 px, edges of some
scans to 1 to 5 px. Of focal length and k1 labels know enough, and KITTI's pictures, which are not quite those
of their pinhole, would refuse estimates that this moves by less than their sigmas."""


@dataclass(frozen=True)
class LensTest:
    """The parameters of the lens, estimated together.

    Attributes:
        findings: the most contradicted first; none where nothing was tested.
        step: (7,) from the estimate to that with the contradicted parameters free, or with all of them where
            none is, or where others test the same [rad, m, s].
    """

    findings: tuple[ParameterTest, ...] = ()
    step: FloatArray | None = None

    @property
    def contradicted(self) -> tuple[ParameterTest, ...]:
        """Findings of the parameters that the data contradict."""
        return tuple(finding for finding in self.findings if finding.contradicted)

    @property
    def covariance(self) -> FloatArray:
        """(7, 7) what a contradicted lens adds."""
        if self.step is None or not self.contradicted:
            return np.zeros((7, 7))
        return np.outer(self.step, self.step)

    def reasons(self, covariance: FloatArray) -> tuple[str, ...]:
        """A sentence where a contradicted lens matters to an estimate of a covariance (7, 7)."""
        if not self._matters(covariance):
            return ()
        first, *others = self.contradicted
        also = ", ".join(other.assumption.figure(other.value, other.sigma) for other in others)
        return (first.sentence + (f" (estimated with it: {also})" if also else ""),)

    def remarks(self, covariance: FloatArray) -> tuple[str, ...]:
        """A sentence where it is contradicted and does not matter."""
        if not self.contradicted or self._matters(covariance):
            return ()
        assert self.step is not None
        figures = ", ".join(each.assumption.figure(each.value, each.sigma) for each in self.contradicted)
        return (
            f"the lens is a little off, and the sigmas cover it: {figures}; with the lens free the "
            f"estimate moves by {step_text(self.step)}",
        )

    def _matters(self, covariance: FloatArray) -> bool:
        if self.step is None or not self.contradicted:
            return False
        return bool((np.abs(self.step) > MATTERS_SIGMAS * np.sqrt(np.diag(covariance))).any())


def lens_steps(
    edges: EdgesProblem,
    state: State,
    objects: Sequence[Mapping[ObjectId, int]],
    config: AssumptionConfig,
    beside: Sequence[ParameterTest] | None = None,
) -> Stepwise[LensTest]:
    """Estimate the parameters of the lens that are held, and test them; step by step.

    Args:
        edges: the problem that was solved.
        state: its estimate.
        objects: tracks of each drive's objects.
        beside: tests by other data, none of which contradicts anything, that the principal point's are put
            together with. Nothing is tested where that cannot contradict it.
    """
    estimated = dict(named_sigmas(edges.whole.config.graph.estimate))
    names = [name for name, each in ASSUMPTIONS.items() if each.by_edges and name not in estimated]
    if not config.test or not names:
        return LensTest()
    free, start = edges.whole.estimating(names), state.with_parameters(names)
    # Soft matches follow a wrong lens for many steps. Beside other tests of the same parameters the first
    # steps are enough: the later ones move the parameters by a fifth of a sigma.
    few = replace(free, config=replace(free.config, max_outer=len(START_KERNELS_PX)))
    try:
        wide = yield from solve_joint_steps(free if beside is None else few, start, START_KERNELS_PX)
        found = yield from _near(free, wide.state)
        met, expected = _support(free, found, start)
        if met < _LOST * expected:
            found = yield from _near(free, start)
    except EstimationError:
        return LensTest()
    # Half-samples of the objects get half of the prior's information, so that their optimum differs from that
    # of the whole by chance alone.
    halves = replace(free, prior=edges.known.with_share(0.5))

    def settled(steps: Mapping[str, FloatArray]) -> bool:
        if beside is None:
            return False
        free_steps = {name: steps[name] for name in names if name in _BESIDE_LABELS}
        return not _may_contradict(beside, found, free_steps, config.threshold)

    _, steps = yield from half_sample_steps(halves, found, objects, settled)
    if settled(steps):
        return LensTest()
    findings = [_finding(name, found.nuisances[name], steps[name], config.threshold) for name in names]
    known = sorted((each for each in findings if each is not None), key=lambda each: -each.score)
    against = [each.assumption.name for each in known if each.contradicted]
    if against and beside is None:
        found = yield from _with_these(edges, state, found, against)
    return LensTest(tuple(known), difference(state, found))


def _with_these(edges: EdgesProblem, state: State, found: State, names: Sequence[str]) -> Stepwise[State]:
    """The solution with some parameters free, from that with all of them, or that one where it has none: what
    the others leave open is no step that these make."""
    free, start = edges.whole.estimating(names), state.with_parameters(names)
    turns = motion_steps(edges.whole.drives[0].camera, found.cTl)
    held = [name for name in turns if name in found.nuisances and name not in start.nuisances]
    turn = sum((found.nuisances[name] * turns[name][:6] for name in held), np.zeros(6))
    kept = {name: found.nuisances[name] for name in start.nuisances}
    try:
        return (yield from _near(free, replace(found, cTl=found.cTl.retract(turn), nuisances=kept)))
    except EstimationError:
        return found


def _near(problem: JointProblem, start: State) -> Stepwise[State]:
    """The solution by near edges. Soft matches follow a wrong lens, so points are matched to the peaks of
    their edges first."""
    first = yield from solve_joint_steps(problem.at_peaks(), start, NEAR_KERNELS_PX)
    return (yield from solve_joint_steps(problem, first.state, NEAR_KERNELS_PX)).state


def _support(problem: JointProblem, *states: State) -> list[float]:
    """How many edges are met at each state, by their robust weights."""
    kernel = RobustKernel("geman_mcclure", NEAR_KERNELS_PX[-1])
    edges = edges_of(problem.drives, problem.motions, problem.config.graph)
    return [sum(support_of(match_all(edges, state, kernel), state).values()) for state in states]


def _finding(name: str, value: float, steps: FloatArray, threshold: float) -> ParameterTest | None:
    """The test of one parameter by its steps (SAMPLES,) from the estimate to the half-samples; None where too
    few of these have one."""
    known = steps[np.isfinite(steps)]
    if len(known) < FEWEST:
        return None
    sigma = max(float(np.sqrt(np.mean(known**2))), 1e-12) * few_objects_factor(len(known), threshold)
    return ParameterTest.of(ASSUMPTIONS[name], value, sigma, threshold)


def _may_contradict(
    beside: Sequence[ParameterTest], found: State, steps: Mapping[str, FloatArray], threshold: float
) -> bool:
    """Whether tests of the principal point may contradict it beside others, from the steps (SAMPLES,) to the
    first half-samples; NaN for those to come.

    Their mean square is at least the sum so far over all of them. With a larger deviation the test only comes
    closer to those beside it, which contradict nothing.
    """
    least = few_objects_factor(SAMPLES, threshold) / np.sqrt(SAMPLES)
    sigmas = {name: max(least * float(np.sqrt(np.nansum(own**2))), 1e-12) for name, own in steps.items()}
    tests = [
        ParameterTest(ASSUMPTIONS[name], found.nuisances[name], sigma, False)
        for name, sigma in sigmas.items()
    ]
    return any(each.contradicted for each in with_further_tests(beside, tests, threshold))


def lens_beside_labels(
    problem: CalibrationProblem, state: State, beside: Sequence[ParameterTest] | None = None
) -> tuple[ParameterTest, ...]:
    """Tests of the principal point of an estimate by labels, by edges of some frames.

    Args:
        beside: tests by the labels, none of which contradicts anything. Where these and the edges cannot do
            so together, nothing is tested.

    Raises:
        DataError: a frame cannot be read again.
    """
    with stage(problem.progress, LENS):
        # 1. Some frames once more, for their edges.
        offsets_s = [state.time_offset_s(number) for number in range(len(problem.drives))]
        some = problem_of_some_frames(problem.drives, offsets_s, Guess(*state.calibration()), problem.config)
        if some is None:
            return ()
        # 2. The lens by these, from the estimate.
        calibration, offsets_s = some
        clocks = tuple(offsets_s[: len(state.time_offsets_s)])
        held = State(state.cTl, clocks, nuisances=dict(state.nuisances))
        edges = edges_problem(calibration, None, LabelEstimate(held, True))
        steps = lens_steps(edges, held, calibration.objects, problem.config.assumptions, beside)
        found = run_to_end(steps, partial(begin, problem.progress, LENS))
        return tuple(each for each in found.findings if each.assumption.name in _BESIDE_LABELS)
