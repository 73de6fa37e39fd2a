"""Times that points bring along, compared with what the scans show of the sweep.

Common faults: a driver that leaves the field of the times at zero, counts them backwards or takes another
duration of a turn, and clouds that were compensated and still carry the times of their points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sst_graph.odometry.sweep.decision import FRACTIONS, SweepDecision
from sst_graph.odometry.sweep.window import SECTORS
from sst_graph.sweep_timing import AT_ONCE
from sst_graph.types import Scan

_ONE_INSTANT_S = 1e-3
"""Points whose times differ by less share one instant [s]."""
_MIN_POINTS = 5
"""Points of a sector whose median time counts."""
_MIN_SECTORS = SECTORS // 8
_MAX_DEVIATION = 0.1
"""Times that lie farther than this share of a turn from a line over the azimuth (RMS) are none of a spinning
scanner."""
_APART = 0.25
"""Times are wrong where the share of the sweep by them lies so far from what the scans show, beside three
sigmas: a little more than what a decision tolerates from its own hypothesis."""


def turn_of(scans: Sequence[Scan]) -> float | None:
    """Duration of a turn by the times of points, negative where it is clockwise [s].

    Returns:
        The median of the scans; 0 where all points share one instant, None where times do not follow the
        azimuth in some scan (no spinning scanner) or scans have none.
    """
    turns = [_turn(scan) for scan in scans]
    known = [turn for turn in turns if turn is not None]
    return float(np.median(known)) if known and len(known) == len(turns) else None


def _turn(scan: Scan) -> float | None:
    if scan.offsets_s is None:
        return None
    points, times_s = scan.points.astype(np.float64), scan.offsets_s.astype(np.float64)
    kept = np.isfinite(times_s) & np.isfinite(points).all(axis=1) & (np.abs(points[:, :2]).max(axis=1) > 0.0)
    if not kept.any():
        return None
    azimuths_rad, times_s = np.arctan2(points[kept, 1], points[kept, 0]), times_s[kept]
    if np.ptp(times_s) < _ONE_INSTANT_S:
        return 0.0
    sectors = np.clip(((azimuths_rad / (2.0 * np.pi) + 0.5) * SECTORS).astype(int), 0, SECTORS - 1)
    filled = [k for k in range(SECTORS) if np.count_nonzero(sectors == k) >= _MIN_POINTS]
    if len(filled) < _MIN_SECTORS:
        return None
    medians = np.array([np.median(times_s[sectors == k]) for k in filled])
    # A turn begins where the times jump most from one sector to the next.
    first = (int(np.argmax(np.abs(np.diff(medians, append=medians[0])))) + 1) % len(filled)
    medians, shares = np.roll(medians, -first), np.roll(np.array(filled) / SECTORS, -first)
    shares = shares + np.append(0, np.cumsum(np.diff(shares) < 0.0))
    slope, constant = np.polyfit(shares, medians, 1)
    deviation = np.sqrt(np.mean((slope * shares + constant - medians) ** 2))
    return float(slope) if deviation < _MAX_DEVIATION * abs(slope) else None


def compared_with_times(decision: SweepDecision, turn_s: float) -> SweepDecision:
    """That the times of the points are given; ``contradiction`` says where the scans show other ones.

    Args:
        decision: from the same scans without the times.
        turn_s: of :func:`turn_of`.
    """
    period_s = decision.timing.period_s
    informed = decision.kind in FRACTIONS or bool(decision.contradiction)
    contradiction = ""
    if informed and abs(decision.fraction - turn_s / period_s) > _APART + 3.0 * decision.sigma:
        known = decision.kind in FRACTIONS
        contradiction = (
            f"the times of the points say {_words(turn_s, period_s)}, the scans "
            f"{decision.kind if known else 'another sweep'} ({decision.evidence}): correct the times"
            + f", or say --sweep {decision.kind}, which leaves them out" * known
        )
    return replace(decision, kind="given", timing=AT_ONCE, others=(), contradiction=contradiction)


def _words(turn_s: float, period_s: float) -> str:
    """A sweep as in the hypotheses, with its duration where it is not that between two scans."""
    if turn_s == 0.0:
        return "compensated"
    share = abs(turn_s) / period_s
    lasts = "" if abs(share - 1.0) < _APART else f", {abs(turn_s):.2g} s a turn"
    return ("clockwise" if turn_s < 0.0 else "counterclockwise") + lasts
