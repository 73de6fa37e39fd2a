"""The start of the joint method: candidates, refined side by side, and the best of them selected.

1. Candidates: poses of a grid whose labels agree (:mod:`~sst_graph.initialization.candidates`).
2. Refinement (:mod:`~sst_graph.initialization.refinement`): all of them by silhouettes on some scans, under
   narrowing kernels; the worse ones, and those that have converged to one pose, are dropped from stage to
   stage.
3. Selection: the best by silhouettes and by the labels of all points, and alternatives that are nearly as
   good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import EstimationError
from sst_graph.graph.matching import GraphConfig, edges_of
from sst_graph.graph.outer_loop import KERNELS_PX, NARROW_KERNELS_PX, JointSolution, agreement
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartProblem, candidate_steps, label_score_steps
from sst_graph.initialization.global_search import Candidate, SearchConfig
from sst_graph.initialization.pose_batch import BatchEquations, Poses
from sst_graph.initialization.refinement import RefinementProblem, refine_steps
from sst_graph.metrics import turn_rad
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import Stepwise
from sst_graph.types import Calibration, FloatArray, IntArray

_Start = TypeVar("_Start", Calibration, State)

SELECTION_SCANS = 10
"""Most scans of each drive that candidates are compared on."""
_CANDIDATES, _CANDIDATES_WITHOUT_GUESS = 320, 1280
"""Most candidates that are refined; 640 without a guess fail now and then."""
_WIDE_POINTS = 500
"""Boundary points, in all, that they are compared on while the kernels are wide."""
_KEPT_SHARE, _KEPT = 0.4, 16
"""Share of the candidates that goes on from one kernel stage to the next, but so many at least, if so many
differ."""
_WIDE_STAGES = (KERNELS_PX[:3], KERNELS_PX[3:6])
"""Scales of the wide kernels, by stages."""
_NARROW_STAGE = (*NARROW_KERNELS_PX, *[NARROW_KERNELS_PX[-1]] * 6)
"""Of the narrow ones; at the last scale most have converged after six steps."""
_SELECTED = 2
"""Most different starts that are solved on all frames."""
_SELECTED_RATIO = 0.7
"""Least score of such a start, as a fraction of the best one's."""
ALTERNATIVE_RATIO = 0.9
"""A different solution with at least this fraction of the best one's score makes the estimate ambiguous."""
_ALIKE_RAD, _ALIKE_M, _ALIKE_S = 0.003, 0.05, 0.01
"""Solutions on a few frames that are closer than all of these lead to one estimate."""
_STILL_ALIKE = 3.0
"""While kernels are wide, candidates count as one at this many times the distance."""
_SAME_RAD = float(np.radians(2.0))
"""Solutions closer than this are one [rad]."""
_FAR_RAD = float(np.radians(20.0))
"""A search around one pose finds those that are closer than this [rad]."""
_DISTANT = 3
"""Most poses that the second search looks around. Of 29 drives with bad labels or few objects, one was lost
without it; it takes a quarter of the time of a start without a guess."""
REACH = 1.25
"""Solutions may lie this many times as far from the guess as was searched, along each axis; without a guess,
in all."""


@dataclass(frozen=True)
class Selection:
    """Selected starts.

    Attributes:
        starts: the best supported solutions, no two alike; the best first, then one that is nearly as good
            and not near it, where there is one.
        distant: the best, and those nearly as good that are far from it and from each other.
        score: of the search's best candidate.
    """

    starts: tuple[Calibration, ...]
    distant: tuple[Calibration, ...]
    score: float


