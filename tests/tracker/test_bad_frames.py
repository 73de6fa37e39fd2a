"""Whatever a frame's arrays hold: nothing raises, and what is refused has changed nothing."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from stored import simulated
from streets import EARLY_START, TRACKED_STREET, saved_tracker

from sst_graph import CalibrationConfig, PinholeCamera, Tracker
from sst_graph.batch.config import Method
from sst_graph.errors import DataError, SstGraphError
from sst_graph.files.object_store import stored
from sst_graph.odometry.lidar import LidarOdometry
from sst_graph.simulator import SimulatedDrive
from sst_graph.types import NO_PICTURE, CameraImage, Frame, PixelStretch, Scan
from sst_graph.validation import checked_image, checked_scan

Rng = np.random.Generator
Change = Callable[[Rng, Any], Any]

LENGTHS: list[Change] = [
    lambda rng, x: x[: rng.integers(0, len(x))],
    lambda rng, x: np.concatenate([x, x[: rng.integers(1, len(x))]]),
    lambda rng, x: x[:0],
    lambda rng, x: x[None],
    lambda rng, x: x.reshape(-1),
    lambda rng, x: x[..., None],
    lambda rng, x: np.float64(x.flat[0]),
    lambda rng, x: x.reshape(len(x), -1).T,
]
KINDS: list[Change] = [
    lambda rng, x: x.tolist(),
    lambda rng, x: None,
    lambda rng, x: "points",
    lambda rng, x: x.astype(str),
    lambda rng, x: x.astype(object),
    lambda rng, x: x.astype(complex) * 1j,
    lambda rng, x: x > x.flat[0],
    lambda rng, x: np.zeros(x.shape, "datetime64[ns]"),
    lambda rng, x: x.astype("f8"),
    lambda rng, x: x.astype(">f4"),
    lambda rng, x: x.astype("i8") - 1,
    lambda rng, x: np.asfortranarray(x)[::-1],
    lambda rng, x: np.zeros(x.shape, [("x", "f4")]),
]
VALUES: list[Change] = [
    lambda rng, x: _filled(rng, x.astype(np.float64), np.nan),
    lambda rng, x: _filled(rng, x.astype(np.float64), np.inf),
    lambda rng, x: _filled(rng, x.astype(np.float64), -np.inf),
    lambda rng, x: _filled(rng, x.astype(np.float64), 1e300),
    lambda rng, x: _filled(rng, x.astype(np.float64), -3e38),
    lambda rng, x: _filled(rng, x.astype(np.int64), 2**62),
    lambda rng, x: _filled(rng, x.astype(np.int64), -(2**62)),
    lambda rng, x: _filled(rng, x, 200),
    lambda rng, x: np.zeros_like(x),
    lambda rng, x: np.full_like(x, x.flat[0]),
    lambda rng, x: rng.permutation(x),
    lambda rng, x: rng.permuted(x, axis=0),
    lambda rng, x: x[rng.integers(0, len(x), len(x))],
]
STAMPS = [None, "0", 1.5e9, np.nan, True, np.array([1]), -(2**80), 2**62 + 1, 2**61, -5, 10**30, 1 + 2j]


def _filled(rng: Rng, array: np.ndarray[Any, Any], value: float) -> np.ndarray[Any, Any]:
    """Some entries replaced: one, a row, or all."""
    array, some = array.copy(), rng.integers(3)
    if some == 0:
        array.flat[rng.integers(array.size)] = value
    else:
        array[rng.integers(len(array)) if some == 1 else slice(None)] = value
    return array


def _changed(rng: Rng, data: Scan | CameraImage, stamp_ns: int) -> Any:
    """A scan or an image with one or two of its fields made wrong, or only unusual."""
    data = dataclasses.replace(data, stamp_ns=stamp_ns)
    arrays = [f.name for f in dataclasses.fields(data) if f.name != "stamp_ns"]
    for _ in range(rng.integers(1, 3)):
        if rng.random() < 0.15:
            data = dataclasses.replace(data, stamp_ns=STAMPS[rng.integers(len(STAMPS))])  # type: ignore[arg-type]
            continue
        name = arrays[rng.integers(len(arrays))]
        value = getattr(data, name)
        changes = (LENGTHS, KINDS, VALUES)[rng.integers(3)]
        if isinstance(value, np.ndarray) and value.size and value.ndim:
            try:
                value = changes[rng.integers(len(changes))](rng, value)
            except (ValueError, TypeError, OverflowError):  # no such array
                continue
        data = dataclasses.replace(data, **{name: value})
    return data


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of a tracker that has an estimate, after 14 frames."""
    path = tmp_path_factory.mktemp("tracker") / "tracker.npz"
    path.write_bytes(saved_tracker(14))
    assert Tracker.load(path).estimate.exists
    return path


