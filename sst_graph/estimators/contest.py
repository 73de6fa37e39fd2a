"""Which start is right: candidates of the global search are solved on a few frames and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.association.search import Candidate
from sst_graph.errors import EstimationError
from sst_graph.estimators.joint import JointConfig, JointSolution, solve_joint, support
from sst_graph.estimators.start import StartConfig
from sst_graph.problem.drive import Drive
from sst_graph.problem.graph import Tracks
from sst_graph.problem.state import State

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
    """

    finalists: tuple[tuple[gtsam.Pose3, float], ...]
    doubt: str | None


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
        return Contest(((candidates[0].cTl, candidates[0].offset_s),), None)
    few = [_thinned(drive, config.contest_scans) for drive in drives]
    contenders = config.free_contenders if guess_cTl is None else config.contenders
    starts = [
        State(candidate.cTl, (candidate.offset_s,))
        for candidate in _with_offsets(candidates[:contenders], guess_offset_s)
    ]
    solutions: list[JointSolution] = []
    for heat in _heats(joint):
        solutions, failures = [], []
        for start in starts:
            centre = prior_centre(start, guess_cTl, guess_offset_s)
            try:
                solution = solve_joint(few, start, heat, None, centre, tracks)
            except EstimationError as error:
                failures.append(error)
                continue
            if _is_within(solution, guess_cTl, config):
                solutions.append(solution)
        if not solutions:
            raise (
                failures[0] if failures else EstimationError("no candidate of the search leads to a solution")
            )
        solutions.sort(key=support, reverse=True)
        starts = _survivors(solutions, config)
    return Contest(_finalists(solutions, config.finalists), _doubt(solutions, config))


def _heats(joint: JointConfig) -> list[JointConfig]:
    """Settings of the two rounds: the wide kernels for all, the narrow ones for those that are left."""
    simple = replace(
        joint,
        graph=replace(joint.graph, object_bias_sigma_px=0.0),
        min_matches=1,
        inner_iterations=min(2, joint.inner_iterations),
    )
    half = (len(joint.kernel_px) + 1) // 2
    wide = replace(simple, kernel_px=joint.kernel_px[:half], max_outer=min(half, joint.max_outer))
    return [wide, replace(simple, kernel_px=joint.kernel_px[half:] or joint.kernel_px[-1:])]


def _survivors(solutions: Sequence[JointSolution], config: StartConfig) -> list[State]:
    """Where solutions ended that differ and that enough matches support, the best first."""
    least = config.survivor_ratio * support(solutions[0])
    kept: list[State] = []
    for solution in solutions:
        if support(solution) >= least and not any(_alike(solution.state, s, 3.0) for s in kept):
            kept.append(solution.state)
    return kept


def _with_offsets(candidates: Sequence[Candidate], guess_offset_s: float) -> list[Candidate]:
    """The candidates, and the first of them at other time offsets: slow frames hardly tell the offset."""
    if all(candidate.offset_s == guess_offset_s for candidate in candidates):
        return list(candidates)
    others = [replace(candidates[0], offset_s=guess_offset_s + step) for step in (0.0, 0.25, -0.25)]
    return [*candidates, *others]


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
    limit = search.free_translation_m if guess is None else 2.0 * search.translation_m
    centre = np.zeros(3) if guess is None else np.asarray(guess.translation())
    return float(np.linalg.norm(solution.state.cTl.translation() - centre)) < 1.25 * limit


def _doubt(solutions: Sequence[JointSolution], config: StartConfig) -> str | None:
    best, *others = solutions
    for other in others:
        turn = best.state.cTl.between(other.state.cTl).rotation()
        degrees = float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(turn))))
        if degrees > _SAME_DEG and support(other) > config.rival_ratio * support(best):
            return (
                f"a pose {degrees:.0f} deg away explains the labels almost as well ({support(other):.0f} "
                f"against {support(best):.0f} matches): record more varied scenes or give a closer guess"
            )
    return None