def select_start_steps(
    problem: StartProblem,
    graph: GraphConfig,
    config: SearchConfig,
    most_scans: int = SELECTION_SCANS,
    most_candidates: int = _CANDIDATES,
) -> Stepwise[Selection]:
    """Search candidates for a start, refine them and select the best.

    Without a guess a second search looks more closely around the best that are far from each other.

    Args:
        graph: noise and priors of the matches.
        most_scans: scans of each drive that candidates are compared on.
        most_candidates: that are refined of a search around a guess.

    Raises:
        EstimationError: no candidate leads to a solution near the guess.
    """
    candidates = yield from candidate_steps(problem, config)
    if not config.enabled:
        start = (Calibration(*candidates[0]),)
        return Selection(start, start, candidates[0].score)
    candidates = candidates[: _CANDIDATES_WITHOUT_GUESS if problem.guess.cTl is None else most_candidates]
    selection = yield from select_among_steps(problem, candidates, graph, config, most_scans)
    if problem.guess.cTl is not None:
        return selection
    closer = []
    for distant in selection.distant:
        guess = replace(problem.guess, cTl=distant.cTl)
        around = yield from candidate_steps(replace(problem, guess=guess), config)
        closer += [Candidate(**vars(distant), score=selection.score), *around[:most_candidates]]
    return (yield from select_among_steps(problem, closer, graph, config, most_scans))


def select_among_steps(
    problem: StartProblem,
    candidates: Sequence[Candidate],
    graph: GraphConfig,
    config: SearchConfig,
    most_scans: int = SELECTION_SCANS,
) -> Stepwise[Selection]:
    """Refine candidates; the solution that the labels agree with most is the first of the selection.

    Raises:
        EstimationError: no candidate leads to a solution near the guess.
    """
    # 1. All candidates under wide kernels, on some of the points.
    few = [replace(drive, scans=tuple(evenly_spread(drive.scans, most_scans))) for drive in problem.drives]
    full = RefinementProblem.of(edges_of(few, problem.motions, graph), graph)
    rough = full.thinned(_WIDE_POINTS)
    yield 10
    poses = _poses(_with_offsets(candidates, problem.guess.time_offset_s), full.biases)
    centres = _centres(poses, problem)
    for kernels_px in _WIDE_STAGES:
        poses = yield from refine_steps(rough, poses, centres, kernels_px)
        equations = yield from rough.equation_steps(poses, kernels_px[-1])
        kept = _kept(poses, equations)
        poses, centres = poses.take(kept), centres.take(kept)
    # 2. The remaining ones under narrow kernels, on all points.
    poses = yield from refine_steps(full, poses, centres, _NARROW_STAGE)
    equations = yield from full.equation_steps(poses, _NARROW_STAGE[-1])
    # 3. The best that stayed within reach, by boundaries and by all labels.
    scores = yield from label_score_steps(problem, poses, config)
    scores = (
        equations.agreements * np.sqrt(np.maximum(scores, 0.0)) * _in_reach(poses, problem.guess.cTl, config)
    )
    order = _different(poses, scores)
    if scores[order[0]] <= 0.0:
        raise EstimationError("no candidate of the search leads to a solution near the guess")
    poses, scores = poses.take(order), scores[order]
    good = scores > _SELECTED_RATIO * scores[0]
    starts = poses.take(np.flatnonzero(good)).calibrations
    distant = tuple(far_apart(starts, _FAR_RAD)[:_DISTANT])
    return Selection(_with_alternative(starts, scores[good]), distant, candidates[0].score)


def alternatives(solutions: Sequence[JointSolution]) -> list[JointSolution]:
    """The best solution and those elsewhere that agree with the labels well, too.

    Args:
        solutions: the one that agrees best first.
    """
    best = solutions[0]
    least = _SELECTED_RATIO * agreement(best)
    return [s for s in solutions if s is best or (agreement(s) > least and not _alike(s.state, best.state))]


def _with_alternative(starts: Sequence[Calibration], scores: FloatArray) -> tuple[Calibration, ...]:
    """The first of some starts, best first, after the best one an alternative to it, where there is one."""
    best = starts[0].cTl
    for number, start in enumerate(starts):
        if scores[number] > ALTERNATIVE_RATIO * scores[0] and turn_rad(best, start.cTl) > _SAME_RAD:
            others = [one for other, one in enumerate(starts) if other not in (0, number)]
            return (starts[0], starts[number], *others[: _SELECTED - 1])
    return tuple(starts[:_SELECTED])


