"""Whether the points of a drive were compensated to one instant, or in which sense its scanner turned."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from sst_graph.data.source import AT_THE_STAMP, TURNS
from sst_graph.odometry.lidar import LidarOdometry
from sst_graph.odometry.sweep.estimate import SweepEstimate, at_hypothesis, estimate, start_of
from sst_graph.odometry.sweep.window import SECTORS, SweepWindow
from sst_graph.sampling import evenly_spread
from sst_graph.sweep_timing import AT_ONCE, LONGEST_TURN_S, SweepStamp, SweepTiming
from sst_graph.types import FloatArray, Scan

_LOG = logging.getLogger(__name__)

SweepKind = Literal["compensated", "clockwise", "counterclockwise", "undecided", "standstill", "given"]
"""What the scans show of the sweep; undecided, or of no matter at standstill; or the times are given."""
FRACTIONS: dict[str, float] = {"compensated": 0.0, "clockwise": -1.0, "counterclockwise": 1.0}

CLAIMS: dict[str, str] = {
    word: kind
    for word in (*AT_THE_STAMP, *TURNS)
    for kind, fraction in FRACTIONS.items()
    if fraction == TURNS.get(word, 0.0)
}
"""What may be said of the sweep (``--sweep``), as one of the hypotheses."""

REMEDY = "say --sweep compensated, clockwise or counterclockwise, or give points' times"


_SAMPLED_PAIRS = 6
"""Pairs of consecutive scans, spread over the drive, that give the speed."""
MAX_WINDOWS = 6
"""Most windows that are registered, the fastest first, as long as they may decide."""
_WINDOW_SCANS = 12
"""Scans of a window."""
_STEP_M, _STEP_RAD = 0.8, 0.15
"""Motion from one scan of a window to the next that is aimed at, at low speed by leaving scans out [m,
rad]."""
_MAX_SKIPPED = 7
"""Most scans left out between two of a window."""
_STANDSTILL_MPS, _STANDSTILL_RADPS = 0.1, 0.02
"""A vehicle that is nowhere faster is at standstill [m/s, rad/s]."""
_MIN_TRAVEL_M, _MIN_TRAVEL_RAD = 3.0, 0.25
"""Least motion from the first scan of a window to its last: with less, surfaces are seen from one side only,
with the same errors in every scan [m, rad]."""
_ERROR_RATE = 0.001
"""A hypothesis is excluded where another is 1 / _ERROR_RATE times as likely: such evidence against the true
one occurs in this fraction of drives at most, where the error model holds."""
_TOLERANCE = 0.2
"""The estimated share may differ so much from 0 or 1 beside three of its sigmas."""
_PART, _PART_SIGMAS = 0.12, 6.0
"""Farther than this from 0, -1 and 1, beside so many of its sigmas, the share is that of points which were
moved by a part of the motion, or by the wrong one. Of 15 whole sweeps on simulated streets it came out up to
0.25 and up to 5.6 sigmas from the nearest of these, but not both beyond."""
_LONG_SWEEP_M, _REACH_M = 1.0, 10.0
"""Where surfaces at this distance [m] move farther than this in a turn of the scanner [m], a wrong hypothesis
keeps the matches made under it, and all hypotheses are tried as starts."""
_MIN_EXPECTED = 0.5
"""Share of the evidence needed below which no more windows are registered."""


@dataclass(frozen=True)
class SweepDecision:
    """The decision about the sweep, and its evidence.

    Attributes:
        kind: the hypothesis, or why there is none.
        timing: times of the points as they are used.
        fraction, sigma: estimated share of the sweep in the points, -1 (clockwise) to 1, and its standard
            deviation, at the start of the turn that fits best; sigma infinite where no window was registered.
        worse_by: by how many standard deviations each hypothesis fits worse than the best.
        start_known: whether the scans determine where a turn begins; else the start lies where no points are.
        speed_mps: fastest mean speed of the windows.
        frames: positions of the scans used, in the order of the drive.
        others: times of the points under the hypotheses that are not excluded, beside ``timing``.
        contradiction: how the scans contradict what was said of the sweep, or every hypothesis; empty where
            they do not.
    """

    kind: SweepKind
    timing: SweepTiming
    fraction: float = 0.0
    sigma: float = np.inf
    worse_by: Mapping[str, float] = field(default_factory=dict)
    start_known: bool = False
    speed_mps: float = 0.0
    frames: tuple[int, ...] = ()
    others: tuple[SweepTiming, ...] = ()
    contradiction: str = ""

    @property
    def shares(self) -> dict[float, float]:
        """Probability of each hypothesis, by its fraction, with sigmas twice as large as claimed: where the
        decision is open, the error model is not certain either.
        """
        weights = {
            fraction: float(np.exp(-0.5 * (0.5 * self.worse_by.get(name, 0.0)) ** 2))
            for name, fraction in FRACTIONS.items()
        }
        total = sum(weights.values())
        return {fraction: weight / total for fraction, weight in weights.items()}

    @property
    def sentence(self) -> str:
        """The decision in words."""
        if self.kind == "given":
            return "as given" + f", but {self.contradiction}" * bool(self.contradiction)
        if self.kind == "standstill":
            return "assumed compensated: at standstill it does not matter"
        if self.kind == "undecided":
            if self.contradiction:
                return f"assumed compensated, but {self.contradiction}"
            return (
                f"not determined by the scans ({self.evidence}); assumed compensated, its effect is in the "
                f"sigmas; if you know it, {REMEDY}"
            )
        if self.kind == "compensated":
            return f"compensated ({self.evidence}, 0 expected)"
        where = f"a turn begins at {np.degrees(self.timing.start_rad):.0f} deg" if self.start_known else ""
        expected = FRACTIONS[self.kind]
        return (
            f"as measured, {self.kind} ({self.evidence}, {expected:+.0f} expected){'; ' * bool(where)}{where}"
        )

    @property
    def evidence(self) -> str:
        """The estimated share in words."""
        if not np.isfinite(self.sigma):
            return "no stretch with enough motion"
        share = f"share of the sweep in the points {self.fraction:+.2f} +- {self.sigma:.2f}"
        if self.kind == "undecided":
            return f"{share}; compensated 0, clockwise -1, counter-clockwise +1"
        return share

    def given_as(self, word: str) -> SweepDecision:
        """What was said of the sweep, one of :data:`CLAIMS`, which holds; where this decision, of the same
        scans, is another one, ``contradiction`` says so.
        """
        claim, contradiction = CLAIMS[word], self.contradiction
        if self.kind in FRACTIONS and self.kind != claim:
            contradiction = (
                f"the scans are not as --sweep {word} says, but {self.sentence}: leave --sweep out, or say "
                f"--sweep {self.kind}"
            )
        return self.as_given(contradiction)

    def as_given(self, contradiction: str) -> SweepDecision:
        """The decision where the data give times, which hold; how the scans contradict them, or nothing."""
        return replace(self, kind="given", timing=AT_ONCE, others=(), contradiction=contradiction)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, for the diagnostics of a result."""
        return {
            "kind": self.kind,
            "sentence": self.sentence,
            "fraction": self.fraction,
            "sigma": self.sigma,
            "worse_by_sigmas": dict(self.worse_by),
            "timing": self.timing.to_dict(),
            "start_known": self.start_known,
            "speed_mps": self.speed_mps,
            "scans": list(self.frames),
        }


