"""The tracker on a short simulated drive: start, refusals, retirement, checkpoint, alarm."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from streets import TRACKED_STREET

from sst_graph import Tracker, TrackerConfig
from sst_graph.data.simulator import SimulatedDrive, simulate
from sst_graph.errors import DataError, EstimationError
from sst_graph.estimators.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.estimators.epochs import Found
from sst_graph.estimators.history import HistoryEntry
from sst_graph.estimators.track_update import TrackUpdate
from sst_graph.estimators.tracker_config import AlarmConfig, DriftConfig
from sst_graph.estimators.tracker_result import tracker_result
from sst_graph.problem.graph import Tracks, associate, joint_graph, state_from
from sst_graph.problem.objects import object_tracks
from sst_graph.result import CalibrationResult
from sst_graph.types import CameraImage, Frame, SemanticClass
from sst_graph.uncertainty.covariance import robust_covariance
from sst_graph.uncertainty.gained import gained_of

CONFIG = TrackerConfig(start_scans=8)

STEP = 20
"""Frame from which on the calibration has changed, in the tests of that."""


@pytest.fixture(scope="module")
def street() -> SimulatedDrive:
    return simulate(TRACKED_STREET)


@pytest.fixture(scope="module")
def frames(street: SimulatedDrive) -> list[Frame]:
    return [street[i] for i in range(len(street))]


def _tracker(street: SimulatedDrive, config: TrackerConfig = CONFIG) -> Tracker:
    """A tracker that starts from the truth, so that no search is needed."""
    calibration = config.calibration
    start = dataclasses.replace(calibration.start, enabled=False)
    config = dataclasses.replace(config, calibration=dataclasses.replace(calibration, start=start))
    return Tracker(street.camera, config, street.truth.cTl, street.truth.time_offset_s or 0.0)


@pytest.fixture(scope="module")
def running(street: SimulatedDrive, frames: list[Frame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of a tracker after 20 frames."""
    tracker = _tracker(street)
    for frame in frames[:20]:
        tracker.add(frame)
    assert tracker.started
    path = tmp_path_factory.mktemp("tracker") / "tracker.npz"
    save_checkpoint(tracker, path)
    return path


def _distance(tracker: Tracker, cTl: gtsam.Pose3, offset_s: float) -> float:
    """Mahalanobis distance of the estimate from a calibration."""
    step = np.append(gtsam.Pose3.Logmap(tracker.point.cTl.between(cTl)), offset_s - tracker.point.offset_s)
    return float(np.sqrt(step @ np.linalg.solve(tracker.covariance[:7, :7], step)))


def test_from_the_first_frame_to_the_truth(street: SimulatedDrive, frames: list[Frame]) -> None:
    tracker = Tracker(street.camera, CONFIG, street.nominal)
    updates = [tracker.add(frame) for frame in frames]
    assert updates[0].status == "starting" and not updates[0].accepted
    assert updates[0].sigmas[6] == 1.0
    assert updates[-1].accepted and updates[-1].status in ("ok", "unobservable")
    assert updates[-1].sigmas[6] < 0.02
    assert not any(update.alarm for update in updates)
    assert (
        _distance(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0
    )  # chi-square of 7: 24


def test_the_covariance_is_the_batch_s(running: Path) -> None:
    tracker = load_checkpoint(running)
    tracker.settle()
    drive, _ = tracker.window.drive()
    state, config = tracker.point.state(tracker.classes), tracker.config.calibration.joint.graph
    tracks = object_tracks(drive)
    kernel = tracker.matcher.kernel
    pairs = associate([drive], Tracks([drive], [tracks]), state, kernel, config)
    graph, values = joint_graph(pairs, state, config)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    state = state_from(values, state, pairs)
    expected = robust_covariance(graph, values, pairs, state, [tracks]).matrix
    ratio = np.sqrt(np.diag(tracker.covariance)[:7] / np.diag(expected)[:7])
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)


