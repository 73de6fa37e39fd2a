"""Which start is right: candidates of the global search are solved on a few frames and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.association.search import Candidate
from sst_graph.errors import EstimationError
from sst_graph.estimators.joint import JointConfig, JointSolution, agreement, solve_joint
from sst_graph.estimators.start import StartConfig, find_start
from sst_graph.problem.drive import Drive, Progress
from sst_graph.problem.graph import Tracks
from sst_graph.problem.state import State
from sst_graph.types import SemanticClass

_ALIKE_RAD, _ALIKE_M, _ALIKE_S = 0.003, 0.05, 0.01
"""Solutions on a few frames that are closer than all of these lead to one answer."""
_SAME_DEG = 2.0
"""Solutions closer than this are one [deg]."""


@dataclass(frozen=True)
class Contest:
    """Outcome of a contest.

    Attributes:
        finalists: (cTl, offset [s]) of the best supported solutions, no two alike; the winner first.
        doubt: why the winner may be the wrong one; None where nothing speaks for another.
        score: of the search's best candidate.
    """

    finalists: tuple[tuple[gtsam.Pose3, float], ...]
    doubt: str | None
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
    """Search for a start and let the candidates compete.

    Without a guess a second search looks closer around the winner of the first.

    Raises:
        EstimationError: no candidate leads anywhere.
    """
    candidates = find_start(drives, tracks, classes, guess_cTl, guess_offset_s, config)
    contest = hold_contest(drives, tracks, candidates, guess_cTl, guess_offset_s, joint, config)
    if guess_cTl is not None:
        return contest
    cTl, offset_s = contest.finalists[0]
    closer = find_start(drives, tracks, classes, cTl, guess_offset_s, config)
    closer = [Candidate(cTl, offset_s, contest.score), *closer[: config.contenders]]
    return hold_contest(drives, tracks, closer, None, guess_offset_s, joint, config)


def hold_contest(
    drives: Sequence[Drive],
    tracks: Tracks,
    candidates: Sequence[Candidate],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    joint: JointConfig,
    config: StartConfig,
) -> Contest:
    """Solve the best candidates on a few scans; the solution that most matches agree with wins.

    Raises:
        EstimationError: no candidate leads anywhere.
    """
    if not config.enabled:
        return Contest(((candidates[0].cTl, candidates[0].offset_s),), None, candidates[0].score)
    few = [_thinned(drive, config.contest_scans) for drive in drives]
    contenders = config.free_contenders if guess_cTl is None else config.contenders
    starts = [
        State(candidate.cTl, (candidate.offset_s,))
        for candidate in _with_offsets(candidates[:contenders], guess_offset_s)
    ]
    for heat in _heats(_simple(joint, config)):
        contestants = [(start, prior_centre(start, guess_cTl, guess_offset_s)) for start in starts]
        solutions = solve_all(few, contestants, heat, tracks)
        starts = _survivors(solutions, config)
    solutions = [solution for solution in solutions if _is_within(solution, guess_cTl, config)]
    if not solutions:
        raise EstimationError("no candidate of the search leads to a solution near the guess")
    return Contest(_finalists(solutions, config.finalists), _doubt(solutions, config), candidates[0].score)


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


def _with_offsets(candidates: Sequence[Candidate], guess_offset_s: float) -> list[Candidate]:
    """The candidates, and the first of them at other time offsets: slow frames hardly tell the offset."""
    if all(candidate.offset_s == guess_offset_s for candidate in candidates):
        return list(candidates)
    others = [replace(candidates[0], offset_s=guess_offset_s + step) for step in (0.0, 0.25, -0.25)]
    return [*candidates, *others]


def _simple(joint: JointConfig, config: StartConfig) -> JointConfig:
    """Settings to compare with: one mask bias a class, only objects that are matched well."""
    match = joint.graph.match
    match = replace(match, min_object_share=max(match.min_object_share, config.min_object_share))
    return replace(joint, graph=replace(joint.graph, object_bias_sigma_px=0.0, match=match), min_matches=1)


def _heats(joint: JointConfig) -> list[JointConfig]:
    """Two kernels a heat while they are wide, the rest in the last one."""
    half = (len(joint.kernel_px) + 1) // 2
    wide = [joint.kernel_px[i : min(i + 2, half)] for i in range(0, half, 2)]
    return [*(replace(joint, kernel_px=some, max_outer=len(some)) for some in wide), narrowed(joint)]


def narrowed(joint: JointConfig) -> JointConfig:
    """Settings from a start that is nearly right: wide kernels would only lead away from it."""
    half = (len(joint.kernel_px) + 1) // 2
    return replace(joint, kernel_px=joint.kernel_px[half:] or joint.kernel_px[-1:])


def _survivors(solutions: Sequence[JointSolution], config: StartConfig) -> list[State]:
    """The better half of what differs; ``config.survivors`` or more."""
    kept: list[State] = []
    for solution in solutions:
        if not any(_alike(solution.state, state, 3.0) for state in kept):
            kept.append(solution.state)
    return kept[: max(config.survivors, (len(solutions) + 1) // 2)]


def _finalists(solutions: Sequence[JointSolution], most: int) -> tuple[tuple[gtsam.Pose3, float], ...]:
    """The first ``most`` solutions that differ; a few frames cannot always tell near ones apart."""
    found: list[State] = []
    for solution in solutions:
        if not any(_alike(solution.state, state) for state in found):
            found.append(solution.state)
    return tuple((state.cTl, state.offsets_s[0]) for state in found[:most])


def _alike(one: State, other: State, slack: float = 1.0) -> bool:
    """Whether two solutions on a few frames lead to one answer."""
    step = np.abs(gtsam.Pose3.Logmap(one.cTl.between(other.cTl)))
    late = abs(one.offsets_s[0] - other.offsets_s[0])
    return bool(
        step[:3].max() <= slack * _ALIKE_RAD
        and step[3:].max() <= slack * _ALIKE_M
        and late <= slack * _ALIKE_S
    )


def _thinned(drive: Drive, most: int) -> Drive:
    """The drive with at most so many scans, evenly spread."""
    chosen = np.unique(np.linspace(0, len(drive.scans) - 1, most).round().astype(int))
    return replace(drive, scans=tuple(drive.scans[i] for i in chosen))


def prior_centre(start: State, guess_cTl: gtsam.Pose3 | None, guess_offset_s: float) -> State:
    """What the weak priors are centred on: the guess, or the start's rotation without a translation."""
    rotation = start.cTl.rotation()
    cTl = guess_cTl if guess_cTl is not None else gtsam.Pose3(rotation, np.zeros(3))
    return State(cTl, (guess_offset_s,) * len(start.offsets_s))


def _is_within(solution: JointSolution, guess: gtsam.Pose3 | None, config: StartConfig) -> bool:
    """Whether the translation stayed where it was searched, and did not run away with the points."""
    search = config.search
    limit = 1.25 * search.free_translation_m if guess is None else 1.75 * search.translation_m
    centre = np.zeros(3) if guess is None else np.asarray(guess.translation())
    return float(np.linalg.norm(solution.state.cTl.translation() - centre)) < limit


def _doubt(solutions: Sequence[JointSolution], config: StartConfig) -> str | None:
    best, *others = solutions
    for other in others:
        turn = best.state.cTl.between(other.state.cTl).rotation()
        degrees = float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(turn))))
        share = agreement(other) / max(agreement(best), 1e-9)
        if degrees > _SAME_DEG and share > config.rival_ratio:
            return (
                f"a pose {degrees:.0f} deg away explains the labels almost as well (score {share:.2f} of the "
                "best one's): record more varied scenes or give a closer guess"
            )
    return None
