"""Stamps in another unit than seconds, or that run too fast or too slowly."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.timestamps import FAR_APART_S, NS_PER_S, apart_s
from sst_graph.types import FloatArray

_LONGEST_PERIOD_S, _SHORTEST_PERIOD_S = 5.0, 1.0 / 60.0
"""Scans come 5 to 30 times a second, subsampled ones every few seconds [s]."""
_USUAL_PERIODS_S = (0.008, 2.0)
"""Where a period in the right unit lies [s]."""
_TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
_FASTEST_MPS = 60.0
"""Faster than road vehicles that record for calibration [m/s]."""
_HARDEST_MPS2 = 20.0
"""Tyres brake and turn with 10 m/s^2 at most; twice that leaves room for what odometry errs by, and for
simulated drives that brake harder than tyres do (14 m/s^2 on a street of the second simulator) [m/s^2]."""
_SLOWEST_TURN_S = 0.5
"""Spinning LiDARs turn 5 to 20 times a second, none less than twice [s]."""
_SHARE = 0.2
"""Of a drive in which what is impossible must be seen: single registrations fail."""
_SPAN = 5
"""Motions over which an acceleration is measured: a centimetre of noise between two scans makes 1 m/s^2."""
_CLOCKS_APART = 1.25
"""Ratio of the intervals of two sensors over the same frames: nearly 1, whatever single stamps do."""
_LEAST_STEPS = 5


def stamps(drive: Drive) -> Finding | None:
    """Stamps in another unit than seconds, or at a rate that motion and sweep contradict."""
    if len(drive.scans) < 3:
        return None
    steps = _steps_s(drive.scan_stamps_ns)
    period = float(np.median(steps))
    if period > _LONGEST_PERIOD_S:
        return _in_another_unit(steps, period)
    speed, acceleration = _dynamics(drive)
    spread = max((scan.sweep_s for scan in drive.statistics.scans), default=0.0) if drive.statistics else 0.0
    found = []
    if period <= _SHORTEST_PERIOD_S:
        found.append("no scanner turns so fast")
    if speed >= _FASTEST_MPS:
        found.append(f"a speed of {speed:.0f} m/s")
    if acceleration >= _HARDEST_MPS2:
        found.append(f"accelerations of {acceleration:.0f} m/s2")
    if spread >= 2.0 * period:
        found.append(f"points of one scan spread over {1e3 * spread:.0f} ms")
    if found:
        return _wrong_rate("too slowly", period, found)
    turn_s = max(spread, _measured_turn_s(drive))
    if turn_s > _SLOWEST_TURN_S:
        return _wrong_rate("too fast", period, [f"a turn of the scanner takes {1e3 * turn_s:.0f} ms"])
    return None


def apart(drive: Drive, time_offset_s: float) -> Finding | None:
    """Scans and images of different times, under the offset that the calibration starts from [s]."""
    if not drive.scans or not drive.images:
        return None
    scans, images = ((stamps[0], stamps[-1]) for stamps in (drive.scan_stamps_ns, drive.image_stamps_ns))
    offset_ns = round(time_offset_s * NS_PER_S)
    if apart_s(scans, (images[0] + offset_ns, images[1] + offset_ns)) < FAR_APART_S:
        return None
    spans = [f"from {first * 1e-9:.3f} to {last * 1e-9:.3f} s" for first, last in (scans, images)]
    return Finding(
        "no image is of the time of the scans",
        f"scans {spans[0]}, images {spans[1]}",
        "write the stamps of both by one clock, or give the time offset by --init FILE",
    )


def point_times(drive: Drive) -> Finding | None:
    """Scans with times of their points beside scans without: the points of the latter count as measured at
    once, and those of the same scanner are not."""
    scans = () if drive.statistics is None else drive.statistics.scans
    timed = [scan.sweep_s > 0.0 for scan in scans if sum(scan.labelled.values()) > 1]
    if all(timed) or not any(timed):
        return None
    return Finding(
        "some scans have times of their points, others have none",
        f"{timed.count(False)} of {count_of(len(timed), 'scan')} have none, or all of them equal",
        "give the times of all scans, or of none and say --sweep compensated, clockwise or counterclockwise",
    )


def two_clocks(drive: Drive) -> Finding | None:
    """Scans and images of the same frames whose stamps do not advance alike."""
    if drive.statistics is None:
        return None
    scans = {scan.index: scan.stamp_ns for scan in drive.statistics.scans}
    images = {image.index: image.stamp_ns for image in drive.statistics.images}
    both = sorted(scans.keys() & images.keys())
    if len(both) <= _LEAST_STEPS:
        return None
    of_scans, of_images = (
        _steps_s([scans[index] for index in both]),
        _steps_s([images[index] for index in both]),
    )
    used: NDArray[np.bool_] = (of_scans > 0.0) & (of_images > 0.0)
    if used.sum() < _LEAST_STEPS:
        return None
    ratio = float(np.median(of_images[used] / of_scans[used]))
    if 1.0 / _CLOCKS_APART < ratio < _CLOCKS_APART:
        return None
    intervals = [f"{1e3 * float(np.median(steps[used])):.3g} ms" for steps in (of_scans, of_images)]
    return Finding(
        f"the images' stamps run {ratio:.2g} times as fast as the scans' (wrong rate or unit of one of them)",
        f"from frame to frame {intervals[0]} for the scans, {intervals[1]} for the images",
        "compare both intervals with the sensors' rates, and the numbers of frames of both",
    )


def _steps_s(stamps_ns: Sequence[int]) -> FloatArray:
    return np.asarray(np.diff(np.array(stamps_ns, np.int64)) * 1e-9)


def _in_another_unit(steps: FloatArray, period: float) -> Finding | None:
    fitting = [f for f in _TIME_UNITS if _USUAL_PERIODS_S[0] <= period / f <= _USUAL_PERIODS_S[1]]
    regular = float(np.median(np.abs(steps - period))) < 0.1 * period
    if not fitting or not regular:
        return None
    return Finding(
        f"the stamps are in {_TIME_UNITS[fitting[0]]}, not seconds",
        f"{period:.4g} s from scan to scan; in that unit it is {period / fitting[0]:.2g} s",
        "write times in seconds",
    )


def _wrong_rate(how: str, period: float, found: list[str]) -> Finding:
    return Finding(
        f"the stamps run {how} (wrong frame rate or unit)",
        ", ".join([f"{1e3 * period:.3g} ms from scan to scan", *found]),
        "compare the stamps' intervals with the scanner's rate, 5 to 20 turns a second for most",
    )


def _dynamics(drive: Drive) -> tuple[float, float]:
    """Speed [m/s] and acceleration [m/s^2] that a part of the drive exceeds; 0 where too few are known."""
    motions = [motion for motion in drive.lidar_motions if motion.ok]
    if len(motions) < 3:
        return 0.0, 0.0
    seconds = np.array([motion.seconds for motion in motions])
    steps = [motion.aTb for motion in motions]
    speeds = np.array([float(np.linalg.norm(step.translation())) for step in steps]) / seconds
    turns = np.array([float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))) for step in steps]) / seconds
    fast = float(np.quantile(speeds, 1.0 - _SHARE))
    if len(motions) <= _SPAN:
        return fast, 0.0
    sideways = float(np.quantile(speeds * turns, 1.0 - _SHARE))
    # Speeds of three motions each, so that one failed registration is no acceleration.
    calm = np.median(np.stack([speeds[:-2], speeds[1:-1], speeds[2:]]), axis=0)
    at = np.cumsum(seconds)[1:-1]
    if len(calm) <= _SPAN:
        return fast, sideways
    along = np.abs(calm[_SPAN:] - calm[:-_SPAN]) / (at[_SPAN:] - at[:-_SPAN])
    return fast, max(sideways, float(np.quantile(along, 1.0 - _SHARE)))


def _measured_turn_s(drive: Drive) -> float:
    """Duration of a turn where the scans themselves show that they are as measured; else 0 [s]."""
    sweep = drive.sweep
    if sweep is None or sweep.kind not in ("clockwise", "counterclockwise"):
        return 0.0
    return sweep.timing.period_s
