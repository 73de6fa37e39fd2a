"""Times that points bring along, compared with what the scans show of the sweep.

Common faults: a driver that leaves the field of the times at zero, counts them backwards or takes another
duration of a turn, and clouds that were compensated and still carry the times of their points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from sst_graph.odometry.cloud import usable_points
from sst_graph.odometry.sweep.decision import FRACTIONS, SweepDecision
from sst_graph.odometry.sweep.window import SECTORS, sectors_of
from sst_graph.types import Scan

_MAX_POINTS = 40_000
"""Most points of a scan that are read."""
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
    points, _, times_s = usable_points(scan, 0.0, np.inf, _MAX_POINTS)
    if times_s is None or not len(times_s) or not np.isfinite(times_s).all():
        return None
    if np.ptp(times_s) < _ONE_INSTANT_S:
        return 0.0
    sectors = sectors_of(np.arctan2(points[:, 1], points[:, 0]))
    filled = np.flatnonzero(np.bincount(sectors) >= _MIN_POINTS)
    if len(filled) < _MIN_SECTORS:
        return None
    medians = np.asarray(ndimage.median(times_s, sectors, filled))
    # A turn begins where the times jump most from one sector to the next.
    last = int(np.argmax(np.abs(np.diff(medians, append=medians[0]))))
    shares = np.mod(filled - filled[(last + 1) % len(filled)], SECTORS) / SECTORS
    slope, constant = np.polyfit(shares, medians, 1)
    deviation = np.sqrt(np.mean((slope * shares + constant - medians) ** 2))
    return float(slope) if deviation < _MAX_DEVIATION * abs(slope) else None


def compared_with_times(decision: SweepDecision, turn_s: float) -> SweepDecision:
    """The decision where the times of the points are given; its ``contradiction`` says where the scans show
    other ones.

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
    return decision.as_given(contradiction)


def _words(turn_s: float, period_s: float) -> str:
    """A sweep as in the hypotheses, with its duration where it is not that between two scans."""
    if turn_s == 0.0:
        return "compensated"
    share = abs(turn_s) / period_s
    lasts = "" if abs(share - 1.0) < _APART else f", {abs(turn_s):.2g} s a turn"
    return ("clockwise" if turn_s < 0.0 else "counterclockwise") + lasts
