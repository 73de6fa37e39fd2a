"""Contradictions between drives, and between stretches of time within a drive.

A result assumes one extrinsic for all drives and one time offset (or one a drive), from the first frame to
the last. Each drive, and each stretch of a drive, is solved by itself, and the estimates are compared
(:mod:`sst_graph.covariance.contradiction`). Matches frozen at the joint estimate would not show a large
step: those beyond the kernel are gone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sst_graph.batch.method_estimate import held_offsets
from sst_graph.batch.part_solver import Part, PartSolver, SolvedPart
from sst_graph.covariance.contradiction import Difference, PartEstimate, combined, name_step
from sst_graph.drive.stamp_intervals import Jump
from sst_graph.graph.state import State

FALSE_ALARM = 1e-3
"""Probability that any part of a calibration seems to contradict the rest where none does, as far as the
covariances hold: one false alarm in a thousand calibrations."""
_SUSPICION = 1e-2
"""Probability of a false alarm in one drive by its stretches alone, before both sides are solved to confirm
it: a larger value costs only time."""
_MOST_STRETCHES = 8
"""Stretches that a drive is cut into: each costs a solution of its scans."""
_LEAST_SCANS = 4
"""Fewest scans of a stretch: fewer seldom determine an estimate."""


@dataclass(frozen=True)
class Contradictions:
    """What contradicts what.

    Attributes:
        sentences: one for each contradiction.
        stretches: the stretches, each solved by itself.
        step_chi2: of the longest step within a drive; 0 without one.
        drives_chi2: of the drive that contradicts the others most; 0 without one.
        diagnostics: JSON-able numbers.
    """

    sentences: tuple[str, ...] = ()
    stretches: tuple[SolvedPart, ...] = ()
    step_chi2: float = 0.0
    drives_chi2: float = 0.0
    diagnostics: dict[str, Any] = field(default_factory=dict)


def find_contradictions(parts: PartSolver) -> Contradictions:
    """Drives against the other drives, and within each drive the run of stretches that differs most."""
    if not parts.problem.config.check_contradictions:
        return Contradictions()
    # 1. Every stretch of every drive by itself.
    stretches = [
        [own for scans in _cut(len(drive.scans)) if (own := parts.solve(Part(number, scans))) is not None]
        for number, drive in enumerate(parts.drives)
    ]
    # 2. Within each drive.
    tests = len(parts.drives) + (len(parts.drives) > 1)
    false_alarm = FALSE_ALARM / tests
    steps = [step for of_drive in stretches if (step := _within(parts, of_drive, false_alarm)) is not None]
    sentences = [_step_sentence(parts, step) for step in steps]
    # 3. Each drive against the others; the extrinsics alone where each has a time offset of its own.
    solved = _whole_drives(parts, stretches)
    if len(parts.reference.time_offsets_s) > 1:
        solved = {number: part.extrinsic() for number, part in solved.items()}
    against, apart = compare_drives(solved, false_alarm)
    sentences += [_drive_sentence(parts, number, difference) for number, difference in apart.items()]
    diagnostics = {
        "within": [_step_document(parts, step) for step in steps],
        "between": {parts.drives[n].name: _difference_document(d) for n, d in against.items()},
    }
    return Contradictions(
        tuple(sentences),
        tuple(s for own in stretches for s in own),
        max((step.difference.chi2 for step in steps), default=0.0),
        max((difference.chi2 for difference in apart.values()), default=0.0),
        diagnostics,
    )


def _cut(scans: int) -> list[tuple[int, ...]]:
    """Positions of the scans of each stretch, evenly many."""
    count = max(1, min(_MOST_STRETCHES, scans // _LEAST_SCANS))
    return [tuple(stretch.tolist()) for stretch in np.array_split(np.arange(scans), count)]


@dataclass(frozen=True)
class Step:
    """A run of scans of a drive that contradicts the others.

    Attributes:
        drive: number of the drive.
        scans: first scan of the run and the one after its last, by position.
        difference: from the others to the run.
    """

    drive: int
    scans: tuple[int, int]
    difference: Difference


def _within(parts: PartSolver, stretches: Sequence[SolvedPart], false_alarm: float) -> Step | None:
    """The run of scans of one drive that contradicts the others most, where one does."""
    if len(stretches) < 2:
        return None
    # 1. The runs of stretches that differ most from the rest, as if all stretches were independent: the least
    # probable one, and the longest step. Mixed sides of a run beside the right one have more clusters behind
    # them, and a stretch in a false optimum of its own makes a long step.
    runs = _runs(len(stretches))
    differences = {run: _of_run(stretches, run) for run in runs}
    significant = [run for run in runs if differences[run].p_value * len(runs) < _SUSPICION]
    if not significant:
        return None
    least_probable = min(significant, key=lambda run: differences[run].rank)
    longest_step = max(significant, key=lambda run: differences[run].chi2)
    # 2. Each with both sides solved. Of those that are confirmed so, the one that the labels support most.
    refined = [_refined(parts, stretches, run) for run in dict.fromkeys((least_probable, longest_step))]
    confirmed = [
        (step, support)
        for step, support in filter(None, refined)
        if step.difference.p_value * len(runs) < false_alarm
    ]
    return max(confirmed, key=lambda one: one[1])[0] if confirmed else None


def _refined(
    parts: PartSolver, stretches: Sequence[SolvedPart], run: tuple[int, int]
) -> tuple[Step, float] | None:
    """A run with its ends located and both sides solved by themselves, and their support; None where a side
    has no estimate."""
    inside, outside = ([s.state for s in side] for side in _sides(stretches, run))
    number, last = stretches[0].part.drive, len(parts.drives[stretches[0].part.drive].scans)
    first, end = stretches[run[0]].part.scans[0], stretches[run[1] - 1].part.scans[-1] + 1
    bounds = (0 if run[0] == 0 else first, last if run[1] == len(stretches) else end)
    states = [
        parts.best_start(part, starts)
        for part, starts in zip(_parts_of(number, bounds, last), (inside, outside), strict=True)
    ]
    for _ in range(_REFINEMENTS):
        bounds, states = _located(parts, number, states)
        own, rest = (
            parts.solve_from(part, state)
            for part, state in zip(_parts_of(number, bounds, last), states, strict=True)
        )
        if own is None or rest is None:
            return None
        states, difference = [own.state, rest.state], Difference.of(rest.step, own.step)
        if _located(parts, number, states)[0] == bounds:
            break
    sides = zip(_parts_of(number, bounds, last), states, strict=True)
    return Step(number, bounds, difference), sum(parts.total_support(*side) for side in sides)


_REFINEMENTS = 2
"""Most times that a step's place is found and both sides of it are solved."""