def far_apart(starts: Sequence[_Start], least_rad: float) -> list[_Start]:
    """Some starts that are turned by more than an angle [rad] against every better one."""
    chosen: list[_Start] = []
    for start in starts:
        if all(turn_rad(start.cTl, other.cTl) > least_rad for other in chosen):
            chosen.append(start)
    return chosen


def _alike(one: State, other: State) -> bool:
    """Whether two solutions lead to one estimate."""
    step = one.cTl.between(other.cTl)
    near = turn_rad(one.cTl, other.cTl) < _ALIKE_RAD
    near &= bool((np.abs(step.translation()) <= _ALIKE_M).all())
    return near and abs(one.time_offsets_s[0] - other.time_offsets_s[0]) <= _ALIKE_S


def _with_offsets(candidates: Sequence[Candidate], guess_time_offset_s: float) -> list[Candidate]:
    """The candidates, and the first of them at other time offsets: slow frames hardly determine the
    offset."""
    if all(candidate.time_offset_s == guess_time_offset_s for candidate in candidates):
        return list(candidates)
    others = [replace(candidates[0], time_offset_s=guess_time_offset_s + step) for step in (0.0, 0.25, -0.25)]
    return [*candidates, *others]


def _poses(candidates: Sequence[Candidate], biases: int) -> Poses:
    return Poses(
        np.stack([candidate.cTl.rotation().matrix() for candidate in candidates]),
        np.stack([candidate.cTl.translation() for candidate in candidates]),
        np.array([candidate.time_offset_s for candidate in candidates]),
        np.zeros((len(candidates), biases)),
    )


def _centres(poses: Poses, problem: StartProblem) -> Poses:
    """What the weak priors of each pose are centred on, as in
    :func:`sst_graph.initialization.candidates.prior_centre`."""
    offsets, guess = np.full(len(poses), problem.guess.time_offset_s), problem.guess.cTl
    if guess is None:
        return Poses(poses.rotations, np.zeros_like(poses.translations), offsets, poses.biases)
    rotations = np.broadcast_to(guess.rotation().matrix(), poses.rotations.shape)
    translations = np.broadcast_to(guess.translation(), poses.translations.shape)
    return Poses(rotations, translations, offsets, poses.biases)


def _kept(poses: Poses, equations: BatchEquations) -> IntArray:
    """The better share of the poses, as far as they differ."""
    most = max(_KEPT, round(_KEPT_SHARE * len(poses)))
    return _different(poses, equations.agreements, _STILL_ALIKE)[:most]


def _different(poses: Poses, scores: FloatArray, slack: float = 1.0) -> IntArray:
    """Positions of the poses that are not near a better one, the best first."""
    remaining, chosen = np.argsort(-scores, kind="stable"), []
    flat = poses.rotations.reshape(-1, 9)
    trace = 1.0 + 2.0 * np.cos(slack * _ALIKE_RAD)
    while len(remaining):
        best = remaining[0]
        chosen.append(best)
        alike = flat[remaining] @ flat[best] > trace
        shift = np.abs(poses.translations[remaining] - poses.translations[best]).max(axis=1)
        late = np.abs(poses.offsets[remaining] - poses.offsets[best])
        alike &= (shift <= slack * _ALIKE_M) & (late <= slack * _ALIKE_S)
        alike[0] = True
        remaining = remaining[~alike]
    return np.array(chosen, dtype=np.intp)


def _in_reach(poses: Poses, guess: gtsam.Pose3 | None, config: SearchConfig) -> NDArray[np.bool_]:
    """(m,) whether the translation stayed within the searched region."""
    if guess is None:
        return np.asarray(np.linalg.norm(poses.translations, axis=1) < REACH * config.free_translation_m)
    away = np.abs(poses.translations - np.asarray(guess.translation()))
    return np.asarray((away < REACH * config.translation_m).all(axis=1))