def test_the_result_tells_what_each_scan_brought(running: Path) -> None:
    tracker = load_checkpoint(running)
    gained = gained_of(CalibrationResult.from_json(tracker_result(tracker, "drive").to_json()))
    assert gained is not None and gained.kind == "as they came"
    first, *rest = gained.gains
    assert first.bits is None and len(rest) > 5
    assert sum(gain.bits or 0.0 for gain in rest) > 3.0
    np.testing.assert_allclose(rest[-1].values, tracker.current().sigmas, rtol=1e-3)


def test_what_leaves_the_window_still_counts(street: SimulatedDrive, frames: list[Frame]) -> None:
    whole, short = _tracker(street), _tracker(street, dataclasses.replace(CONFIG, window=10))
    for frame in frames:
        whole.add(frame)
        short.add(frame)
    assert short.smoother is not None and whole.smoother is not None
    assert len(short.smoother.entries) <= 10 < len(whole.smoother.entries)
    assert _distance(whole, short.point.cTl, short.point.offset_s) < 2.5
    ratio = np.sqrt(np.diag(short.covariance) / np.diag(whole.covariance))
    assert ratio.min() > 0.7 and ratio.max() < 1.5


def test_bad_frames_leave_the_estimate(running: Path, frames: list[Frame]) -> None:
    tracker, good = load_checkpoint(running), frames[20]
    before = tracker.point
    assert good.scan is not None and good.image is not None
    points = good.scan.points.copy()
    points[3, 1] = np.nan
    wrong = [
        (Frame(20, None, None), "without scan and without image"),
        (Frame(20, dataclasses.replace(good.scan, stamp_ns=frames[3].scan.stamp_ns), None), "one after"),
        (Frame(20, dataclasses.replace(good.scan, points=points), None), "NaN"),
        (Frame(20, None, dataclasses.replace(good.image, mask=good.image.mask[:9])), "camera's size"),
        (Frame(20, None, frames[19].image), "second image"),
    ]
    for frame, message in wrong:
        update = tracker.add(frame)
        assert not update.accepted and message in update.reason
        assert tracker.point is before
    assert tracker.add(good).accepted