def _runs(stretches: int) -> list[tuple[int, int]]:
    """(first, one after the last) of all runs of stretches that leave others, each split of a drive once."""
    return [
        (i, j)
        for i in range(stretches)
        for j in range(i + 1, stretches + 1)
        if not (i == 0 and j < stretches) and (i, j) != (0, stretches)
    ]


def _sides(
    stretches: Sequence[SolvedPart], run: tuple[int, int]
) -> tuple[list[SolvedPart], list[SolvedPart]]:
    return [*stretches[run[0] : run[1]]], [*stretches[: run[0]], *stretches[run[1] :]]


def _of_run(stretches: Sequence[SolvedPart], run: tuple[int, int]) -> Difference:
    inside, outside = _sides(stretches, run)
    return Difference.of(combined([s.step for s in outside]), combined([s.step for s in inside]))


def _parts_of(drive: int, bounds: tuple[int, int], scans: int) -> tuple[Part, Part]:
    """The run and all other scans."""
    inside = range(*bounds)
    return Part(drive, tuple(inside)), Part(drive, tuple(k for k in range(scans) if k not in inside))


def _located(parts: PartSolver, drive: int, states: Sequence[State]) -> tuple[tuple[int, int], list[State]]:
    """Where a run begins and ends by which of two states each scan agrees with; the run's state first.

    A run that ends with the drive (a split in two) is preferred to one that the same state is resumed after.
    """
    scans = len(parts.drives[drive].scans)
    everything = Part(drive, tuple(range(scans)))
    own, rest = (parts.support(everything, state) for state in states)
    gain = np.concatenate([[0.0], np.cumsum(own - rest)])
    # 1. The best split: the later scans are the run.
    places = np.arange(_LEAST_SIDE, scans - _LEAST_SIDE + 1)
    later = gain[-1] - 2.0 * gain[places]
    split = int(places[np.abs(later).argmax()])
    swapped = bool(gain[-1] - 2.0 * gain[split] < 0.0)
    # 2. The best run in the middle.
    ends = [(a, b) for a in places for b in places if b - a >= _LEAST_SIDE]
    values = [2.0 * (gain[b] - gain[a]) - gain[-1] for a, b in ends]
    if values and max(values) > (1.0 + _SECOND_STEP) * float(np.abs(later).max()):
        first, end = ends[int(np.argmax(values))]
        return (int(first), int(end)), [*states]
    return (split, scans), [*states[::-1]] if swapped else [*states]


_LEAST_SIDE = 2
"""Fewest scans on either side of a step."""
_SECOND_STEP = 0.1
"""A second step back must raise what agrees with the two estimates by this share."""


