"""Which start is right: candidates of the global search are solved on a few frames and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.graph.building import GraphConfig, Tracks
from sst_graph.graph.outer_loop import JointConfig, JointSolution, agreement, solve_joint
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartConfig, finding_start, scoring_labels
from sst_graph.initialization.global_search import Candidate, SearchConfig
from sst_graph.initialization.label_agreement import States
from sst_graph.initialization.many_poses import Poses, Steps
from sst_graph.initialization.refinement import Field, holding_heat
from sst_graph.stepwise import Stepwise, whole
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_ALIKE_RAD, _ALIKE_M, _ALIKE_S = 0.003, 0.05, 0.01
"""Solutions on a few frames that are closer than all of these lead to one answer."""
_SAME_DEG = 2.0
"""Solutions closer than this are one [deg]."""
_FAR_DEG = 20.0
"""A search around one pose finds those that are closer than this [deg]."""
REACH = 1.25
"""Solutions may lie this many times as far from the guess as was searched, along each axis; without a guess,
in all."""


@dataclass(frozen=True)
class Contest:
    """Outcome of a contest.

    Attributes:
        finalists: (cTl, offset [s]) of the best supported solutions, no two alike; the winner first, then one
            that is nearly as good and not near it, where there is one.
        leads: the winner and those of the others, with the support of a finalist, that are far from it.
        score: of the search's best candidate.
    """

    finalists: tuple[tuple[gtsam.Pose3, float], ...]
    leads: tuple[tuple[gtsam.Pose3, float], ...]
    score: float


def choose_start(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    joint: JointConfig,
    config: StartConfig,
) -> Contest:
    """All steps of :func:`choosing_start`."""
    steps = choosing_start(drives, tracks, classes, guess_cTl, guess_offset_s, joint, config)
    return whole(steps)


def choosing_start(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    joint: JointConfig,
    config: StartConfig,
) -> Stepwise[Contest]:
    """Search for a start and let the candidates compete.

    Without a guess a second search looks closer around the best of the first that are far from each other.

    Raises:
        EstimationError: no candidate leads anywhere.
    """
    coarse = replace(config, search=_coarse(config))
    candidates = yield from finding_start(drives, tracks, classes, guess_cTl, guess_offset_s, coarse)
    contest = yield from holding_contest(
        drives, tracks, classes, candidates, guess_cTl, guess_offset_s, joint, config
    )
    if guess_cTl is not None:
        return contest
    closer = []
    for cTl, offset_s in contest.leads:
        around = yield from finding_start(drives, tracks, classes, cTl, guess_offset_s, coarse)
        closer += [Candidate(cTl, offset_s, contest.score), *around[: config.contenders]]
    return (yield from holding_contest(drives, tracks, classes, closer, None, guess_offset_s, joint, config))


def hold_contest(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    candidates: Sequence[Candidate],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    joint: JointConfig,
    config: StartConfig,
) -> Contest:
    """All steps of :func:`holding_contest`."""
    steps = holding_contest(drives, tracks, classes, candidates, guess_cTl, guess_offset_s, joint, config)
    return whole(steps)


def holding_contest(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    candidates: Sequence[Candidate],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    joint: JointConfig,
    config: StartConfig,
) -> Stepwise[Contest]:
    """Solve the best candidates on a few scans; the solution that the labels agree with most wins.

    Raises:
        EstimationError: no candidate leads anywhere.
    """
    if not config.enabled:
        start = ((candidates[0].cTl, candidates[0].offset_s),)
        return Contest(start, start, candidates[0].score)
    # 1. All candidates under wide kernels, on some of the points.
    few = [_thinned(drive, config.contest_scans) for drive in drives]
    field = Field.of(few, tracks, classes, _simple(joint.graph, config))
    quick = field.thinned(config.heat_points)
    yield 10
    contenders = config.free_contenders if guess_cTl is None else config.contenders
    poses = _poses(_with_offsets(candidates[:contenders], guess_offset_s), field.biases)
    centres = _centres(poses, guess_cTl, guess_offset_s)
    for kernels_px in _wide_heats(joint):
        poses = yield from holding_heat(quick, poses, centres, kernels_px)
        steps = yield from quick.stepping(poses, kernels_px[-1])
        kept = _survivors(poses, steps, config)
        poses, centres = poses.take(kept), centres.take(kept)
    # 2. What is left under narrow ones, on all points.
    narrow = narrowed(joint).kernel_px
    poses = yield from holding_heat(field, poses, centres, (*narrow, *[narrow[-1]] * config.settling))
    # 3. The best that stayed within reach, by boundaries and by all labels.
    steps = yield from field.stepping(poses, narrow[-1])
    states = States(poses.rotations, poses.translations, poses.offsets)
    scores = yield from scoring_labels(drives, tracks, classes, states, guess_offset_s, config)
    ranks = _agreements(steps) * np.sqrt(np.maximum(scores, 0.0)) * _within(poses, guess_cTl, config)
    order = _different(poses, ranks)
    if ranks[order[0]] <= 0.0:
        raise EstimationError("no candidate of the search leads to a solution near the guess")
    poses, ranks = poses.take(order), ranks[order]
    finalists = [
        (pose, float(offset))
        for pose, offset, rank in zip(_cTls(poses), poses.offsets, ranks, strict=True)
        if rank > config.finalist_ratio * ranks[0]
    ]
    leads = tuple(_far_apart(finalists)[: config.leads])
    rival, most = _rival(_cTls(poses), ranks, config), config.finalists
    if rival is not None:
        finalists.insert(1, finalists.pop(rival))
        most += 1
    return Contest(tuple(finalists[:most]), leads, candidates[0].score)


def solve_all(
    drives: Sequence[Drive],
    starts: Sequence[tuple[State, State]],
    joint: JointConfig,
    tracks: Tracks,
    progress: Progress | None = None,
) -> list[JointSolution]:
    """Solutions from (start, what the weak priors are centred on), the one that agrees best first.

    Raises:
        EstimationError: none leads anywhere.
    """
    solutions, failures = [], []
    for start, centre in starts:
        try:
            solutions.append(solve_joint(drives, start, joint, progress, centre, tracks))
        except EstimationError as error:
            failures.append(error)
    if not solutions:
        raise failures[0]
    return sorted(solutions, key=agreement, reverse=True)


def rivals(
    solutions: Sequence[JointSolution],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    config: StartConfig,
) -> list[tuple[JointSolution, State]]:
    """The best solution and others elsewhere that agree well, too, with what their priors centre on.

    Args:
        solutions: the one that agrees best first.
    """
    best = solutions[0]
    least = config.finalist_ratio * agreement(best)
    chosen = [s for s in solutions if s is best or (agreement(s) > least and not _alike(s.state, best.state))]
    return [(solution, prior_centre(solution.state, guess_cTl, guess_offset_s)) for solution in chosen]


def _alike(one: State, other: State) -> bool:
    """Whether two solutions lead to one answer."""
    step = one.cTl.between(other.cTl)
    near = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))) < _ALIKE_RAD
    near &= bool((np.abs(step.translation()) <= _ALIKE_M).all())
    return near and abs(one.offsets_s[0] - other.offsets_s[0]) <= _ALIKE_S


def narrowed(joint: JointConfig) -> JointConfig:
    """Settings from a start that is nearly right: wide kernels would only lead away from it."""
    half = (len(joint.kernel_px) + 1) // 2
    return replace(joint, kernel_px=joint.kernel_px[half:] or joint.kernel_px[-1:])


def prior_centre(start: State, guess_cTl: gtsam.Pose3 | None, guess_offset_s: float) -> State:
    """What the weak priors are centred on: the guess, or the start's rotation without a translation."""
    rotation = start.cTl.rotation()
    cTl = guess_cTl if guess_cTl is not None else gtsam.Pose3(rotation, np.zeros(3))
    return State(cTl, (guess_offset_s,) * len(start.offsets_s))


