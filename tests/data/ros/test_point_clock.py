"""Times of points by the LiDAR's own clock, in bags and in folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stored import written

pytest.importorskip("rosbags")

from bags import EPOCH_NS, MASK
from driver_bags import HALF_S, STREET, Driver
from driver_bags import bag_of_driver as bag

from sst_graph.batch import calibrate
from sst_graph.cli import main
from sst_graph.data import KittiSource, open_source
from sst_graph.data.info.facts import facts_of
from sst_graph.data.point_times import (
    PointClock,
    ScanTimes,
    StreamClock,
    clock_of_points,
    seconds_after_stamp,
)
from sst_graph.data.point_times.clock import OTHER_CLOCK
from sst_graph.data.source import SourceOptions
from sst_graph.errors import DataError


@pytest.fixture(scope="module")
def drive() -> KittiSource:
    source = open_source(written(STREET))
    assert isinstance(source, KittiSource)
    return source


def times_of(path: Path) -> list[NDArray[np.float64]]:
    """Times of the points of each scan after EPOCH_NS [s]."""
    scans = [frame.scan for frame in open_source(path, mask_topic=MASK) if frame.scan is not None]
    return [(s.stamp_ns - EPOCH_NS) * 1e-9 + s.offsets_s for s in scans if s.offsets_s is not None]


def remarks(path: Path, **options: Any) -> str:
    facts = facts_of(open_source(path, mask_topic=MASK, **options))
    assert facts is not None
    return " ".join(facts.remarks)


@pytest.mark.parametrize(
    "driver",
    [
        Driver(True),
        Driver(True, jitter_s=0.001),
        Driver(True, lost=True),
        Driver(True, later_s=2 * HALF_S, arrives_s=0.004),
    ],
    ids=["start", "jitter", "lost", "end"],
)
def test_times_of_another_clock_are_those_after_the_stamp(
    drive: KittiSource, tmp_path: Path, driver: Driver
) -> None:
    true = times_of(bag(drive, tmp_path / "relative", Driver(False)))
    found = times_of(bag(drive, tmp_path / "own", driver))
    assert len(found) == len(true) == len(drive)
    apart = [np.sort(one)[-50:] - np.sort(other)[-50:] for one, other in zip(found, true, strict=True)]
    # One difference for all scans, whatever their own stamps and returns.
    assert np.ptp(np.concatenate(apart)) < 1e-4 + driver.jitter_s
    assert np.abs(np.concatenate(apart)).max() < 1e-4 + 2.0 * driver.jitter_s
    named = "end" if driver.later_s else "start"
    assert f"a stamp counts as the {named} of its sweep" in remarks(tmp_path / "own")
    assert "of another clock than the stamps (1699994999." in remarks(tmp_path / "own")
    assert "s behind them" in remarks(tmp_path / "own")
    assert remarks(tmp_path / "relative") == remarks(tmp_path / "own", sweep="compensated") == ""


def test_the_option_says_what_a_stamp_names(drive: KittiSource, tmp_path: Path) -> None:
    path = bag(drive, tmp_path / "own", Driver(True))
    by_start = open_source(path, mask_topic=MASK, sweep_stamp="start")[0].scan
    by_end = open_source(path, mask_topic=MASK, sweep_stamp="end")[0].scan
    assert by_start is not None and by_end is not None
    assert by_start.offsets_s is not None and by_end.offsets_s is not None
    np.testing.assert_allclose(by_start.offsets_s - by_end.offsets_s, 2 * HALF_S, atol=1e-4)


@pytest.mark.slow
def test_the_calibration_is_that_of_times_after_the_stamp(drive: KittiSource, tmp_path: Path) -> None:
    relative, own = (
        open_source(bag(drive, tmp_path / str(own_clock), Driver(own_clock)), mask_topic=MASK)
        for own_clock in (False, True)
    )
    one, other = (calibrate(source, source.nominal) for source in (relative, own))
    sigmas = np.sqrt(np.diag(one.covariance))
    difference = one.T_camera_lidar.localCoordinates(other.T_camera_lidar)
    assert (np.abs(difference) < 0.1 * sigmas[:6]).all()
    assert abs(one.time_offset_s - other.time_offset_s) < 0.1 * sigmas[6]
    assert one.status == other.status
    said = [reason for reason in other.reasons if "of another clock" in reason]
    assert len(said) == 1 and said[0] not in one.reasons


def test_a_stamp_that_jitters_tells_no_difference(
    drive: KittiSource, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bag(drive, tmp_path / "own", Driver(True, jitter_s=0.02))
    assert "whose difference varies by" in remarks(path)
    with pytest.raises(DataError, match=r"times up to .*--sweep clockwise"):
        times_of(path)
    assert main(["info", str(path), "--mask-topic", MASK]) == 2
    assert "from the header's stamp" in capsys.readouterr().err


def test_info_says_that_the_clock_is_another_one(
    drive: KittiSource, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(bag(drive, tmp_path / "own", Driver(True))), "--mask-topic", MASK]) == 0
    assert "of another clock than the stamps" in " ".join(capsys.readouterr().out.split())


def test_clouds_in_files(kitti_drive: Path, tmp_path: Path) -> None:
    from layouts import as_folder

    folder = as_folder(kitti_drive, tmp_path / "folder", ".npz")
    after_s = np.linspace(0.0, 0.09, 12)
    for path in sorted((folder / "clouds").iterdir()):
        with np.load(path) as arrays:
            np.savez(path, **arrays, timestamp=float(path.stem) - 1e9 + after_s)
    for frame in open_source(folder):
        assert frame.scan is not None and frame.scan.offsets_s is not None
        np.testing.assert_allclose(frame.scan.offsets_s, after_s, atol=2e-6)
    facts = facts_of(open_source(folder))
    assert facts is not None and "1000000000.000 s behind them" in facts.remarks[0]


SWEEP = np.linspace(0.0, 0.1, 200)


def clock(stamps_ns: NDArray[np.int64], values: list[NDArray[Any]]) -> tuple[PointClock | None, str]:
    scans = [ScanTimes(int(stamp), of_scan) for stamp, of_scan in zip(stamps_ns, values, strict=True)]
    return clock_of_points(scans.__getitem__, len(scans), SourceOptions())


@pytest.mark.parametrize(
    ("kind", "unit_ns"), [("<u8", 1), ("<i8", 1000), ("<f8", 10**9), ("<f8", 10**6), ("<f8", 1)]
)
@pytest.mark.parametrize("ahead_s", [-1.6e9, -37.0, 37.0, 3e8])
def test_units_and_differences(kind: str, unit_ns: int, ahead_s: float) -> None:
    stamps_ns = EPOCH_NS + np.arange(20) * 100_000_000
    ahead_ns = round(ahead_s * 1e9)
    values = [
        ((stamp + ahead_ns + (SWEEP * 1e9).astype(np.int64)) / unit_ns).astype(kind) if kind == "<f8"
        else ((stamp + ahead_ns + (SWEEP * 1e9).astype(np.int64)) // unit_ns).astype(kind)
        for stamp in stamps_ns
    ]  # fmt: skip
    found, words = clock(stamps_ns, values)
    assert found is not None and found.unit_ns == unit_ns, words
    for stamp, of_scan in zip(stamps_ns.tolist(), values, strict=True):
        seconds = seconds_after_stamp(of_scan, stamp, found)
        assert seconds is not None
        np.testing.assert_allclose(seconds, SWEEP, atol=3e-6)
    assert seconds_after_stamp(np.zeros(5), EPOCH_NS, found) is None


def test_what_is_no_clock() -> None:
    stamps_ns = EPOCH_NS + np.arange(20) * 100_000_000
    # Times after the stamp, and by its clock; a field of one value.
    assert clock(stamps_ns, [SWEEP] * 20) == (None, "")
    assert clock(stamps_ns, [stamp * 1e-9 + SWEEP for stamp in stamps_ns]) == (None, "")
    assert clock(stamps_ns, [np.full(9, 5.0)] * 20) == (None, "")
    # Times that stand still, or run twice as fast; too few scans; no unit.
    assert "runs 0 times as fast" in clock(stamps_ns, [SWEEP + 50.0] * 20)[1]
    assert "runs 2 times as fast" in clock(stamps_ns, [0.2 * k + 50.0 + SWEEP for k in range(20)])[1]
    assert "2 scans cannot tell" in clock(stamps_ns[:2], [0.1 * k + 50.0 + SWEEP for k in range(2)])[1]
    assert "0 scans cannot tell" in clock(stamps_ns, [k + SWEEP * 1e30 + 1e30 for k in range(20)])[1]


def test_a_drift_is_followed() -> None:
    stamps_ns = EPOCH_NS + np.arange(0, 10_000, 10) * 100_000_000
    passed = (stamps_ns - EPOCH_NS) * 1e-9
    found, words = clock(stamps_ns, [500.0 + 1.00002 * s + SWEEP for s in passed])
    assert found is not None and "drift 20.0 ppm" in words
    seconds = seconds_after_stamp(500.0 + 1.00002 * passed[-1] + SWEEP, int(stamps_ns[-1]), found)
    assert seconds is not None
    np.testing.assert_allclose(seconds, SWEEP, atol=1e-5)


def test_single_bad_scans_do_not_change_the_clock() -> None:
    """Whichever of the scans they are: those that are looked at first, too."""
    stamps_ns = EPOCH_NS + np.arange(20) * 100_000_000
    by_stamps = [stamp * 1e-9 + SWEEP for stamp in stamps_ns]
    for bad in ([0], [10], [0, 10, 19]):
        values = [one + 1e6 * (k in bad) for k, one in enumerate(by_stamps)]
        assert clock(stamps_ns, values) == (None, "")
    own = [one + 37.0 if k % 4 else one for k, one in enumerate(by_stamps)]
    found, _ = clock(stamps_ns, own)
    assert found is not None
    assert abs(found.at(EPOCH_NS) - EPOCH_NS - 37 * 10**9) < 1_000_000
    # Scans without times say nothing of the clock.
    some = [np.zeros(200) if k % 3 else one + 37.0 for k, one in enumerate(by_stamps)]
    assert clock(stamps_ns, some)[0] is not None


@pytest.mark.parametrize(
    ("after_s", "named"),
    [
        ([0.11] * 20, "start"),
        ([0.004] * 20, "end"),
        # Single messages: before their stamp, at once, late.
        ([-0.01] + [0.11] * 19, "start"),
        ([0.001] + [0.11] * 19, "start"),
        ([-0.01] + [0.004] * 19, "end"),
        ([0.3] * 5 + [0.004] * 15, "end"),
        ([None] * 19 + [0.11], "start"),
        # The recorder's clock is behind.
        ([-0.5] * 20, "start"),
        ([None] * 20, "start"),
    ],
)
def test_when_messages_arrive_tells_what_their_stamps_name(after_s: list[float | None], named: str) -> None:
    stamps_ns = (EPOCH_NS + np.arange(20) * 100_000_000).tolist()
    scans = [
        ScanTimes(stamp, stamp * 1e-9 + 37.0 + SWEEP, None if after is None else stamp + round(after * 1e9))
        for stamp, after in zip(stamps_ns, after_s, strict=True)
    ]
    assert f"as the {named} of" in clock_of_points(scans.__getitem__, len(scans), SourceOptions())[1]


@pytest.mark.parametrize("arrives_s", [0.0, 2e-7], ids=["equal", "rounded"])
def test_a_bag_rewritten_by_its_stamps_does_not_tell_what_they_name(
    drive: KittiSource, tmp_path: Path, arrives_s: float
) -> None:
    path = bag(drive, tmp_path / "own", Driver(True, arrives_s=arrives_s))
    assert "a stamp counts as the start of its sweep" in remarks(path)
    # Times of recording as stamps: the sweep is over by then.
    assert "a stamp counts as the end of its sweep" in remarks(path, stamps="received")


def test_the_clock_of_a_stream() -> None:
    """It is known from the tenth scan on, follows a drift for hours, and outlives a bag that begins again."""
    drift, stream = 5e-5, StreamClock()
    for k in range(3000):
        passed = 1.7 * k
        stamp_ns = EPOCH_NS + round(passed * 1e9)
        values = 40.0 + (1.0 + drift) * passed + SWEEP
        stream.add(stamp_ns, values, stamp_ns + 110_000_000)
        if k < 9:
            assert stream.waiting == f"{OTHER_CLOCK}: {k + 1} of 10 scans have told the difference yet"
            continue
        assert stream.waiting == "" and "as the start of its sweep" in stream.words
        seconds = seconds_after_stamp(values, stamp_ns, stream.clock)
        assert seconds is not None
        np.testing.assert_allclose(seconds, SWEEP, atol=1e-4)
    before = stream.clock
    stream.add(EPOCH_NS, 40.0 + SWEEP, EPOCH_NS)
    assert stream.clock is before and stream.clock is not None
    seconds = seconds_after_stamp(40.0 + SWEEP, EPOCH_NS, stream.clock)
    assert seconds is not None and np.abs(seconds - SWEEP).max() < 0.01


def test_what_stamps_name_is_found_once_in_a_stream() -> None:
    """Messages that come later than at first do not move the points by a sweep."""
    stream = StreamClock()
    for k in range(200):
        stamp_ns, late_ns = EPOCH_NS + k * 100_000_000, 5_000_000 if k < 20 else 150_000_000
        values = 37.0 + 0.1 * k + SWEEP
        stream.add(stamp_ns, values, stamp_ns + late_ns)
        if k >= 9:
            seconds = seconds_after_stamp(values, stamp_ns, stream.clock)
            assert seconds is not None
            np.testing.assert_allclose(seconds, SWEEP - 0.1, atol=1e-5)


def _added(stream: StreamClock, passed_s: float, own_s: float) -> float:
    """Error of the first point's time, after a scan was added whose points begin at ``own_s`` [s]; NaN where
    there is no clock."""
    stamp_ns, values = EPOCH_NS + round(passed_s * 1e9), 40.0 + own_s + SWEEP
    stream.add(stamp_ns, values, stamp_ns + 110_000_000)
    seconds = None if stream.clock is None else seconds_after_stamp(values, stamp_ns, stream.clock)
    return np.nan if seconds is None else float(seconds[0])


@pytest.mark.parametrize("order", [[0, 0], [1, 0]], ids=["twice", "swapped"])
def test_scans_that_come_twice_or_swapped_do_not_hinder_a_stream(order: list[int]) -> None:
    stream = StreamClock()
    for k in range(0, 60, 2):
        for step in order:
            error_s = _added(stream, 0.1 * (k + step), 0.1 * (k + step))
    assert abs(error_s) < 1e-4 and not stream.waiting


@pytest.mark.parametrize("step_s", [-0.3, 0.3])
def test_a_clock_that_is_set_is_found_in_a_stream(step_s: float) -> None:
    """Few scans have wrong times, then none have times, and from the tenth on they are right."""
    stream = StreamClock()
    before = [_added(stream, 0.1 * k, 0.1 * k) for k in range(60)]
    assert np.isnan(before[:9]).all() and np.abs(before[9:]).max() < 1e-4
    errors = [_added(stream, 6.0 + 0.1 * k + step_s, 6.0 + 0.1 * k) for k in range(40)]
    assert np.count_nonzero(np.abs(errors) > 1e-3) <= 6
    assert np.abs(errors[20:]).max() < 1e-4


def test_a_stream_by_the_clock_of_its_stamps() -> None:
    stream = StreamClock()
    for values in (None, np.zeros(9), SWEEP, EPOCH_NS * 1e-9 + SWEEP):
        stream.add(EPOCH_NS, values, EPOCH_NS)
        assert (stream.clock, stream.words, stream.waiting) == (None, "", "")