def _whole_drives(parts: PartSolver, stretches: Sequence[Sequence[SolvedPart]]) -> dict[int, PartEstimate]:
    """Of several drives, each one's own estimate by its number; drives without one are left out."""
    if len(parts.drives) < 2:
        return {}
    solved = {}
    for number, (drive, own) in enumerate(zip(parts.drives, stretches, strict=True)):
        whole = Part(number, tuple(range(len(drive.scans))))
        part = parts.solve_from(whole, parts.best_start(whole, [s.state for s in own]))
        if part is not None:
            solved[number] = part.step
    return solved


def _between(solved: Mapping[int, PartEstimate]) -> dict[int, Difference]:
    """Each drive against the others together, by the drive's number."""
    # Of two, the second stands for both.
    compared = [*solved][1:] if len(solved) <= 2 else [*solved]
    others = {number: [solved[k] for k in solved if k != number] for number in compared}
    return {number: Difference.from_others(others[number], solved[number]) for number in compared}


def compare_drives(
    solved: Mapping[int, PartEstimate], false_alarm: float
) -> tuple[dict[int, Difference], dict[int, Difference]]:
    """Each drive against the others, and of those that contradict these, the worst one first, the same
    without the worse ones: one that is wrong draws what the others say away from each that is right."""
    every = against = _between(solved)
    left, apart = dict(solved), dict[int, Difference]()
    while against:
        worst = max(against, key=lambda number: against[number].chi2)
        if against[worst].p_value * len(against) >= false_alarm:
            break
        apart[worst] = against[worst]
        del left[worst]
        against = _between(left)
    return every, apart


def _step_sentence(parts: PartSolver, step: Step) -> str:
    drive = parts.drives[step.drive]
    first, end = step.scans
    named = name_step(step.difference, parts.reference.cTl)
    at = drive.scans[first].index
    if end == len(drive.scans):
        where = f"frames {drive.scans[0].index} to {drive.scans[first - 1].index} and those from {at} on"
        what = "the later ones differ"
    else:
        where = f"frames {at} to {drive.scans[end - 1].index} and the others"
        what = "they differ"
    found = f"{where} contradict each other: {what} in {named.sentence}"
    return f"{drive.name}: {found}; {advice(named.possible_kinds)}"


def advice(kinds: Sequence[str], by_labels: bool = True) -> str:
    """What to check where parts of a drive differ in some of rotation, translation and time offset."""
    turned = ("the mount was moved", "the masks slide")
    causes = {
        "rotation": turned if by_labels else turned[:1],
        "translation": ("the mount was moved",),
        "offset": ("an image or a scan was lost", "a clock was set"),
    }
    likely = " or ".join(dict.fromkeys(cause for kind in kinds for cause in causes[kind]))
    return f"check whether {likely}, and calibrate the frames before and after apart"


def _drive_sentence(parts: PartSolver, number: int, difference: Difference) -> str:
    named = name_step(difference, parts.reference.cTl)
    others = f"drive {parts.drives[0].name!r}" if len(parts.drives) == 2 else "the others"
    return (
        f"drive {parts.drives[number].name!r} contradicts {others}: it differs in {named.sentence}; "
        "calibrate the drives apart, or check whether the mount was moved or a clock was set between them"
    )


def _step_document(parts: PartSolver, step: Step) -> dict[str, Any]:
    drive = parts.drives[step.drive]
    frames = [drive.scans[step.scans[0]].index, drive.scans[step.scans[1] - 1].index]
    return {"drive": drive.name, "frames": frames, **_difference_document(step.difference)}


def _difference_document(difference: Difference) -> dict[str, Any]:
    return {
        "step": difference.step.tolist(),
        "chi2": difference.chi2,
        "degrees_of_freedom": difference.freedom,
        "p_value": difference.p_value,
    }


def offsets_held_by_labels(parts: PartSolver) -> dict[str, str]:
    """:func:`held_offsets` with the frames before and after each jump solved by themselves."""

    def solved(number: int, jumps: Sequence[Jump]) -> list[PartEstimate | None]:
        ends = [jump.place[1] for jump in jumps]
        bounds = zip([0, *ends], [*ends, len(parts.drives[number].scans)], strict=True)
        found = [_solved_beside_jumps(parts, Part(number, tuple(range(a, b))), jumps) for a, b in bounds]
        return [None if part is None else part.step for part in found]

    return held_offsets(parts.drives, parts.problem.config, solved, "the labels")


def _solved_beside_jumps(parts: PartSolver, part: Part, jumps: Sequence[Jump]) -> SolvedPart | None:
    """A part by itself, from the estimate of all, or from one whose time offset differs by a jump."""
    reference = parts.reference_of(part)
    starts = [reference.later(sign * jump.time_offset_s) for jump in jumps for sign in (-1.0, 1.0)]
    return parts.solve_from(part, parts.best_start(part, starts)) if part.scans else None
