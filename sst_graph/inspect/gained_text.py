"""Information gained by frame, of results of any method but the joint one, as text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sst_graph.errors import count_of
from sst_graph.inspect.gained import Gain, Gained
from sst_graph.inspect.inspection import HUMAN, UNITS
from sst_graph.result import CalibrationResult

MOST_FRAMES = 12
"""Frames in the table unless all are asked for."""

SHORT = ("rot x", "rot y", "rot z", "x", "y", "z", "offset")

_NOTHING = {
    **dict.fromkeys(
        ("paper", "static", "semalign"),
        "every matched pixel counts as independent, in the frame and beside its neighbours",
    ),
    "both": "labels and edges are estimated by themselves, and their estimates joined",
    "track": "this tracker followed a drift, or found no start: what a frame brings fades again",
}


def short(value: float) -> str:
    """Two significant digits, without an exponent between 0.0001 and a million."""
    if value == 0.0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2g}"
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(abs(value)))))}f}"


def gained_lines(result: CalibrationResult, gained: Gained | None, all_frames: bool) -> list[str]:
    """The block about frames of a result that keeps no view of them."""
    if gained is None or not gained.gains:
        unused = not result.frames_used and result.method not in _NOTHING
        why = (
            "no frame was used"
            if unused
            else _NOTHING.get(result.method, "it was not written beside this result")
        )
        return [
            f"what each frame brought is not known for this result of method {result.method}: {why}",
            "- what to record next is not predicted either" if unused else _JOINT_ONLY,
        ]
    if gained.kind == "as they came":
        return [*_arrivals(gained.gains, all_frames), *_NO_PLAN]
    return [*_pairs(gained.gains, all_frames), *_NO_PLAN]


_JOINT_ONLY = "- what to record next is predicted from results of calibrate --method joint only"
_NO_PLAN = ("- what to record next is not predicted: this result keeps no view of its frames (joint does)",)


def _arrivals(gains: Sequence[Gain], all_frames: bool) -> list[str]:
    shown = _shown(gains, all_frames)
    lines = [
        "what each scan brought as it came: bits gained, sigmas after it" + _left_out(gains, shown),
        f"{'scan':<12}{'bits':>8}" + "".join(f"{name:>9}" for name in SHORT),
        f"{'':<12}{'':>8}" + "".join(f"{unit:>9}" for unit in UNITS),
    ]
    for k in shown:
        bits = "start" if gains[k].bits is None else f"{gains[k].bits:.2f}"
        values = "".join(f"{short(value):>9}" for value in HUMAN * gains[k].values)
        lines.append(f"{gains[k].frame.frame:<12}{bits:>8}{values}")
    bits_of = np.array([gain.bits or 0.0 for gain in gains])
    total = float(bits_of.sum())
    if total > 0.0:
        order = np.argsort(-bits_of, kind="stable")
        needed = int(np.searchsorted(np.cumsum(bits_of[order]), 0.5 * total)) + 1
        lines.append(
            f"- {total:.1f} bits since scan {gains[0].frame.frame}, half of them from "
            f"{needed} of {count_of(len(gains), 'scan')}"
        )
    return [
        *lines,
        "- in their order: a later scan adds less; below zero, the matches turned out to "
        "err more, or the estimate moved to where less is known",
    ]


def _pairs(gains: Sequence[Gain], all_frames: bool) -> list[str]:
    shown = _shown(gains, all_frames)
    lines = [
        "what each pair of consecutive images adds to all others: bits; sigma without it over sigma with it"
        + _left_out(gains, shown),
        f"{'first image':<12}{'bits':>8}" + "".join(f"{name:>9}" for name in SHORT),
    ]
    for k in shown:
        values = "".join(f"{value:>9.3f}" for value in gains[k].values)
        lines.append(f"{gains[k].frame.frame:<12}{gains[k].bits or 0.0:>8.2f}{values}")
    return [
        *lines,
        "- pairs counted as independent, each with the noise that the residuals have: neighbours err "
        "together, and what all share (above all a principal point that is off) no single pair shows",
    ]


def _shown(gains: Sequence[Gain], all_frames: bool) -> list[int]:
    """Positions in the table: all, or those that bring most, the first and the last."""
    if all_frames or len(gains) <= MOST_FRAMES:
        return list(range(len(gains)))
    order = sorted(range(len(gains)), key=lambda k: -(gains[k].bits or 0.0))
    return sorted({0, len(gains) - 1, *order[: MOST_FRAMES - 2]})


def _left_out(gains: Sequence[Gain], shown: Sequence[int]) -> str:
    more = len(gains) - len(shown)
    return f" (those that bring most, the first and the last; {more} more with --all-frames)" if more else ""