def _state(tracker: Tracker) -> tuple[Any, bytes]:
    """All that a tracker holds, but for what it answered last."""
    tracker.last_update = None
    return stored(tracker)


def _bad(rng: Rng, frames: list[Frame], count: int) -> Iterator[Frame]:
    """Frames of which the scan, the image or both have been tampered with."""
    for k in range(count):
        good = frames[14 + k % 20]
        assert good.scan is not None and good.image is not None
        stamp = good.scan.stamp_ns + k // 20
        scan: Any = dataclasses.replace(good.scan, stamp_ns=stamp)
        which = rng.integers(3)
        if which != 1:
            scan = _changed(rng, _whole(scan), stamp)
        image: Any = good.image
        if which != 0:
            image = _changed(rng, image, stamp)
        yield Frame(k, scan, image)


def _whole(scan: Scan) -> Scan:
    """With the times of its points and the numbers of its rings, which the simulated ones do without."""
    n = len(scan.points)
    return dataclasses.replace(
        scan,
        offsets_s=np.linspace(-0.05, 0.05, n, dtype=np.float32),
        rings=np.arange(n).astype(np.uint16) % 64,
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("seed", range(2))
def test_nothing_that_a_frame_brings_raises(running: Path, frames: list[Frame], seed: int) -> None:
    """Each frame is taken, or refused with a reason; then the tracker is byte for byte what it was."""
    tracker, rng = Tracker.load(running), np.random.default_rng(seed)
    refused = 0
    for frame in _bad(rng, frames, 60):
        for add, data in ((tracker.add_image, frame.image), (tracker.add_scan, frame.scan)):
            before = _state(tracker)
            update = add(data)  # type: ignore[operator]
            assert np.isfinite(update.sigmas).all() and np.isfinite(update.T_camera_lidar.matrix()).all()
            if update.refused:
                refused += 1
                assert update.reason and not update.accepted
                assert _state(tracker) == before
    assert refused > 30


def test_a_frame_may_be_anything(running: Path) -> None:
    """Only what was answered to it is remembered."""
    tracker = Tracker.load(running)
    before = _state(tracker)
    for thing in (None, "frame", 3, np.zeros(3), Frame(0, None, None), Frame(0, "scan", {}), object()):
        update = tracker.add(thing)  # type: ignore[arg-type]
        assert not update.accepted and update.reason
    for index in (np.zeros(3), "a", 1.5, None, True, 2**80):
        update = tracker.add(Frame(index, None, None))  # type: ignore[arg-type]
        assert "frame: found an index" in update.reason
    assert tracker.last_update is not None and tracker.last_update.frame == 0
    assert _state(tracker) == before


def test_a_scan_s_number_is_one(running: Path, frames: list[Frame]) -> None:
    """Else the result could not be written, nor a checkpoint read."""
    tracker = Tracker.load(running)
    before, scan = _state(tracker), frames[14].scan
    assert scan is not None
    for number in ("a", 1.5, True, np.zeros(2), 2**80, 10**5000):
        update = tracker.add_scan(scan, number)  # type: ignore[arg-type]
        assert update.refused == ("scan",) and "frame: found an index" in update.reason
    assert _state(tracker) == before
    assert not tracker.add_scan(scan, np.int64(14)).refused  # type: ignore[arg-type]


def test_what_a_program_has_set_for_floating_point_errors_does_not_count(
    running: Path, frames: list[Frame]
) -> None:
    usual, strict = Tracker.load(running), Tracker.load(running)
    for frame in frames[14:18]:
        expected = usual.add(frame)
        with np.errstate(all="raise"):
            update = strict.add(frame)
        assert update.to_dict() == expected.to_dict()


def test_one_sensor_s_data_are_refused_and_the_other_s_are_taken(running: Path, frames: list[Frame]) -> None:
    tracker, good = Tracker.load(running), frames[14]
    assert good.image is not None
    wrong = dataclasses.replace(good.image, mask=good.image.mask[:9])
    scans, images = tracker.inputs.window.place[1], len(tracker.inputs.window.images)
    update = tracker.add(Frame(14, good.scan, wrong))
    assert update.refused == ("image",) and not update.accepted and "camera's size" in update.reason
    assert tracker.inputs.window.place[1] == scans + 1 and len(tracker.inputs.window.images) == images


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("points", lambda s: s.points[:, :2], r"points: found shape \(\d+, 2\), expected \(n, 3\)"),
        ("points", lambda s: s.points * 1e6, "at most 100000 m"),
        ("points", lambda s: s.points[:0], "0 points"),
        ("points", lambda s: np.ma.masked_less(s.points, 0.0), "masked values"),
        ("left_out", lambda s: -(10**5000), "left_out: found an int of more than 40 digits"),
        ("classes", lambda s: s.classes[:-1], r"classes: found shape"),
        ("classes", lambda s: np.full(len(s.points), 77, np.uint8), "label 77"),
        ("instances", lambda s: s.instances[:5], r"instances: found shape \(5,\)"),
        ("offsets_s", lambda s: np.full(len(s.points), np.nan, np.float32), "NaN"),
        ("offsets_s", lambda s: np.full(len(s.points), 1.3e9), "at most 2 s after the stamp"),
        ("offsets_s", lambda s: np.zeros(7, np.float32), "point times: found shape"),
        ("rings", lambda s: np.full(len(s.points), -1), "numbers -1 to -1, expected 0 to 65535"),
        ("stamp_ns", lambda s: 1.5, "a stamp that is a float, expected whole nanoseconds"),
        ("stamp_ns", lambda s: 2**63, "146 years"),
    ],
)
def test_a_scan_s_flaw_is_named(
    frames: list[Frame], field: str, value: Callable[[Scan], Any], message: str
) -> None:
    scan = frames[0].scan
    assert scan is not None and scan.instances is not None
    with pytest.raises(DataError, match=message):
        checked_scan(dataclasses.replace(scan, **{field: value(scan)}))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("mask", lambda i: i.mask.T, "the camera's size"),
        ("mask", lambda i: np.ma.masked_equal(i.mask, i.mask[0, 0]), "masked values"),
        ("mask", lambda i: i.mask.astype(np.float32), "dtype float32"),
        ("mask", lambda i: i.mask.astype(np.int32) - 300, "labels -"),
        ("pixels", lambda i: i.pixels[..., 0], r"pixels: found shape .* in BGR"),
        ("pixels", lambda i: i.pixels.astype(np.float32), "dtype float32, expected uint8"),
        ("instances", lambda i: i.mask[:3].astype(np.uint16), "instances: found shape"),
        ("stretch", lambda i: b"x", "stretch: found a bytes, expected a PixelStretch"),
        ("stretch", lambda i: PixelStretch(np.ones((1, 4, 3), np.float32), 8), "at least 2 rows"),
        ("stretch", lambda i: PixelStretch(np.full((3, 4, 3), np.nan, np.float32), 8), "NaN or inf"),
        ("stretch", lambda i: PixelStretch(np.ones((3, 4, 3), np.float32), 0), "step_px: found 0"),
    ],
)
def test_an_image_s_flaw_is_named(
    street: SimulatedDrive, frames: list[Frame], field: str, value: Callable[[CameraImage], Any], message: str
) -> None:
    image = frames[0].image
    assert image is not None
    with pytest.raises(DataError, match=message):
        checked_image(dataclasses.replace(image, **{field: value(image)}), street.camera)


