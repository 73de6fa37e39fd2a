"""Whether the points of a drive were moved to one instant, or which way its scanner turned."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np

from sst_graph.config import Settings, setting
from sst_graph.odometry.lidar import LidarOdometry, LidarOdometryConfig
from sst_graph.odometry.sweep.estimate import CANDIDATES, Estimate, at_hypothesis, estimate, start_of
from sst_graph.odometry.sweep.window import SECTORS, SweepWindowConfig, Window
from sst_graph.sweep_timing import LONGEST_TURN_S, SweepStamp, SweepTiming
from sst_graph.types import FloatArray, Scan

_LOG = logging.getLogger(__name__)

Hypothesis = Literal["compensated", "clockwise", "counterclockwise"]
SweepKind = Literal["compensated", "clockwise", "counterclockwise", "undecided", "standing", "given"]
"""One of the hypotheses, or: none is excluded; nothing moved, so that none matters; not asked."""
FRACTIONS: dict[str, float] = {"compensated": 0.0, "clockwise": -1.0, "counterclockwise": 1.0}

REMEDY = (
    "say --sweep compensated, --sweep clockwise or --sweep counterclockwise, or give the time of each point"
)


@dataclass(frozen=True)
class SweepConfig(Settings):
    """How the sweep of scans without times is decided.

    Attributes:
        decide: whether it is; False takes such points as compensated.
        window: how scans are registered to one another.
        places: pairs of consecutive scans, spread over the drive, whose speed is looked at first.
        windows: most stretches that are registered, the fastest first, as long as they may decide it.
        scans: of a stretch.
        step_m, step_rad: motion from one scan of a stretch to the next that is aimed at, where the vehicle is
            slow by leaving scans out [m, rad].
        most_skipped: most scans left out between two of a stretch.
        rest_mps, rest_radps: a vehicle that is nowhere faster stands [m/s, rad/s].
        travel_m, travel_rad: a stretch tells nothing where the vehicle moves less from its first scan to its
            last: surfaces are then seen from one side only, with the same errors in every scan [m, rad].
        error_rate: a hypothesis is excluded where another is 1 / error_rate times as likely: so much against
            the right one is found in this share of drives at most, where the error model holds.
        tolerance: the estimated share may differ so much from 0 or 1 beside three of its sigmas.
        long_sweep_m: where the vehicle moves farther in a turn, matches made under a wrong hypothesis hold
            themselves up, and all are tried from the start [m].
    """

    decide: bool = True
    window: SweepWindowConfig = field(default_factory=SweepWindowConfig)
    places: int = setting(6, at_least=1, at_most=1000)
    windows: int = setting(6, at_least=1, at_most=100)
    scans: int = setting(12, at_least=2, at_most=200)
    step_m: float = setting(0.8, at_least=0.001, at_most=100.0)
    step_rad: float = setting(0.15, at_least=0.001, at_most=7.0)
    most_skipped: int = setting(7, at_least=0, at_most=1000)
    rest_mps: float = setting(0.1, at_least=0.0, at_most=100.0)
    rest_radps: float = setting(0.02, at_least=0.0, at_most=10.0)
    travel_m: float = setting(3.0, at_least=0.0, at_most=1000.0)
    travel_rad: float = setting(0.25, at_least=0.0, at_most=100.0)
    error_rate: float = setting(0.001, at_least=1e-12, at_most=0.5)
    tolerance: float = setting(0.2, at_least=0.0, at_most=2.0)
    long_sweep_m: float = setting(1.0, at_least=0.0, at_most=1000.0)


@dataclass(frozen=True)
class SweepDecision:
    """What was decided of the sweep, and why.

    Attributes:
        kind: the hypothesis, or why there is none.
        timing: times of the points as they are used.
        fraction, sigma: estimated share of the sweep in the points, -1 (clockwise) to 1, and its standard
            deviation, at the start of the turn that fits best; sigma infinite where nothing tells.
        worse_by: by how many standard deviations each hypothesis fits worse than the best.
        start_told: whether the scans show where a turn begins; else the start lies where no points are.
        speed_mps: fastest mean speed of the stretches looked at.
        frames: numbers of the scans looked at, in the order of the drive.
        others: times of the points under the hypotheses that are not excluded, beside ``timing``.
    """

    kind: SweepKind
    timing: SweepTiming
    fraction: float = 0.0
    sigma: float = np.inf
    worse_by: Mapping[str, float] = field(default_factory=dict)
    start_told: bool = False
    speed_mps: float = 0.0
    frames: tuple[int, ...] = ()
    others: tuple[SweepTiming, ...] = ()

    @property
    def shares(self) -> dict[float, float]:
        """Probability of each hypothesis, by its fraction; sigmas are taken as twice as large as claimed, for
        a hypothesis that the scans leave open is one that their error model does not settle.
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
        share = f"share of the sweep in the points {self.fraction:+.2f} +- {self.sigma:.2f}"
        if self.kind == "given":
            return "as given"
        if self.kind == "standing":
            return "taken as compensated: the vehicle stands, so that it does not matter"
        if self.kind == "undecided":
            return f"not told by the scans ({share}); taken as compensated"
        if self.kind == "compensated":
            return f"compensated ({share}, 0 expected)"
        where = f"a turn begins at {np.degrees(self.timing.start_rad):.0f} deg" if self.start_told else ""
        expected = FRACTIONS[self.kind]
        return f"as measured, {self.kind} ({share}, {expected:+.0f} expected){'; ' * bool(where)}{where}"

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, for the diagnostics of a result."""
        return {
            "kind": self.kind,
            "sentence": self.sentence,
            "fraction": self.fraction,
            "sigma": self.sigma,
            "worse_by_sigmas": dict(self.worse_by),
            "timing": self.timing.to_dict(),
            "start_told": self.start_told,
            "speed_mps": self.speed_mps,
            "scans": list(self.frames),
        }


@dataclass(frozen=True)
class _Place:
    """A pair of consecutive scans: position of the first, and motion of the LiDAR from one to the other."""

    position: int
    seconds: float
    speed_mps: float
    turn_radps: float


def decide_sweep(
    scan_at: Callable[[int], Scan | None],
    count: int,
    config: SweepConfig | None = None,
    stamp: SweepStamp = "forward",
) -> SweepDecision:
    """Decide it from the scans of a drive that have no times of their points.

    Args:
        scan_at: scan at a position, or None where the frame has none.
        count: number of positions.
        config: settings.
        stamp: the instant that a scan's stamp names, in case the points are as measured.
    """
    config = config or SweepConfig()
    places = _places(scan_at, count, config)
    if not places:
        return SweepDecision("undecided", SweepTiming(0.0, -np.pi, 0.1, stamp))
    period_s = float(np.median([place.seconds for place in places]))
    # Stamps in another unit: what is wrong with them is said elsewhere.
    if not 0.0 < period_s < LONGEST_TURN_S:
        return SweepDecision("undecided", SweepTiming(0.0, -np.pi, 0.1, stamp))
    timing = SweepTiming(0.0, -np.pi, period_s, stamp)
    if max(_worth(place, config) for place in places) < 1.0:
        return SweepDecision("standing", timing, speed_mps=max(place.speed_mps for place in places))
    places = sorted(places, key=lambda place: _rank(place, period_s, config))
    both = tuple(replace(timing, fraction=f) for f in (-1.0, 1.0))
    decision = SweepDecision("undecided", timing, others=both)
    windows: list[Window] = []
    used: list[int] = []
    for place in places:
        if _worth(place, config) < 1.0 or any(abs(place.position - k) < config.scans // 2 for k in used):
            continue
        positions = _stretch(place, count, config)
        scans = [(k, scan) for k in positions if (scan := scan_at(k)) is not None]
        if len(scans) < 3:
            continue
        window = Window([scan for _, scan in scans], period_s, config.window)
        if window.travel[0] < config.travel_m and window.travel[1] < config.travel_rad:
            continue
        windows.append(window)
        used += [k for k, _ in scans]
        decision = replace(_decided(windows, timing, config), frames=tuple(sorted(set(used))))
        _LOG.info("sweep: %s", decision.sentence)
        if decision.kind != "undecided" or len(windows) == config.windows:
            break
        # As many windows again as are left would tell so much if they were all like these.
        expected = 0.5 / decision.sigma**2 * config.windows / len(windows)
        if expected < _HOPE * -np.log(config.error_rate):
            break
    return decision


def _places(scan_at: Callable[[int], Scan | None], count: int, config: SweepConfig) -> list[_Place]:
    """Speeds at pairs of scans spread over the drive."""
    found = []
    for k in np.unique(np.linspace(0, max(count - 2, 0), config.places).round().astype(int)).tolist():
        a, b = scan_at(k), scan_at(k + 1) if k + 1 < count else None
        if a is None or b is None or b.stamp_ns <= a.stamp_ns:
            continue
        odometry = LidarOdometry(LidarOdometryConfig())
        odometry.add(a)
        motion = odometry.add(b)
        if motion is not None and motion.ok:
            turn, speed = (float(np.linalg.norm(part)) for part in np.split(motion.mean_twist, 2))
            found.append(_Place(k, motion.seconds, speed, turn))
    return found


def _worth(place: _Place, config: SweepConfig) -> float:
    return max(place.speed_mps / config.rest_mps, place.turn_radps / config.rest_radps)


def _rank(place: _Place, period_s: float, config: SweepConfig) -> float:
    """The fastest first; last, slowest first, those too fast for matches under a wrong hypothesis."""
    worth = _worth(place, config)
    return worth if place.speed_mps * period_s > config.long_sweep_m else -worth


def _stretch(place: _Place, count: int, config: SweepConfig) -> list[int]:
    """Positions of the scans around a place, so far apart that the vehicle moves from one to the next."""
    step = min(
        config.step_m / max(place.speed_mps * place.seconds, 1e-3),
        config.step_rad / max(place.turn_radps * place.seconds, 1e-3),
    )
    every = int(
        np.clip(round(step), 1, min(config.most_skipped + 1, max(1, (count - 1) // (config.scans - 1))))
    )
    length = (config.scans - 1) * every
    first = int(np.clip(place.position - length // 2, 0, max(0, count - 1 - length)))
    return list(range(first, min(count, first + length + 1), every))


def _decided(windows: Sequence[Window], timing: SweepTiming, config: SweepConfig) -> SweepDecision:
    """The decision that some stretches allow."""
    speed = max(float(np.linalg.norm(window.twists[:, 3:], axis=1).mean()) for window in windows)
    fraction, sector = 0.0, 0
    far = speed * timing.period_s > config.long_sweep_m
    if far:
        fraction, sector = _best_start(windows[0].thinned(_FEW_SCANS, _FEW_POINTS))
    found = estimate(windows, fraction, sector)
    return replace(_judged(windows, found, timing, config), speed_mps=speed)


def _judged(
    windows: Sequence[Window], found: Estimate, timing: SweepTiming, config: SweepConfig
) -> SweepDecision:
    """The three hypotheses by their evidence, that of compensated points being 1."""
    told = found.evidence(windows)
    ratios: dict[str, FloatArray] = {name: told.log_ratio(f) for name, f in FRACTIONS.items()}
    evidence = {name: _log_mean(ratio) for name, ratio in ratios.items()}
    best = max(evidence, key=lambda name: evidence[name])
    behind = {name: evidence[best] - evidence[name] for name in evidence}
    needed = -np.log(config.error_rate)
    excluded = {name for name in behind if behind[name] > needed}
    starts = {name: _start(-ratio) for name, ratio in ratios.items()}
    # Against compensated points stands the turn that comes nearest to them.
    raw = best if best != "compensated" else min(_RAW, key=lambda name: behind[name])
    sector, start_told = starts[raw]
    share, sigma = float(found.quadratic.free()[sector]), float(told.sigma[sector])
    agrees = abs(share - FRACTIONS[best]) < config.tolerance + 3.0 * sigma
    # Where only a step at the start of the turn shows, one side of the scene against the other, whatever else
    # sets the sides apart looks like it: every start must be told, also one where no points are.
    informed = 0.5 / float(told.sigma.max()) ** 2 > needed
    decided = len(excluded) == 2 and agrees and informed
    timings = {
        name: replace(timing, fraction=FRACTIONS[name], start_rad=start_of(starts[name][0]))
        for name in evidence
    }
    kind = cast(SweepKind, best if decided else "undecided")
    settled = agrees and informed
    others = [timings[name] for name in evidence if name not in excluded or not settled]
    return SweepDecision(
        kind,
        timings[best] if decided and best != "compensated" else timing,
        share,
        sigma,
        {name: float(np.sqrt(2.0 * value)) for name, value in behind.items()},
        start_told and best != "compensated",
        others=() if decided else tuple(other for other in others if not other.instant),
    )


_RAW = ("clockwise", "counterclockwise")
_HOPE = 0.5
"""Share of the evidence needed below which no more stretches are looked at."""


def _log_mean(values: FloatArray) -> float:
    """log(mean(exp(values)))."""
    most = float(values.max())
    return most + float(np.log(np.mean(np.exp(values - most))))


def _start(costs: FloatArray) -> tuple[int, bool]:
    """Sector at whose border a turn begins, and whether the costs (SECTORS,) [1/2 sigma^2] tell it.

    Of starts that fit equally well (no points between them) the one in the middle of the widest run.
    """
    alike = 2.0 * (costs - costs.min()) < 4.0
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


def _best_start(window: Window) -> tuple[float, int]:
    """The share of the sweep, and the sector at whose border a turn begins, under which scans meet best.

    Points between the right start and another are off by a whole turn and meet nothing, so that no derivative
    shows the way: starts are tried, coarsely all around and then ever nearer to the best.
    """

    def misfit(fraction: float, sector: int) -> float:
        return at_hypothesis([window.copy()], fraction, sector % SECTORS, _TRIED_PASSES).misfit

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
_FEW_SCANS, _FEW_POINTS, _TRIED_PASSES = 6, 60, 4
__all__ = ["CANDIDATES", "SweepConfig", "SweepDecision", "decide_sweep"]
