"""Intervals of stamps: jumps of a clock against late, missing and jittering stamps."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from streets import prepared_street

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate, result_of
from sst_graph.drive.preparation import Drive
from sst_graph.drive.stamp_intervals import FrameIntervals, Jump, StampMonitor, jumps_of
from sst_graph.types import Guess

CHI2 = 25.0
PERIOD_NS = 100_000_000
Stamps = NDArray[np.int64]


def steady(count: int = 60, jitter_ms: float = 0.0, seed: int = 0) -> Stamps:
    """Stamps at 10 Hz."""
    jitter = np.random.default_rng(seed).normal(0.0, 1e6 * jitter_ms, count)
    return np.arange(count, dtype=np.int64) * PERIOD_NS + np.rint(jitter).astype(np.int64)


def later(stamps: Stamps, start: int, milliseconds: float) -> Stamps:
    """The same, all from one on by so much later."""
    return stamps + (np.arange(len(stamps)) >= start) * round(1e6 * milliseconds)


def jumps(stamps: Stamps) -> list[tuple[int, Jump]]:
    """The jumps of one sensor, each with the position of the stamp that made it certain."""
    intervals = FrameIntervals("image")
    found = [(i, intervals.add(int(stamp), (i, i), CHI2)) for i, stamp in enumerate(stamps)]
    return [(i, jump) for i, jump in found if jump is not None]


@pytest.mark.parametrize("milliseconds", [-230.0, -200.0, -60.0, -30.0, -12.0, 12.0, 30.0, 45.0])
def test_a_jump_is_found_with_its_place_and_size(milliseconds: float) -> None:
    """Within three stamps; whole periods are found only backwards."""
    (at, jump), *others = jumps(later(steady(jitter_ms=0.2), 40, milliseconds))
    assert not others and jump.place == (40, 40) and at <= 42 and jump.chi2 > CHI2
    assert abs((1e3 * jump.seconds - milliseconds + 50.0) % 100.0 - 50.0) < 2.0
    assert f"{1e3 * jump.seconds:+.0f} ms" in jump.sentence and jump.sentence.startswith("the image stamps")


def test_jitter_is_no_jump() -> None:
    for seed in range(20):
        assert not jumps(steady(500, jitter_ms=2.0, seed=seed))


@pytest.mark.parametrize("late", [10, 30, 90])
def test_a_stamp_that_is_late_alone_is_no_jump(late: float) -> None:
    stamps = steady(jitter_ms=0.5)
    stamps[40] += late * 1_000_000
    assert not jumps(stamps)


def test_missing_frames_are_no_jump_and_do_not_hide_one() -> None:
    stamps = later(steady(), 45, 30.0)
    thinned = np.delete(stamps, [20, 31, 32, 39, 46])
    (_, jump), *others = jumps(thinned)
    assert not others and jump.seconds == pytest.approx(0.03)
    assert not jumps(np.delete(steady(), [20, 31, 32, 39, 46]))


def test_images_out_of_order_are_no_jump() -> None:
    stamps = steady()
    for i in range(20, 50, 5):
        stamps[[i, i + 1]] = stamps[[i + 1, i]]
    assert not jumps(stamps)


def test_images_sent_twice_are_no_jump() -> None:
    assert not jumps(np.sort(np.concatenate([steady(), steady()[20::7]])))


def test_a_pause_that_is_caught_up_is_no_jump() -> None:
    stamps = steady(jitter_ms=0.2)
    stamps[40:44] += np.array([60, 45, 30, 15]) * 1_000_000
    assert not jumps(stamps)


def test_another_rate_is_no_jump() -> None:
    """At 15 Hz from the 40th stamp on; a jump at that rate is found once it is usual."""
    faster = 40 * PERIOD_NS + np.arange(200, dtype=np.int64) * 66_666_667
    stamps = np.concatenate([steady(40), faster])
    assert not jumps(stamps)
    (_, jump), *others = jumps(later(stamps, 200, 20.0))
    assert not others and jump.seconds == pytest.approx(0.02, abs=1e-4)


def test_a_sensor_that_restarts_after_a_gap_is_no_jump() -> None:
    assert not jumps(later(steady(), 40, 1030.0))


def test_irregular_stamps_have_no_jumps() -> None:
    rng = np.random.default_rng(1)
    assert not jumps(np.cumsum(rng.integers(50, 150, 200)) * 1_000_000)
    assert not jumps(later(steady(), 8, 30.0))


def together(images: Stamps, scans: Stamps) -> list[tuple[int, Jump]]:
    """The jumps of the offset of both sensors, each image before the scan of its number."""
    monitor, found = StampMonitor(CHI2), []
    for i, (image, scan) in enumerate(zip(images.tolist(), scans.tolist(), strict=True)):
        monitor.add_image(image, (i, i))
        jump = monitor.add_scan(scan, (i + 1, i))
        found += [] if jump is None else [(i, jump)]
    return found


@pytest.mark.parametrize("sensor", ["image", "scan"])
def test_a_jump_of_either_sensor_changes_the_offset(sensor: str) -> None:
    steps = {"image": 0.0, "scan": 0.0, sensor: -30.0}
    ((at, jump),) = together(*(later(steady(), 40, steps[name]) for name in ("image", "scan")))
    assert jump.sensor == sensor and jump.place[1] == 40 and at < 50
    # Images stamped earlier show the world later than they say.
    assert jump.time_offset_s == pytest.approx(0.03 if sensor == "image" else -0.03)


@pytest.mark.parametrize("behind", [0, 1])
def test_sensors_that_jump_alike_keep_their_offset(behind: int) -> None:
    """The clock that stamps both was set; one of them shows it a frame later."""
    assert not together(later(steady(), 40, 30.0), later(steady(), 40 + behind, 30.0))
    assert together(later(steady(), 40, 30.0), later(steady(), 40 + behind, 45.0))


def test_the_jumps_of_a_whole_drive() -> None:
    """Scans at 10 Hz, images at 30 Hz, a little later; the images' clock jumps, later the scans'."""
    images = 7_000_000 + np.arange(240, dtype=np.int64) * 33_333_333
    images = later(images, 90, 13.0)
    first, second = jumps_of(images.tolist(), later(steady(80), 60, -40.0).tolist())
    assert (first.sensor, second.sensor) == ("image", "scan")
    assert first.place[0] == 90 and second.place[1] == 60
    assert first.seconds == pytest.approx(0.013) and second.seconds == pytest.approx(-0.04)
    assert jumps_of(images[:90].tolist(), steady(80).tolist()) == []


def long_drive(milliseconds: float) -> Drive:
    """Three frames over and over; the stamps of images jump at frame 45, the twentieth."""
    three, images = prepared_street(), later(steady(40), 20, milliseconds).tolist()
    scans = [
        dataclasses.replace(three.scans[k % 3], stamp_ns=stamp, index=25 + k)
        for k, stamp in enumerate(steady(40).tolist())
    ]
    shown = [
        dataclasses.replace(three.images[k % 3], stamp_ns=stamp, index=25 + k)
        for k, stamp in enumerate(images)
    ]
    return dataclasses.replace(three, scans=tuple(scans), images=tuple(shown))


def test_a_drive_whose_clock_jumps_has_no_one_offset() -> None:
    answer = MethodEstimate(gtsam.Pose3(), 0.0, 1e-8 * np.eye(7), ())
    for milliseconds, check, status in (
        (0.0, True, "ok"),
        (30.0, False, "ok"),
        (30.0, True, "not_converged"),
    ):
        config = CalibrationConfig(check_stamps=check)
        result = result_of(answer, [long_drive(milliseconds)], Guess(None), config)
        assert result.status == status
    (reason,) = result.reasons
    assert "image stamps jumped by +30 ms" in reason and "at frame 45" in reason


def test_what_makes_a_result_not_ok_is_said_before_remarks() -> None:
    covariance = np.diag([1e-8] * 6 + [1.0])
    answer = MethodEstimate(gtsam.Pose3(), 0.0, covariance, (), remarks=("the lens is a little off",))
    result = result_of(answer, [long_drive(0.0)], Guess(None), CalibrationConfig())
    assert result.status == "unobservable"
    assert "time offset" in result.reasons[0] and result.reasons[1:] == ("the lens is a little off",)