def _coarse(config: StartConfig) -> SearchConfig:
    """The search on the most blurred masks only: the heats reach farther than what they leave undone."""
    search = config.search
    return replace(
        search,
        blurs_px=search.blurs_px[:1],
        shares=search.shares[:1],
        candidates=search.candidates[:1],
        population=config.population,
        rounds=config.rounds,
    )


def _with_offsets(candidates: Sequence[Candidate], guess_offset_s: float) -> list[Candidate]:
    """The candidates, and the first of them at other time offsets: slow frames hardly tell the offset."""
    if all(candidate.offset_s == guess_offset_s for candidate in candidates):
        return list(candidates)
    others = [replace(candidates[0], offset_s=guess_offset_s + step) for step in (0.0, 0.25, -0.25)]
    return [*candidates, *others]


def _simple(graph: GraphConfig, config: StartConfig) -> GraphConfig:
    """Settings to compare with: only objects that are matched well."""
    share = max(graph.match.min_object_share, config.min_object_share)
    return replace(graph, match=replace(graph.match, min_object_share=share))


def _wide_heats(joint: JointConfig) -> list[tuple[float, ...]]:
    """The wider half of the kernels in two heats."""
    half = (len(joint.kernel_px) + 1) // 2
    wide = joint.kernel_px[:half]
    return [kernels for kernels in (wide[: half // 2], wide[half // 2 :]) if kernels]


def _thinned(drive: Drive, most: int) -> Drive:
    """The drive with at most so many scans, evenly spread."""
    chosen = np.unique(np.linspace(0, len(drive.scans) - 1, most).round().astype(int))
    return replace(drive, scans=tuple(drive.scans[i] for i in chosen))


def _poses(candidates: Sequence[Candidate], biases: int) -> Poses:
    return Poses(
        np.stack([candidate.cTl.rotation().matrix() for candidate in candidates]),
        np.stack([candidate.cTl.translation() for candidate in candidates]),
        np.array([candidate.offset_s for candidate in candidates]),
        np.zeros((len(candidates), biases)),
    )


def _cTls(poses: Poses) -> list[gtsam.Pose3]:
    return [
        gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t)
        for R, t in zip(poses.rotations, poses.translations, strict=True)
    ]


def _centres(poses: Poses, guess_cTl: gtsam.Pose3 | None, guess_offset_s: float) -> Poses:
    """What the weak priors of each pose are centred on, as in :func:`prior_centre`."""
    offsets = np.full(len(poses), guess_offset_s)
    if guess_cTl is None:
        return Poses(poses.rotations, np.zeros_like(poses.translations), offsets, poses.biases)
    rotations = np.broadcast_to(guess_cTl.rotation().matrix(), poses.rotations.shape)
    translations = np.broadcast_to(guess_cTl.translation(), poses.translations.shape)
    return Poses(rotations, translations, offsets, poses.biases)


def _agreements(steps: Steps) -> FloatArray:
    """(m,) as :func:`sst_graph.graph.outer_loop.agreement`."""
    return np.asarray(steps.support**2 / np.maximum(steps.seen, 1.0))


def _survivors(poses: Poses, steps: Steps, config: StartConfig) -> IntArray:
    """The better ``config.survival`` of the poses, as far as they differ; ``config.survivors`` or more."""
    most = max(config.survivors, round(config.survival * len(poses)))
    return _different(poses, _agreements(steps), 3.0)[:most]


def _different(poses: Poses, ranks: FloatArray, slack: float = 1.0) -> IntArray:
    """Positions of the poses that are not alike a better one, the best first."""
    remaining, chosen = np.argsort(-ranks, kind="stable"), []
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


def _within(poses: Poses, guess: gtsam.Pose3 | None, config: StartConfig) -> NDArray[np.bool_]:
    """(m,) whether the translation stayed where it was searched, and did not run away with the points."""
    search, away = config.search, poses.translations
    if guess is None:
        return np.asarray(np.linalg.norm(away, axis=1) < REACH * search.free_translation_m)
    return np.asarray(
        (np.abs(away - np.asarray(guess.translation())) < REACH * search.translation_m).all(axis=1)
    )


def _far_apart(starts: Sequence[tuple[gtsam.Pose3, float]]) -> list[tuple[gtsam.Pose3, float]]:
    """The starts that are turned by more than :data:`_FAR_DEG` against every better one."""
    chosen: list[tuple[gtsam.Pose3, float]] = []
    for cTl, offset_s in starts:
        if all(_turn_deg(cTl, other) > _FAR_DEG for other, _ in chosen):
            chosen.append((cTl, offset_s))
    return chosen


def _turn_deg(one: gtsam.Pose3, other: gtsam.Pose3) -> float:
    return float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(one.between(other).rotation()))))


def _rival(cTls: Sequence[gtsam.Pose3], ranks: FloatArray, config: StartConfig) -> int | None:
    """Which other pose, not near the first one, is nearly as good; None where none is."""
    for number, (other, rank) in enumerate(zip(cTls[1:], ranks[1:], strict=True), 1):
        if _turn_deg(cTls[0], other) > _SAME_DEG and rank > config.rival_ratio * ranks[0]:
            return number
    return None