def test_images_and_scans_at_their_own_rates(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Every other image missing, and one late: all scans are used or say why."""
    tracker = _tracker(street)
    late = frames[10].image
    for frame in frames:
        if frame.index % 2 == 0 and frame.index != 10:
            assert tracker.add_image(frame.image).accepted
        update = tracker.add_scan(frame.scan)
        if frame.index == 12:
            assert tracker.add_image(late).accepted
    assert update.accepted
    assert _distance(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


def test_gaps_and_half_as_many_scans(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Scans at half the images' rate, and a second in which nothing comes."""
    tracker = _tracker(street, dataclasses.replace(CONFIG, start_scans=6, restart_scans=6))
    for frame in frames:
        if 20 <= frame.index < 29:
            continue
        scan = frame.scan if frame.index % 2 == 0 else None
        update = tracker.add(Frame(frame.index, scan, frame.image))
    assert tracker.started and update.status in ("ok", "unobservable")
    assert _distance(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


def test_what_comes_too_late_or_out_of_order_is_refused(running: Path, frames: list[Frame]) -> None:
    """An image that is late but not too late is sorted in; older ones, and any older scan, are refused."""
    tracker = load_checkpoint(running)
    before, images = tracker.point, [image.stamp_ns for image in tracker.window.images]
    old = frames[1].image
    assert old is not None and frames[10].scan is not None and frames[19].image is not None
    update = tracker.add_image(dataclasses.replace(old, stamp_ns=old.stamp_ns + 7))
    assert not update.accepted and "behind the newest scan" in update.reason and "1.5 s" in update.reason
    update = tracker.add_scan(frames[10].scan)
    assert not update.accepted and "one after" in update.reason
    assert tracker.point is before and [image.stamp_ns for image in tracker.window.images] == images
    between = dataclasses.replace(frames[19].image, stamp_ns=frames[19].image.stamp_ns - 30_000_000)
    assert tracker.add_image(between).accepted
    stamps = [image.stamp_ns for image in tracker.window.images]
    assert between.stamp_ns in stamps and stamps == sorted(stamps)


def test_an_update_that_fails_changes_nothing(running: Path, frames: list[Frame]) -> None:
    tracker = load_checkpoint(running)
    smoother = tracker.smoother
    assert smoother is not None
    scan, entry = next(iter(smoother.entries.items()))
    assert entry.pair.l_twist is not None
    broken = dataclasses.replace(entry.pair.l_twist, covariance=-np.eye(6))
    pair = dataclasses.replace(entry.pair, l_twist=broken)
    before, entries = smoother.point, dict(smoother.entries)
    with pytest.raises(EstimationError, match="covariance"):
        smoother.update({scan: Found(pair, entry.score, 0, entry.image)}, set(), 0)
    assert smoother.point is before and smoother.entries == entries
    assert tracker.add(frames[20]).accepted


def test_a_checkpoint_resumes_to_the_same_estimates(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    kept = _tracker(street)
    for frame in frames[:20]:
        kept.add(frame)
    save_checkpoint(kept, tmp_path / "tracker.npz")
    resumed = load_checkpoint(tmp_path / "tracker.npz")
    assert resumed.point.cTl.equals(kept.point.cTl, 1e-12)
    assert resumed.point.offset_s == kept.point.offset_s
    np.testing.assert_allclose(resumed.covariance, kept.covariance, rtol=1e-12)
    assert resumed.matcher.graph == kept.matcher.graph and kept.matcher.graph.undersides
    for (_, a), (_, b) in zip(resumed.window.scans, kept.window.scans, strict=True):
        assert {c: len(points) for c, points in a.undersides.items()} == {
            c: len(points) for c, points in b.undersides.items()
        }
    for frame in frames[20:]:
        kept.add(frame)
        resumed.add(frame)
    assert _distance(kept, resumed.point.cTl, resumed.point.offset_s) < 0.2


def test_an_object_matched_only_on_resuming_is_welcome(running: Path, frames: list[Frame]) -> None:
    """Matches are made anew at the saved estimate, where a doubtful object may gain one that it had not."""
    tracker = load_checkpoint(running)
    smoother = tracker.smoother
    assert smoother is not None
    point = smoother.point
    known = dataclasses.replace(point, tracks=point.tracks[:-1], object_biases_px=point.object_biases_px[:-1])
    tracker.resume(smoother, set(smoother.entries), known)
    assert set(smoother.point.tracks) == set(point.tracks)
    assert np.isfinite(tracker.covariance).all() and tracker.point.offset_s == point.offset_s
    assert tracker.add(frames[20]).accepted


def test_a_broken_checkpoint_is_named(tmp_path: Path, running: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        load_checkpoint(tmp_path / "none.npz")
    half = tmp_path / "half.npz"
    half.write_bytes(running.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"half\.npz: found no readable checkpoint"):
        load_checkpoint(half)


def _knocked(image: CameraImage, street: SimulatedDrive, degrees: float) -> CameraImage:
    """The image of a camera turned about its vertical axis."""
    K = street.camera.matrix
    R = gtsam.Rot3.Ry(np.radians(degrees)).matrix()
    H = K @ R @ np.linalg.inv(K)
    size = (street.camera.width, street.camera.height)
    mask = cv2.warpPerspective(image.mask, H, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return dataclasses.replace(image, mask=mask)


@pytest.mark.parametrize("kind", ["knock", "clock"])
def test_a_step_raises_the_alarm_and_is_learnt(
    street: SimulatedDrive, frames: list[Frame], kind: str
) -> None:
    """The camera is knocked, or its clock jumps: noticed within ten frames, though little is known yet."""
    tracker = _tracker(street, dataclasses.replace(CONFIG, alarm=AlarmConfig(warm_up=4)))
    alarms = []
    for frame in frames:
        image = frame.image
        assert image is not None
        if frame.index >= STEP and kind == "knock":
            image = _knocked(image, street, 1.5)
        elif frame.index >= STEP:
            image = dataclasses.replace(image, stamp_ns=image.stamp_ns + 100_000_000)
        update = tracker.add(dataclasses.replace(frame, image=image))
        if update.alarm:
            alarms.append(frame.index)
            assert update.status == "alarm" and not update.accepted
    assert len(alarms) == 1 and STEP <= alarms[0] < STEP + 10
    assert update.accepted and update.status != "alarm"
    if kind == "clock":
        assert _distance(tracker, street.truth.cTl, 0.03 - 0.1) < 6.0
    else:
        turned = gtsam.Rot3.Ry(np.radians(1.5)) * street.truth.cTl.rotation()
        off = gtsam.Rot3.Logmap(turned.between(tracker.point.cTl.rotation()))
        assert np.degrees(np.linalg.norm(off)) < 0.6


@pytest.mark.parametrize("jump_ms", [-30, 40])
def test_a_jump_in_the_first_seconds_raises_the_alarm(
    street: SimulatedDrive, frames: list[Frame], jump_ms: int
) -> None:
    """Two seconds after the start: noticed within ten frames though the estimate gives way, and learnt."""
    tracker = _tracker(street, dataclasses.replace(CONFIG, alarm=AlarmConfig(warm_up=4)))
    alarms = []
    for frame in frames[: STEP + 14]:
        assert frame.image is not None
        late = jump_ms * 1_000_000 if frame.index >= STEP else 0
        image = dataclasses.replace(frame.image, stamp_ns=frame.image.stamp_ns + late)
        alarms += [frame.index] if tracker.add(dataclasses.replace(frame, image=image)).alarm else []
    assert len(alarms) == 1 and STEP <= alarms[0] < STEP + 10
    assert tracker.started and tracker.watch.kept is None
    assert _distance(tracker, street.truth.cTl, 0.03 - 1e-3 * jump_ms) < 3.0


def test_a_knock_beyond_all_matches_is_a_step_too(street: SimulatedDrive, frames: list[Frame]) -> None:
    """The camera nods by 10 degrees: next to nothing meets the labels; it is looked for all around."""
    tracker = _tracker(street)
    K, R = street.camera.matrix, gtsam.Rot3.Rx(np.radians(10.0))
    size = (street.camera.width, street.camera.height)
    alarms = []
    for frame in frames:
        assert frame.image is not None
        mask = cv2.warpPerspective(
            frame.image.mask,
            K @ R.matrix() @ np.linalg.inv(K),
            size,
            flags=cv2.INTER_NEAREST,
            borderValue=255,
        )
        image = dataclasses.replace(frame.image, mask=mask) if frame.index >= STEP else frame.image
        alarms += [frame.index] if tracker.add(dataclasses.replace(frame, image=image)).alarm else []
    assert len(alarms) == 1 and STEP <= alarms[0] < STEP + 10
    assert tracker.guess.search and tracker.started
    error = (gtsam.Pose3(R, np.zeros(3)) * street.truth.cTl).between(tracker.point.cTl)
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(error.rotation()))) < 0.5


def _alone(frame: Frame, street: SimulatedDrive, instance: int) -> Frame:
    """One vehicle is all that is known, and the image's labels around it are moved to the side."""
    assert frame.image is not None and frame.scan is not None and frame.scan.instances is not None
    lPs = frame.scan.points[
        (frame.scan.classes == SemanticClass.VEHICLE) & (frame.scan.instances == instance)
    ]
    uvs = street.camera.project(lPs @ street.truth.cTl.rotation().matrix().T + street.truth.cTl.translation())
    (left, top), (right, bottom) = np.nanmin(uvs, axis=0) - 18.0, np.nanmax(uvs, axis=0) + 18.0
    mask = np.full_like(frame.image.mask, SemanticClass.IGNORE)
    box = (slice(max(0, int(top)), int(bottom)), slice(max(0, int(left)), int(right)))
    mask[box] = np.roll(frame.image.mask, 9, axis=1)[box]
    other = (frame.scan.classes == SemanticClass.VEHICLE) & (frame.scan.instances != instance)
    return dataclasses.replace(
        frame,
        image=dataclasses.replace(frame.image, mask=mask),
        scan=dataclasses.replace(
            frame.scan, classes=np.where(other, SemanticClass.IGNORE, frame.scan.classes)
        ),
    )


def test_what_one_object_alone_tells_is_a_doubt(street: SimulatedDrive, frames: list[Frame]) -> None:
    """One car is in view, and its labels are off: no alarm, but it does not go unsaid, and what was believed
    before is kept beside what the frames make of it."""
    tracker = _tracker(street, dataclasses.replace(CONFIG, alarm=AlarmConfig(warm_up=4)))
    scan, T = frames[STEP + 7].scan, street.truth.cTl
    assert scan is not None and scan.instances is not None
    uvs = street.camera.project(scan.points @ T.rotation().matrix().T + T.translation())
    in_view = (scan.classes == SemanticClass.VEHICLE) & street.camera.in_image(uvs)
    instance = int(np.bincount(scan.instances[in_view]).argmax())
    doubts, kept = [], []
    for frame in frames[: STEP + 6]:
        update = tracker.add(_alone(frame, street, instance) if frame.index >= STEP else frame)
        assert not update.alarm and not (update.doubt and update.adopted)
        doubts += [frame.index] if update.doubt else []
        kept += [tracker.watch.kept] if update.doubt else []
    assert doubts and min(doubts) >= STEP
    assert all(before is kept[0] for before in kept)
    assert kept[0] is not None and kept[0].scan <= doubts[0] and kept[0].point is not tracker.point


def test_drift_mode_tells_the_history(street: SimulatedDrive, frames: list[Frame]) -> None:
    drift = DriftConfig(enabled=True, epoch_s=0.5)
    tracker = _tracker(street, dataclasses.replace(CONFIG, window=10, drift=drift))
    for frame in frames:
        tracker.add(frame)
    history = tracker.history()
    assert len(history) >= 5
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(history))
    last = history[-1]
    assert _distance(tracker, last.cTl, last.time_offset_s) < 1.5
    steady = _tracker(street, dataclasses.replace(CONFIG, window=10))
    for frame in frames:
        steady.add(frame)
    assert np.diag(tracker.covariance)[:7].sum() > np.diag(steady.covariance)[:7].sum()


def test_a_slow_drift_is_followed(street: SimulatedDrive, frames: list[Frame]) -> None:
    """The camera yaws by 0.25 deg/s: the history follows within its sigmas, one calibration cannot."""
    drift = DriftConfig(enabled=True, epoch_s=0.5, rotation_deg=0.2)
    follows = _tracker(street, dataclasses.replace(CONFIG, window=10, drift=drift))
    steady = _tracker(street, dataclasses.replace(CONFIG, alarm=AlarmConfig(enabled=False)))
    start_ns = frames[0].scan.stamp_ns if frames[0].scan is not None else 0
    for frame in frames:
        assert frame.image is not None and frame.scan is not None
        yaw_deg = 0.25e-9 * (frame.scan.stamp_ns - start_ns)
        for tracker in (follows, steady):
            assert not tracker.add(
                dataclasses.replace(frame, image=_knocked(frame.image, street, yaw_deg))
            ).alarm
    errors = [_yaw_error(street, entry, 0.25e-9 * (entry.stamp_ns - start_ns)) for entry in follows.history()]
    assert len(errors) >= 5
    off, sigmas = np.array(errors).T
    assert np.abs(off).max() < 0.25 and np.mean(np.abs(off) < 2.5 * sigmas) > 0.8
    last_deg = 0.25e-9 * ((follows.window.last_stamp_ns or 0) - start_ns)
    at_end = [_yaw_error(street, tracker.current(), last_deg)[0] for tracker in (follows, steady)]
    assert abs(at_end[0]) < 0.5 * abs(at_end[1])


def _yaw_error(
    street: SimulatedDrive, found: HistoryEntry | TrackUpdate, yaw_deg: float
) -> tuple[float, float]:
    """Error about the camera's vertical axis, and its sigma [deg]."""
    cTl = found.cTl if isinstance(found, HistoryEntry) else found.T_camera_lidar
    truth = gtsam.Rot3.Ry(np.radians(yaw_deg)) * street.truth.cTl.rotation()
    axis = truth.matrix().T @ np.array([0.0, 1.0, 0.0])
    error = float(axis @ gtsam.Rot3.Logmap(truth.between(cTl.rotation())))
    sigma = float(np.sqrt(axis @ found.covariance[:3, :3] @ axis))
    return float(np.degrees(error)), float(np.degrees(sigma))