NOWHERE = gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": None}, "camera: found a NoneType, expected a PinholeCamera"),
        ({"camera": PinholeCamera(1e-3, 1e-3, 5.0, 5.0, 10, 10)}, "fx = 0.001 px"),
        ({"camera": PinholeCamera(10.0, 10.0, 50.0, 5.0, 10, 10)}, "cx = 50 px"),
        ({"camera": PinholeCamera(10.0, 10.0, 5.0, 5.0, 10**6, 10)}, "an image of 1000000x10 px"),
        ({"initial": np.eye(4)}, "initial: found a ndarray, expected a gtsam.Pose3"),
        ({"initial": NOWHERE}, "initial: found a value that is not finite"),
        ({"initial_time_offset_s": np.nan}, "initial time offset: found nan"),
        ({"initial_time_offset_s": 2**80}, "initial time offset: found 1.20893e"),
        ({"initial_time_offset_s": 10**400}, "initial time offset: found inf"),
        ({"config": CalibrationConfig()}, "expected a TrackerConfig"),
    ],
)
def test_a_tracker_is_made_of_a_camera_a_guess_and_settings(
    street: SimulatedDrive, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(SstGraphError, match=re.escape(message)):
        Tracker(**{"camera": street.camera, **change})


def test_wider_dtypes_and_other_orders_are_converted(street: SimulatedDrive, frames: list[Frame]) -> None:
    scan, image = frames[0].scan, frames[0].image
    assert scan is not None and image is not None
    assert np.shares_memory(checked_scan(scan).points, scan.points)  # no copy of what is right
    wide = dataclasses.replace(
        scan, points=np.asfortranarray(scan.points.astype(">f8")), classes=scan.classes.astype(np.int64)
    )
    checked = checked_scan(wide)
    assert checked.points.dtype == np.float32 and checked.points.flags.c_contiguous
    np.testing.assert_array_equal(checked.points, scan.points)
    np.testing.assert_array_equal(checked.classes, scan.classes)
    turned = dataclasses.replace(image, mask=np.asfortranarray(image.mask.astype(np.int16)))
    np.testing.assert_array_equal(checked_image(turned, street.camera).mask, image.mask)


@pytest.mark.parametrize(("method", "count"), [("joint", 12), ("edges", 5)])
@pytest.mark.slow
def test_arrays_may_be_filled_anew(
    street: SimulatedDrive, frames: list[Frame], method: Method, count: int, tmp_path: Path
) -> None:
    """As a driver does that has one buffer a sensor: estimates and checkpoints are those of arrays apart."""
    buffers: dict[tuple[type, str], Any] = {}

    def refilled(data: Any) -> Any:
        changed = {}
        for name, array in vars(data).items():
            if isinstance(array, np.ndarray):
                buffer = buffers.setdefault((type(data), name), np.zeros(2_000_000, array.dtype))
                changed[name] = buffer[: array.size].reshape(array.shape)
                changed[name][...] = array
        return dataclasses.replace(data, **changed)

    config = dataclasses.replace(EARLY_START, calibration=CalibrationConfig(method=method))
    apart, refilling = (Tracker(street.camera, config, street.nominal) for _ in range(2))
    for frame in frames[:count]:
        apart.add(frame)
        refilling.add(dataclasses.replace(frame, scan=refilled(frame.scan), image=refilled(frame.image)))
    for buffer in buffers.values():
        buffer[:] = 0
    for tracker, name in ((apart, "apart"), (refilling, "refilling")):
        tracker.save(tmp_path / name)
    assert (tmp_path / "apart").read_bytes() == (tmp_path / "refilling").read_bytes()


def test_one_slip_of_a_clock_is_refused_and_a_clock_that_was_set_is_not(
    running: Path, frames: list[Frame]
) -> None:
    """A stamp years ahead does not shut out what follows; one that stays elsewhere estimated again there."""
    tracker, year = Tracker.load(running), 365 * 86_400 * 10**9
    scans = [frame.scan for frame in frames[14:]]
    assert all(scan is not None for scan in scans)
    assert "by a day at most" in tracker.add_scan(_later(scans[0], year)).reason
    assert not tracker.add(frames[14]).refused
    updates = [tracker.add_scan(_later(scan, -year)) for scan in scans[1:9]]
    assert [bool(update.refused) for update in updates] == [True] * 4 + [False] * 4
    assert updates[4].alarm and "scan stamps moved by -31535999" in updates[4].reason
    assert not tracker.estimate.exists and len(tracker.inputs.window.scans) == 4


@pytest.mark.parametrize("guessed", [False, True])
def test_a_clock_that_is_set_before_the_first_estimate_is_no_alarm(
    street: SimulatedDrive, frames: list[Frame], guessed: bool
) -> None:
    """The guess stays what it was: none, where nothing was known."""
    guess = street.nominal if guessed else None
    tracker, day = Tracker(street.camera, initial=guess), 86_400 * 10**9
    updates = [tracker.add_scan(_later(frame.scan, -day * (frame.index >= 3))) for frame in frames[:8]]
    assert [bool(update.refused) for update in updates] == [False] * 3 + [True] * 4 + [False]
    assert "scan stamps moved by -86399" in updates[-1].reason
    assert not updates[-1].alarm and updates[-1].status == "starting"
    assert tracker.initializer.guess.cTl is guess
    assert (tracker.estimate.guessed_point is None) == (guess is None)


def _later(scan: Scan | None, by_ns: int) -> Scan:
    assert scan is not None
    return dataclasses.replace(scan, stamp_ns=scan.stamp_ns + by_ns)


@pytest.mark.slow
def test_a_scan_that_cannot_be_estimated_with_is_taken_back(running: Path, frames: list[Frame]) -> None:
    """Cars of a hair's breadth, on which every distance is the same: whatever stage fails, all is as it was.

    The smoother, the window, the odometry and all counters go on as if the scan had never come.
    """
    tracker, other = Tracker.load(running), Tracker.load(running)
    scan = frames[14].scan
    assert scan is not None
    before = _state(tracker)
    for broken in _hard_to_use(scan):
        update = tracker.add_scan(broken)
        if update.refused:
            assert _state(tracker) == before
        else:  # it was of use after all
            tracker = Tracker.load(running)
            before = _state(tracker)
    for frame in frames[14:18]:
        a, b = tracker.add(frame), other.add(frame)
        assert a.T_camera_lidar.equals(b.T_camera_lidar, 0.0) and a.time_offset_s == b.time_offset_s
        assert a.reason == b.reason and a.matches == b.matches


def _hard_to_use(scan: Scan) -> Iterator[Scan]:
    """Scans whose arrays are sound, and whose geometry is not."""
    rng = np.random.default_rng(0)
    n = len(scan.points)
    yield dataclasses.replace(scan, points=np.zeros((n, 3), np.float32))
    yield dataclasses.replace(scan, points=np.tile(scan.points[:1], (n, 1)))
    yield dataclasses.replace(scan, points=(scan.points * np.float32([1.0, 0.0, 0.0])))
    yield dataclasses.replace(scan, points=(scan.points * np.float32([1.0, 1.0, 0.0])))
    yield dataclasses.replace(scan, points=(scan.points * np.float32(1e3)))
    yield dataclasses.replace(scan, points=(scan.points * np.float32(1e-6)))
    yield dataclasses.replace(scan, points=rng.uniform(-1e5, 1e5, (n, 3)).astype(np.float32))
    yield dataclasses.replace(scan, classes=np.full(n, 1, np.uint8))
    yield dataclasses.replace(scan, classes=np.full(n, 255, np.uint8))
    yield dataclasses.replace(scan, instances=np.full(n, 65535, np.uint16))
    yield dataclasses.replace(scan, instances=(np.arange(n) % 60_000).astype(np.uint16))
    for few in (1, 2, 5, 50):
        yield Scan(scan.stamp_ns, scan.points[:few], scan.classes[:few])
    late = np.where(np.arange(n) % 2, 2.0, -2.0).astype(np.float32)
    yield dataclasses.replace(scan, offsets_s=late)
    yield dataclasses.replace(scan, rings=np.full(n, 65535, np.uint16))


def test_after_ten_failures_in_a_row_the_window_is_given_up(running: Path, frames: list[Frame]) -> None:
    """What is kept may be the reason: then it is given up, and the frames after it are taken again."""
    tracker = Tracker.load(running)
    smoother = tracker.estimate.smoother
    assert smoother is not None
    # A graph that no update can be solved with.
    smoother.past = dataclasses.replace(
        smoother.past, information=np.full_like(smoother.past.information, np.nan)
    )
    updates = [tracker.add_scan(frame.scan) for frame in frames[14:25]]
    assert all(update.refused == ("scan",) for update in updates[:10])
    assert "estimated again" in updates[9].reason and not updates[10].refused
    assert not tracker.estimate.exists


def test_ten_failures_before_the_first_estimate_leave_the_guess(
    street: SimulatedDrive, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise ValueError("no motion")

    monkeypatch.setattr(LidarOdometry, "add", fails)
    tracker = Tracker(street.camera)
    updates = [tracker.add_scan(frame.scan) for frame in frames[:10]]
    assert "estimated again" in updates[-1].reason
    assert tracker.initializer.guess.cTl is None and tracker.estimate.guessed_point is None


def test_a_tracker_still_works_after_all_that(running: Path, frames: list[Frame]) -> None:
    """Bad frames between good ones leave no trace: the estimates are those of the good ones alone."""
    tracker, clean, rng = Tracker.load(running), Tracker.load(running), np.random.default_rng(9)
    for k, frame in enumerate(frames[14:22]):
        wrong = _changed(rng, frame.scan, -1)  # type: ignore[arg-type]
        tracker.add_scan(wrong)
        tracker.add_image(_changed(rng, frame.image, -(2**61) + k))  # type: ignore[arg-type]
        a, b = tracker.add(frame), clean.add(frame)
        assert a.T_camera_lidar.equals(b.T_camera_lidar, 0.0) and a.time_offset_s == b.time_offset_s


def test_a_new_tracker_survives_bad_first_frames(street: SimulatedDrive, frames: list[Frame]) -> None:
    tracker, rng = Tracker(street.camera, initial=street.nominal), np.random.default_rng(5)
    for frame in _bad(rng, frames, 40):
        update = tracker.add(frame)
        assert tracker.estimate.exists == (update.status not in ("starting", "alarm"))


def test_what_readers_leave_out_is_carried_over(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Points that were left out are counted on; a picture may be missing; a batch's scan may be empty."""
    scan, image = frames[0].scan, frames[0].image
    assert scan is not None and image is not None
    assert checked_scan(dataclasses.replace(scan, left_out=3)).left_out == 3
    with pytest.raises(DataError, match="left_out"):
        checked_scan(dataclasses.replace(scan, left_out=-1))
    assert not checked_image(dataclasses.replace(image, pixels=NO_PICTURE), street.camera).has_picture
    empty = Scan(5, scan.points[:0], scan.classes[:0].astype(np.int64), left_out=2)
    assert checked_scan(empty, fewest=0) == Scan(5, scan.points[:0], scan.classes[:0], left_out=2)
    with pytest.raises(DataError, match="0 points, expected 1 to"):
        checked_scan(empty)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """The drive of that tracker."""
    return list(simulated(TRACKED_STREET))


def _frozen(frames: list[Frame], since: int, *sensors: str) -> list[Frame]:
    """The frames, from one on with the data of some sensors as they were in the frame before."""

    def again(frame: Frame) -> Frame:
        held = {}
        for sensor in sensors:
            last, own = getattr(frames[since - 1], sensor), getattr(frame, sensor)
            held[sensor] = dataclasses.replace(last, stamp_ns=own.stamp_ns)
        return dataclasses.replace(frame, **held)

    return [frame if frame.index < since else again(frame) for frame in frames]


@pytest.mark.parametrize("sensor", ["image", "scan"])
def test_a_frozen_sensor_is_named_and_moves_no_estimate(
    sensor: str, running: Path, frames: list[Frame]
) -> None:
    tracker = Tracker.load(running)
    before = tracker.estimate.point
    lines = [tracker.add(frame) for frame in _frozen(frames, 14, sensor)[14:]]
    assert len(lines) > 15
    assert all(
        line.refused == (sensor,) and f"a frozen {'camera' if sensor == 'image' else 'LiDAR'}" in line.reason
        for line in lines
    )
    # No alarm, and nothing that the sensor does not see is taken for a changed calibration.
    assert not any(line.alarm or line.suspected_change for line in lines)
    assert lines[-1].status != "ok" and lines[-1].unconfirmed_s > 1.0
    step = gtsam.Pose3.Logmap(before.cTl.between(tracker.estimate.point.cTl))
    assert (np.abs(step) < lines[-1].sigmas[:6]).all()
    # A result that ends so says why.
    assert f"a frozen {'camera' if sensor == 'image' else 'LiDAR'}" in tracker.result().reasons[-1]


def test_an_image_of_a_camera_ahead_ages_no_estimate(running: Path, frames: list[Frame]) -> None:
    """The time since the last scan is true time, whatever the camera's clock."""
    usual, ahead = Tracker.load(running), Tracker.load(running)
    smoother, image = ahead.estimate.smoother, frames[14].image
    assert smoother is not None and image is not None
    smoother.point = dataclasses.replace(smoother.point, time_offset_s=smoother.point.time_offset_s - 2.0)
    later = dataclasses.replace(image, stamp_ns=image.stamp_ns + 2_000_000_000)
    a, b = usual.add_image(image), ahead.add_image(later)
    assert b.stamp_ns == a.stamp_ns + 2_000_000_000
    assert b.unconfirmed_s == pytest.approx(a.unconfirmed_s) and b.status == a.status


def test_equal_frames_of_a_standing_vehicle_are_right(running: Path, frames: list[Frame]) -> None:
    tracker = Tracker(Tracker.load(running).setup.camera)
    assert not any(tracker.add(frame).refused for frame in _frozen(frames[:6], 1, "image", "scan"))
    # Pictures of one colour show nothing.
    black = [
        dataclasses.replace(
            f, image=f.image and dataclasses.replace(f.image, pixels=np.zeros_like(f.image.pixels))
        )
        for f in frames
    ]
    tracker = Tracker.load(running)
    assert all(tracker.add(frame).accepted for frame in black[14:20])


@pytest.mark.parametrize("side", ["image", "scan"])
def test_labels_that_are_missing_on_one_side_are_named(side: str, running: Path, frames: list[Frame]) -> None:
    def unlabelled(frame: Frame) -> Frame:
        assert frame.image is not None and frame.scan is not None
        if side == "image":
            return dataclasses.replace(
                frame, image=dataclasses.replace(frame.image, mask=np.zeros_like(frame.image.mask))
            )
        classes = np.zeros_like(frame.scan.classes)
        return dataclasses.replace(frame, scan=dataclasses.replace(frame.scan, classes=classes))

    tracker = Tracker.load(running)
    lines = [tracker.add(unlabelled(frame)) for frame in frames[14:30]]
    assert not any(line.alarm or line.suspected_change for line in lines)
    said, other = ("images", "scans") if side == "image" else ("scans", "images")
    expected = f"the latest 16 {said} without labels of objects, which the {other} have"
    assert lines[-1].reason.endswith(f"({expected})")
    assert lines[-1].unconfirmed_s > 1.0
    assert tracker.inputs.window.lacking_labels() == expected
    # With labels again, all is well.
    assert [tracker.add(frame).reason for frame in frames[30:33]][-1] == ""
    assert tracker.inputs.window.lacking_labels() == ""


@pytest.mark.parametrize("unit", ["s", "ns"])
def test_a_stamp_that_is_a_duration_of_numpy(running: Path, frames: list[Frame], unit: str) -> None:
    """To NumPy it is a whole number, which Python does not convert."""
    tracker, scan, image = Tracker.load(running), frames[14].scan, frames[14].image
    assert scan is not None and image is not None
    stamp: Any = np.timedelta64(1, unit)
    frame = Frame(14, dataclasses.replace(scan, stamp_ns=stamp), dataclasses.replace(image, stamp_ns=stamp))
    update = tracker.add(frame)
    assert set(update.refused) == {"image", "scan"}
    with pytest.raises(SstGraphError, match="fx of PinholeCamera: found"):
        PinholeCamera(stamp, 1.0, 1.0, 1.0, 8, 6)