@dataclass(frozen=True)
class _PairMotion:
    """Motion of the LiDAR between two consecutive scans, and the position of the first."""

    position: int
    seconds: float
    speed_mps: float
    turn_radps: float

    @property
    def speed_ratio(self) -> float:
        """Speed, or rate of turn, as a multiple of what counts as standstill."""
        return max(self.speed_mps / _STANDSTILL_MPS, self.turn_radps / _STANDSTILL_RADPS)

    def priority(self, period_s: float) -> float:
        """Sorts the fastest first, and last, slowest first, those too fast for matches of a wrong
        hypothesis."""
        return self.speed_ratio if self.speed_mps * period_s > _LONG_SWEEP_M else -self.speed_ratio


def decide_sweep(
    scan_at: Callable[[int], Scan | None],
    count: int,
    stamp: SweepStamp = "forward",
    max_windows: int = MAX_WINDOWS,
    progress: Callable[[int, int], None] | None = None,
) -> SweepDecision:
    """Decide the sweep from the scans of a drive that have no times of their points.

    Args:
        scan_at: scan at a position, or None where the frame has none.
        count: number of positions.
        stamp: the instant that a scan's stamp names, in case the points are as measured.
        max_windows: most that are registered, as long as they may decide.
        progress: called with (steps done, steps in all); it may be decided before all are done.
    """
    steps = _SAMPLED_PAIRS + max_windows

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, steps)

    tell(0)
    pairs = _pair_motions(scan_at, count, tell)
    if not pairs:
        return SweepDecision("undecided", SweepTiming(0.0, -np.pi, 0.1, stamp))
    period_s = float(np.median([pair.seconds for pair in pairs]))
    # Stamps in another unit are reported elsewhere.
    if not 0.0 < period_s < LONGEST_TURN_S:
        return SweepDecision("undecided", SweepTiming(0.0, -np.pi, 0.1, stamp))
    timing = SweepTiming(0.0, -np.pi, period_s, stamp)
    if max(pair.speed_ratio for pair in pairs) < 1.0:
        return SweepDecision("standstill", timing, speed_mps=max(pair.speed_mps for pair in pairs))
    both = _both_senses(timing)
    decision = SweepDecision("undecided", timing, others=both)
    windows: list[SweepWindow] = []
    used: list[int] = []
    for pair in sorted(pairs, key=lambda pair: pair.priority(period_s)):
        if pair.speed_ratio < 1.0 or any(abs(pair.position - k) < _WINDOW_SCANS // 2 for k in used):
            continue
        positions, window = _window_around(pair, scan_at, count, period_s)
        if window is None or not _travels(window):
            continue
        windows.append(window)
        used += positions
        now = partial(tell, _SAMPLED_PAIRS + len(windows) - 1)
        decision = replace(_decide(windows, timing, now), frames=tuple(sorted(set(used))))
        _LOG.info("sweep: %s", decision.sentence)
        if decision.kind != "undecided" or len(windows) == max_windows:
            break
        # Evidence of as many windows as may be registered, were they all like these.
        expected = 0.5 / decision.sigma**2 * max_windows / len(windows)
        if expected < _MIN_EXPECTED * -np.log(_ERROR_RATE):
            break
    return decision


def _both_senses(timing: SweepTiming) -> tuple[SweepTiming, ...]:
    """The timing as measured in either sense."""
    return tuple(replace(timing, fraction=fraction) for fraction in FRACTIONS.values() if fraction)


def _pair_motions(
    scan_at: Callable[[int], Scan | None], count: int, tell: Callable[[int], None]
) -> list[_PairMotion]:
    """Motions at pairs of scans spread over the drive; ``tell`` is given the number of those looked at."""
    found = []
    for done, k in enumerate(evenly_spread(range(max(count - 1, 1)), _SAMPLED_PAIRS)):
        tell(done)
        a, b = scan_at(k), scan_at(k + 1) if k + 1 < count else None
        if a is None or b is None or b.stamp_ns <= a.stamp_ns:
            continue
        odometry = LidarOdometry()
        odometry.add(a)
        motion = odometry.add(b)
        if motion is not None and motion.ok:
            turn, speed = (float(np.linalg.norm(part)) for part in np.split(motion.mean_twist, 2))
            found.append(_PairMotion(k, motion.seconds, speed, turn))
    return found


def _window_around(
    pair: _PairMotion, scan_at: Callable[[int], Scan | None], count: int, period_s: float
) -> tuple[list[int], SweepWindow | None]:
    """The window around a pair and the positions of its scans; None where three scans cannot be had.

    Scans that are too far apart to be registered to one another are taken from closer together; in a drive
    that is too short for all scans of a window, fewer of them are taken from farther apart.
    """
    wanted = _spacing(pair)
    every = min(wanted, max(1, (count - 1) // (_WINDOW_SCANS - 1)))
    while True:
        positions = _window_positions(pair, count, every)
        scans = {k: scan for k in positions if (scan := scan_at(k)) is not None}
        if len(scans) < 3:
            return [], None
        window = SweepWindow([*scans.values()], period_s)
        if window.ok and not _travels(window) and every < wanted:
            every = wanted
        elif not window.ok and every > 1:
            every, wanted = every // 2, every // 2
        else:
            return [*scans], window


def _travels(window: SweepWindow) -> bool:
    """Whether the vehicle moves enough from the first scan to the last."""
    return window.travel[0] >= _MIN_TRAVEL_M or window.travel[1] >= _MIN_TRAVEL_RAD


def _spacing(pair: _PairMotion) -> int:
    """One scan in how many belongs to a window, so that the vehicle moves from one to the next."""
    step = min(
        _STEP_M / max(pair.speed_mps * pair.seconds, 1e-3),
        _STEP_RAD / max(pair.turn_radps * pair.seconds, 1e-3),
    )
    return int(np.clip(round(step), 1, _MAX_SKIPPED + 1))


def _window_positions(pair: _PairMotion, count: int, every: int) -> list[int]:
    """Positions of the scans around a pair."""
    length = (_WINDOW_SCANS - 1) * every
    first = int(np.clip(pair.position - length // 2, 0, max(0, count - 1 - length)))
    return list(range(first, min(count, first + length + 1), every))


def _decide(windows: list[SweepWindow], timing: SweepTiming, tell: Callable[[], None]) -> SweepDecision:
    """The decision from some windows, which take the poses of the best fit; ``tell`` is called before each
    fit."""
    tell()
    speed = max(float(np.linalg.norm(window.twists[:, 3:], axis=1).mean()) for window in windows)
    start = 0.0, 0
    turn = max(float(np.linalg.norm(window.twists[:, :3], axis=1).mean()) for window in windows)
    if (speed + turn * _REACH_M) * timing.period_s > _LONG_SWEEP_M:
        start = _best_start(windows[0].thinned(_FEW_SCANS, _FEW_POINTS))
    before, fits = list(windows), [_Fit.of(windows, start)]
    windows[:] = fits[0].windows
    if not any(window.has_matches for window in windows):
        others = _both_senses(timing)
        return SweepDecision("undecided", timing, speed_mps=speed, others=others)
    decision = _compare_hypotheses(*fits[0], timing)
    if decision.kind != "undecided" or decision.contradiction:
        # Sparse scans meet equally well under several shares, each with matches that confirm it.
        for fraction in _TRIED:
            if (fraction, 0) != start:
                tell()
                fits.append(_Fit.of(before, (fraction, 0)))
        best, *rest = sorted(fits, key=lambda fit: fit.estimate.misfit)
        alike = [best, *(fit for fit in rest if fit.estimate.worse_by(best.estimate) < _SURELY_WORSE)]
        decision = _in_common([_compare_hypotheses(*fit, timing) for fit in alike], timing)
        windows[:] = best.windows
    return replace(decision, speed_mps=speed)


class _Fit(NamedTuple):
    """Windows with the poses of an estimate that begins somewhere."""

    windows: Sequence[SweepWindow]
    estimate: SweepEstimate

    @classmethod
    def of(cls, windows: Sequence[SweepWindow], start: tuple[float, int]) -> _Fit:
        """From a share of the sweep, and a sector at whose border a turn begins."""
        copies = [window.copy() for window in windows]
        return cls(copies, estimate(copies, *start))


def _in_common(decisions: Sequence[SweepDecision], timing: SweepTiming) -> SweepDecision:
    """The first of some decisions about the same scans, in as far as all others are the same."""
    first = decisions[0]
    if len({(decision.kind, bool(decision.contradiction)) for decision in decisions}) == 1:
        away = [decision.timing.start_rad - first.timing.start_rad for decision in decisions]
        apart = np.abs(np.mod(np.array(away) + np.pi, 2.0 * np.pi) - np.pi).max()
        known = all(decision.start_known for decision in decisions) and apart < _SAME_START_RAD
        return replace(first, start_known=bool(known))
    least = {name: min(one.worse_by[name] for one in decisions) for name in first.worse_by}
    spread = float(np.ptp([decision.fraction for decision in decisions]))
    undecided = replace(first, kind="undecided", timing=timing, start_known=False, contradiction="")
    sigma = max(spread, *(decision.sigma for decision in decisions))
    return replace(undecided, sigma=sigma, worse_by=least, others=_both_senses(timing))


def _compare_hypotheses(
    windows: Sequence[SweepWindow], found: SweepEstimate, timing: SweepTiming
) -> SweepDecision:
    """The three hypotheses by their evidence, that of compensated points being 1."""
    evidence = found.evidence(windows)
    ratios: dict[str, FloatArray] = {name: evidence.log_ratio(f) for name, f in FRACTIONS.items()}
    means = {name: _log_mean(ratio) for name, ratio in ratios.items()}
    best = max(means, key=lambda name: means[name])
    behind = {name: means[best] - means[name] for name in means}
    needed = -np.log(_ERROR_RATE)
    excluded = {name for name in behind if behind[name] > needed}
    # The start of the turn by the cost of the registration, which is not bounded: under the bounded evidence
    # the few points between a wrong start and the right one would hardly count.
    starts = {name: _start(found.quadratic.cost(f), evidence.unit) for name, f in FRACTIONS.items()}
    # Compensated points are compared with the turn that fits best.
    raw = best if best != "compensated" else min(_RAW, key=lambda name: behind[name])
    sector, start_known = starts[raw]
    share, sigma = float(found.quadratic.free()[sector]), float(evidence.sigma[sector])
    agrees = abs(share - FRACTIONS[best]) < _TOLERANCE + 3.0 * sigma
    # Informed for every possible start of the turn, also where there are no points: where only the step
    # between its end and its start shows, any other difference between the two sides of the scene looks so.
    informed = 0.5 / float(evidence.sigma.max()) ** 2 > needed
    decided = len(excluded) == 2 and agrees and informed
    timings = {
        name: replace(timing, fraction=FRACTIONS[name], start_rad=start_of(starts[name][0])) for name in means
    }
    others = [timings[name] for name in means if name not in excluded or not (agrees and informed)]
    return SweepDecision(
        cast(SweepKind, best if decided else "undecided"),
        timings[best] if decided and best != "compensated" else timing,
        share,
        sigma,
        {name: float(np.sqrt(2.0 * value)) for name, value in behind.items()},
        start_known and best != "compensated",
        others=() if decided else tuple(other for other in others if not other.instant),
        # The start under which a part of a turn fits best need not be that of a whole one.
        contradiction=_in_part(found.fraction, float(evidence.sigma[found.sector])) if informed else "",
    )


def _in_part(share: float, sigma: float) -> str:
    """A sentence that says that the points hold a part of the sweep only; empty where they may hold all or
    nothing of it."""
    if min(abs(share - f) for f in FRACTIONS.values()) <= _PART + _PART_SIGMAS * sigma:
        return ""
    return (
        "the points are neither as measured nor all moved to one instant (share of the sweep in them "
        f"{share:+.2f} +- {sigma:.2g}; 0, -1 or +1 expected): compensate them once, by the whole motion, or "
        "give their times"
    )


_RAW = ("clockwise", "counterclockwise")


def _log_mean(values: FloatArray) -> float:
    """log(mean(exp(values)))."""
    most = float(values.max())
    return most + float(np.log(np.mean(np.exp(values - most))))


def _start(costs: FloatArray, units: FloatArray) -> tuple[int, bool]:
    """Sector at whose border a turn begins, and whether the costs (SECTORS,) [m^2] determine it.

    Of starts that fit equally well (no points between them) the one in the middle of the widest run.

    units: (SECTORS,) variance of a residual [m^2].
    """
    best = int(np.argmin(costs))
    alike = 2.0 * (costs - costs[best]) < 4.0 * units[best]
    if alike.all():
        return 0, False
    first = int(np.flatnonzero(alike & ~np.roll(alike, 1))[0])
    runs: list[list[int]] = []
    for k in range(first, first + SECTORS):
        if alike[k % SECTORS]:
            if not alike[(k - 1) % SECTORS] or not runs:
                runs.append([])
            runs[-1].append(k)
    widest = max(runs, key=len)
    return widest[len(widest) // 2] % SECTORS, bool(alike.sum() <= SECTORS // 6)


def _best_start(window: SweepWindow) -> tuple[float, int]:
    """The share of the sweep, and the sector at whose border a turn begins, under which scans meet best.

    Points between the right start and another are off by a whole turn and match nothing, so that the cost has
    no gradient there: starts are tried in a grid, which is refined around the best.
    """

    def misfit(fraction: float, sector: int) -> float:
        return at_hypothesis([window.copy()], fraction, sector % SECTORS, _TRIED_ITERATIONS).misfit

    coarse = [(f, sector) for f in _TRIED for sector in (range(0, SECTORS, _COARSE) if f else (0,))]
    least, (fraction, sector) = min((misfit(*tried), tried) for tried in coarse)
    step = _COARSE // 2 if fraction else 0
    while step:
        least, sector = min(
            (least, sector), *((misfit(fraction, s), s) for s in (sector - step, sector + step))
        )
        step //= 2
    return fraction, sector % SECTORS


_COARSE = 8
"""Sectors between the starts that are tried first."""
_TRIED = (0.0, -1.0, 1.0)
"""Shares of the sweep that registration begins with."""
_SAME_START_RAD = 0.3
"""A turn begins at one place where all fits find it within this."""
_SURELY_WORSE = 3.0
"""A fit that is worse by more sigmas than this is no answer. Of 54 decisions about every second to fourth
ring of KITTI drives four were wrong by the best start alone, and one is where others count (the other three:
``test_the_sweep_that_few_rings_show``)."""
_FEW_SCANS, _FEW_POINTS, _TRIED_ITERATIONS = 6, 60, 4
"""Scans, points of each direction of normals, and iterations for each start that is tried."""
