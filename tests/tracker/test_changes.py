"""The calibration changes under the tracker: steps, suspected changes, drift."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated, stored
from streets import (
    EARLY_START,
    TRACKED_STREET,
    checkpoint_of,
    knocked,
    picked_frames,
    sigmas_apart,
    tracker_from_truth,
    turned,
)

from sst_graph import Tracker
from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.simulator import SimulatedDrive, simulate
from sst_graph.tracker.config import AlarmConfig, DriftConfig, TrackerConfig
from sst_graph.tracker.history import HistoryEntry
from sst_graph.tracker.monitor.confirmation import DETECTABLE_OFFSET_S, DETECTABLE_TURN_RAD, steps
from sst_graph.tracker.track_update import TrackUpdate, current_update, unconfirmed_sentences
from sst_graph.types import Frame, SemanticClass

STEP = 20
"""Frame from which on the calibration has changed."""
ALONE = 23
"""Frame from which on one vehicle is all that is known; the tracker takes it for a static one by then."""
CHECKED = 12
"""Frame from which on the start with the eighth frame has been checked against those that came after it."""

BY_LABELS = AlarmConfig(stamps=False)
"""A clock's jump is to be found by the labels alone."""


def _warmed_up(tracker: Tracker) -> Tracker:
    """The same, whose start counts as over soon: a contradiction is an alarm from then on."""
    tracker.monitor.changes.warm_up_scans = 4
    return tracker


def _at_step(config: TrackerConfig, folder: Path, warmed_up: bool = False) -> Tracker:
    """A tracker that has seen the frames before the step and raised no alarm, from its checkpoint."""
    prepare = _warmed_up if warmed_up else lambda tracker: tracker

    def make() -> bytes:
        drive = simulated(TRACKED_STREET)
        tracker = prepare(tracker_from_truth(drive, config))
        assert not any(tracker.add(drive[position]).alarm for position in range(STEP))
        return checkpoint_of(tracker)

    path = folder / "at_step.npz"
    path.write_bytes(stored((TRACKED_STREET, config, warmed_up, STEP), make))
    tracker = prepare(Tracker.load(path))
    tracker.initializer.work_per_frame = None
    return tracker


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["knock", "clock"])
def test_a_step_raises_the_alarm_and_is_estimated(
    street: SimulatedDrive, frames: list[Frame], kind: str
) -> None:
    """The camera is knocked, or its clock jumps: noticed within ten frames, though little is known yet."""
    tracker, alarms = _warmed_up(tracker_from_truth(street)), []
    for frame in frames:
        image = frame.image
        assert image is not None
        if frame.index >= STEP and kind == "knock":
            image = knocked(image, street, 1.5)
        elif frame.index >= STEP:
            image = dataclasses.replace(image, stamp_ns=image.stamp_ns + 100_000_000)
        update = tracker.add(dataclasses.replace(frame, image=image))
        if update.alarm:
            alarms.append(frame.index)
            assert update.status == "alarm" and not update.accepted
    assert len(alarms) == 1 and STEP <= alarms[0] < STEP + 10
    assert update.accepted and update.status != "alarm"
    if kind == "clock":
        assert sigmas_apart(tracker, street.truth.cTl, 0.03 - 0.1) < 6.0
    else:
        turned = gtsam.Rot3.Ry(np.radians(1.5)) * street.truth.cTl.rotation()
        off = gtsam.Rot3.Logmap(turned.between(tracker.estimate.point.cTl.rotation()))
        assert np.degrees(np.linalg.norm(off)) < 0.6


def jumped(folder: Path, frames: list[Frame], jump_ms: int) -> tuple[Tracker, list[TrackUpdate]]:
    """A tracker after frames whose images have other stamps from the step on, and its answers to these."""
    tracker = _at_step(dataclasses.replace(EARLY_START, alarm=BY_LABELS), folder, warmed_up=True)
    updates = []
    for frame in frames[STEP:]:
        assert frame.image is not None
        image = dataclasses.replace(frame.image, stamp_ns=frame.image.stamp_ns + jump_ms * 1_000_000)
        updates.append(tracker.add(dataclasses.replace(frame, image=image)))
    return tracker, updates


@pytest.mark.parametrize("jump_ms", [-40, 40])
@pytest.mark.slow
def test_a_jump_in_the_first_seconds_raises_the_alarm(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path, jump_ms: int
) -> None:
    """Soon after the start: noticed by the labels within ten frames, though the estimate follows."""
    tracker, updates = jumped(tmp_path, frames[: STEP + 14], jump_ms)
    alarms = [i for i, update in enumerate(updates) if update.alarm]
    assert len(alarms) == 1 and alarms[0] < 10
    assert tracker.estimate.exists and tracker.monitor.changes.reference is None
    assert sigmas_apart(tracker, street.truth.cTl, 0.03 - 1e-3 * jump_ms) < 3.0


@pytest.mark.parametrize("jump_ms", [-30, 30])
@pytest.mark.slow
def test_a_smaller_jump_in_the_first_seconds_is_not_silent(
    frames: list[Frame], tmp_path: Path, jump_ms: int
) -> None:
    """With one object left out the others may show too little for an alarm so early: it is suspected then."""
    _, updates = jumped(tmp_path, frames[: STEP + 10], jump_ms)
    assert any(update.alarm or update.suspected_change for update in updates)


@pytest.mark.parametrize(
    ("sensor", "jump_ms"), [("image", -30), ("image", 30), ("scan", 30), ("image", -200)]
)
@pytest.mark.slow
def test_stamps_that_jump_against_their_interval_are_an_alarm(
    frames: list[Frame], tmp_path: Path, sensor: str, jump_ms: int
) -> None:
    """Noticed within six frames though nothing in view shows it; estimated from what comes into view."""
    tracker, updates = _at_step(EARLY_START, tmp_path), []
    for frame in frames[STEP:]:
        assert frame.image is not None and frame.scan is not None
        image, scan, late = frame.image, frame.scan, jump_ms * 1_000_000
        if sensor == "image":
            image = dataclasses.replace(image, stamp_ns=image.stamp_ns + late)
        else:
            scan = dataclasses.replace(scan, stamp_ns=scan.stamp_ns + late)
        if frame.index < STEP + 6:
            image = dataclasses.replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE))
        updates.append(tracker.add(dataclasses.replace(frame, image=image, scan=scan)))
    alarms = [i for i, update in enumerate(updates) if update.alarm]
    assert len(alarms) == 1 and alarms[0] < 6
    alarm = updates[alarms[0]]
    assert f"{sensor} stamps jumped" in alarm.reason and alarm.status == "alarm"
    assert alarm.chi2 is not None and alarm.chi2 > tracker.setup.config.alarm.chi2
    time_offset_s = 0.03 + (-1e-3 if sensor == "image" else 1e-3) * jump_ms
    assert (
        tracker.estimate.exists
        and abs(updates[-1].time_offset_s - time_offset_s) < 2.0 * updates[-1].sigmas[6] < 0.03
    )


@pytest.mark.parametrize("jump_s", [-2.0, -3600.0])
def test_a_camera_clock_that_was_set_back_is_an_alarm(
    frames: list[Frame], tmp_path: Path, jump_s: float
) -> None:
    """Its images are farther behind than late ones may be; the fifth shows that the clock was set."""
    tracker, updates = _at_step(EARLY_START, tmp_path), []
    for frame in frames[STEP:]:
        assert frame.image is not None
        image = dataclasses.replace(frame.image, stamp_ns=frame.image.stamp_ns + round(1e9 * jump_s))
        updates.append(tracker.add(dataclasses.replace(frame, image=image)))
    assert [update.refused for update in updates[:6]] == [("image",)] * 4 + [()] * 2
    alarms = [i for i, update in enumerate(updates) if update.alarm]
    assert len(alarms) == 1 and alarms[0] < 8
    assert f"image stamps jumped by {1e3 * jump_s:+.0f} ms" in updates[alarms[0]].reason
    assert tracker.estimate.exists and abs(updates[-1].time_offset_s - 0.03 + jump_s) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("clock_set", [False, True])
def test_a_camera_that_paused_is_told_from_a_clock_that_was_set(clock_set: bool) -> None:
    """The stamps of both jump alike; what is in view is where the time offset has it, or is not."""
    fast = simulate(dataclasses.replace(TRACKED_STREET, frames=84, frame_rate_hz=28.95))
    tracker, alarms = _warmed_up(tracker_from_truth(fast)), []
    for frame in picked_frames(fast, 28, STEP, clock_set):
        update = tracker.add(frame)
        alarms += [update] if update.alarm else []
    assert len(alarms) == clock_set
    if not clock_set:
        assert update.status == "ok" and tracker.estimate.starts == 1
        assert len(tracker.inputs.window.images) >= 28 and update.matches > 5000
        assert sigmas_apart(tracker, fast.truth.cTl, 0.03) < 4.3  # 99 % of seven unknowns


def test_a_jump_before_the_start_empties_the_window(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Frames from before it are of another time offset."""
    tracker = tracker_from_truth(street, dataclasses.replace(EARLY_START, start_scans=30))
    for frame in frames[: STEP + 5]:
        assert frame.image is not None
        late = 30_000_000 if frame.index >= STEP else 0
        image = dataclasses.replace(frame.image, stamp_ns=frame.image.stamp_ns + late)
        update = tracker.add(dataclasses.replace(frame, image=image))
    assert not tracker.estimate.exists and not update.alarm and "jumped by +30 ms" in update.reason
    assert (
        tracker.inputs.window.first_scan == STEP
        and len(tracker.inputs.window.scans) == tracker.initializer.waited == 5
    )
    assert len(tracker.inputs.window.images) == 5


def test_a_knock_beyond_all_matches_is_a_step_too(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    """The camera nods by 10 degrees: next to nothing meets the labels; it is looked for all around."""
    tracker = _at_step(EARLY_START, tmp_path)
    R, alarms = gtsam.Rot3.Rx(np.radians(10.0)), []
    for frame in frames[STEP:]:
        assert frame.image is not None
        image = turned(frame.image, street, R, borderValue=255)
        alarms += [frame.index] if tracker.add(dataclasses.replace(frame, image=image)).alarm else []
    assert len(alarms) == 1 and STEP <= alarms[0] < STEP + 10
    assert tracker.initializer.guess.search and tracker.estimate.exists
    error = (gtsam.Pose3(R, np.zeros(3)) * street.truth.cTl).between(tracker.estimate.point.cTl)
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
    mask[box] = np.roll(frame.image.mask, 8, axis=1)[box]
    other = (frame.scan.classes == SemanticClass.VEHICLE) & (frame.scan.instances != instance)
    return dataclasses.replace(
        frame,
        image=dataclasses.replace(frame.image, mask=mask),
        scan=dataclasses.replace(
            frame.scan, classes=np.where(other, SemanticClass.IGNORE, frame.scan.classes)
        ),
    )


def _largest(frame: Frame, street: SimulatedDrive) -> int:
    """The vehicle with most points in view."""
    scan, T = frame.scan, street.truth.cTl
    assert scan is not None and scan.instances is not None
    uvs = street.camera.project(scan.points @ T.rotation().matrix().T + T.translation())
    in_view = (scan.classes == SemanticClass.VEHICLE) & street.camera.in_image(uvs)
    return int(np.bincount(scan.instances[in_view]).argmax())


@pytest.mark.slow
def test_what_one_object_alone_contradicts_is_suspected(street: SimulatedDrive, frames: list[Frame]) -> None:
    """One car is in view, and its labels are off: no alarm, but it is reported, and the estimate from before
    is kept as the reference."""
    tracker = _warmed_up(tracker_from_truth(street))
    instance = _largest(frames[STEP + 7], street)
    suspected, kept = [], []
    for frame in frames[: ALONE + 6]:
        update = tracker.add(_alone(frame, street, instance) if frame.index >= ALONE else frame)
        assert not update.alarm and not (update.suspected_change and update.adopted)
        suspected += [frame.index] if update.suspected_change else []
        kept += [tracker.monitor.changes.reference] if update.suspected_change else []
    assert suspected and min(suspected) >= ALONE
    assert all(before is kept[0] for before in kept)
    assert (
        kept[0] is not None and kept[0].scan <= suspected[0] and kept[0].point is not tracker.estimate.point
    )


def _sure_tracker(street: SimulatedDrive) -> Tracker:
    """A tracker that calls any estimate observable."""
    limits = ObservabilityConfig(rotation_deg=90.0, translation_m=10.0, time_offset_s=10.0)
    calibration = dataclasses.replace(EARLY_START.calibration, observability=limits)
    return tracker_from_truth(street, dataclasses.replace(EARLY_START, calibration=calibration))


@pytest.mark.slow
def test_no_estimate_is_ok_while_the_latest_frames_contradict_it(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """From the second such frame on, and where the newest alone does, not only from the alarm or from a
    suspected change."""
    tracker, before, past, alone = _warmed_up(_sure_tracker(street)), list[int](), 0, list[int]()
    for frame in frames[: STEP + 8]:
        assert frame.image is not None
        image = knocked(frame.image, street, 0.5) if frame.index >= STEP else frame.image
        update = tracker.add(dataclasses.replace(frame, image=image))
        past = past + 1 if (update.chi2 or 0.0) > tracker.setup.config.alarm.chi2 else 0
        newest = tracker.monitor.changes.statistic.newest > tracker.setup.config.alarm.chi2
        alone += [frame.index] if newest and past < 2 else []
        if (past > 1 or newest) and not update.alarm:
            assert update.status == "unconfirmed" and not update.adopted
            assert update.unconfirmed_reason.startswith("the latest frames contradict the estimate")
            before.append(frame.index)
            assert "contradict the estimate" in tracker.result().reasons[0]
    assert before and before[0] >= STEP and alone


@pytest.mark.slow
def test_a_knock_that_no_frame_can_show_is_not_ok(
    street: SimulatedDrive, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that is in view moves from then on: no alarm can be raised, and the status says so."""
    tracker, ages = _sure_tracker(street), []
    for frame in frames:
        assert frame.image is not None
        image = frame.image
        if frame.index == STEP:
            dynamics, live = tracker.inputs.window.dynamics, tracker.inputs.window.objects.live
            monkeypatch.setattr(dynamics, "recently_moving", lambda live=live: set(live))
        if frame.index >= STEP:
            image = knocked(image, street, 1.5)
        update = tracker.add(dataclasses.replace(frame, image=image))
        ages.append(update.unconfirmed_s)
        assert not update.alarm and not (update.adopted and frame.index > STEP + 10)
        if CHECKED <= frame.index < STEP:
            assert update.status != "unconfirmed"
    assert ages[STEP - 1] == 0.0
    np.testing.assert_allclose(np.diff(ages[STEP - 1 :]), 0.1036, atol=2e-3)
    assert update.status == "unconfirmed" and update.to_dict()["unconfirmed_s"] > 1.0
    assert update.unconfirmed_reason.startswith("no frame would have shown a change")
    assert f"for the last {update.unconfirmed_s:.1f} s" in update.unconfirmed_reason
    assert tracker.result().status == "not_converged"
    assert "no frame would have shown" in tracker.result().reasons[0]


@pytest.mark.slow
def test_frames_that_show_nothing_let_the_estimate_age(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    """The image's labels are missing for a while; when they are back, the estimate is confirmed again."""
    tracker, status = _sure_tracker(street), []
    for frame in frames:
        assert frame.image is not None
        image = frame.image
        if STEP <= frame.index < STEP + 12:
            image = dataclasses.replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE))
        update = tracker.add(dataclasses.replace(frame, image=image))
        status.append(update.status)
        if frame.index == STEP + 5:
            tracker.save(tmp_path / "tracker.npz")
            resumed = current_update(Tracker.load(tmp_path / "tracker.npz"))
            assert resumed.unconfirmed_s == update.unconfirmed_s > 0.5
            assert resumed.time_offset_unconfirmed_s == update.time_offset_unconfirmed_s > 0.5
    assert status[CHECKED - 5 : CHECKED] == ["unconfirmed"] * 5
    assert "unconfirmed" not in status[CHECKED : STEP + 8]
    assert status[STEP + 11] == "unconfirmed"
    assert status[-1] == "ok" and update.unconfirmed_s == 0.0


@pytest.mark.slow
def test_frames_confirm_together_what_four_do_not_show(street: SimulatedDrive, frames: list[Frame]) -> None:
    """A threshold that a turn by 0.25 degrees passes in the latest 20 scans, but not in four."""
    config = dataclasses.replace(EARLY_START, alarm=AlarmConfig(chi2=130.0))
    tracker = tracker_from_truth(street, config)
    for frame in frames[:30]:
        update = tracker.add(frame)
    changes, point = tracker.monitor.changes, tracker.estimate.point
    tried = steps(point.cTl, DETECTABLE_TURN_RAD, DETECTABLE_OFFSET_S)
    assert changes.statistic.latest is not None
    assert not changes.statistic.detectable(changes.statistic.latest, tried)[1]
    assert update.unconfirmed_s == 0.0


@pytest.mark.parametrize("missing", ["empty", "none"])
@pytest.mark.slow
def test_without_scans_the_estimate_ages(street: SimulatedDrive, frames: list[Frame], missing: str) -> None:
    """The LiDAR delivers empty scans for a while, or none: nothing changes, but time passes."""
    tracker, status = _sure_tracker(street), []
    for frame in frames[: STEP + 16]:
        assert frame.scan is not None
        dead = STEP <= frame.index < STEP + 12
        none = {name: value[:0] for name, value in vars(frame.scan).items() if isinstance(value, np.ndarray)}
        scan = dataclasses.replace(frame.scan, **none) if missing == "empty" else None
        update = tracker.add(dataclasses.replace(frame, scan=scan) if dead else frame)
        status.append(update.status)
        if frame.index == STEP + 11:
            assert 1.1 < update.unconfirmed_s < 1.4
    assert status[STEP - 1] == status[STEP] == "ok"
    assert status[STEP + 11] == "unconfirmed"


@pytest.mark.slow
def test_a_suspected_change_that_is_given_up_is_no_confirmation(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """The estimate has followed the one object by then; that they agree confirms nothing."""
    tracker = _warmed_up(_sure_tracker(street))
    tracker.monitor.changes.max_pending = 5
    instance = _largest(frames[STEP + 7], street)
    for frame in frames[: ALONE + 12]:
        update = tracker.add(_alone(frame, street, instance) if frame.index >= ALONE else frame)
    assert tracker.monitor.changes.confirmation.unreliable and not tracker.monitor.changes.reference
    assert update.status == "unconfirmed"


@pytest.mark.slow
def test_drift_mode_keeps_the_history(street: SimulatedDrive, frames: list[Frame]) -> None:
    drift = DriftConfig(enabled=True)
    tracker = tracker_from_truth(street, dataclasses.replace(EARLY_START, window=10, drift=drift))
    for frame in frames:
        tracker.add(frame)
    history = tracker.estimate.history()
    assert len(history) >= 4
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(history))
    last = history[-1]
    assert sigmas_apart(tracker, last.cTl, last.time_offset_s) < 1.5
    steady = tracker_from_truth(street, dataclasses.replace(EARLY_START, window=10))
    for frame in frames:
        steady.add(frame)
    assert np.diag(tracker.estimate.covariance)[:7].sum() > np.diag(steady.estimate.covariance)[:7].sum()


@pytest.mark.slow
def test_a_slow_drift_is_followed(street: SimulatedDrive, frames: list[Frame]) -> None:
    """The camera yaws by 0.25 deg/s: the history follows within its sigmas, one calibration cannot."""
    drift = DriftConfig(enabled=True, rotation_deg=0.2)
    follows = tracker_from_truth(street, dataclasses.replace(EARLY_START, window=10, drift=drift))
    steady = tracker_from_truth(street, dataclasses.replace(EARLY_START, alarm=AlarmConfig(enabled=False)))
    start_ns = frames[0].scan.stamp_ns if frames[0].scan is not None else 0
    for frame in frames:
        assert frame.image is not None and frame.scan is not None
        yaw_deg = 0.25e-9 * (frame.scan.stamp_ns - start_ns)
        for tracker in (follows, steady):
            assert not tracker.add(
                dataclasses.replace(frame, image=knocked(frame.image, street, yaw_deg))
            ).alarm
    errors = [
        _yaw_error(street, entry, 0.25e-9 * (entry.stamp_ns - start_ns))
        for entry in follows.estimate.history()
    ]
    assert len(errors) >= 4
    off, sigmas = np.array(errors).T
    assert np.abs(off).max() < 0.25 and np.mean(np.abs(off) < 2.5 * sigmas) > 0.8
    last_deg = 0.25e-9 * ((follows.inputs.window.last_stamp_ns or 0) - start_ns)
    at_end = [_yaw_error(street, current_update(tracker), last_deg)[0] for tracker in (follows, steady)]
    assert abs(at_end[0]) < 0.5 * abs(at_end[1])


@pytest.mark.slow
def test_a_new_epoch_is_less_sure_by_the_walk_alone(street: SimulatedDrive, frames: list[Frame]) -> None:
    """The running covariance is that of the history, which adds epoch to epoch."""
    drift = DriftConfig(enabled=True, rotation_deg=0.5)
    tracker = tracker_from_truth(street, dataclasses.replace(EARLY_START, window=10, drift=drift))
    ratios = []
    for frame in frames:
        update = tracker.add(frame)
        if update.covariance is not None and len(history := tracker.estimate.history()) > 1:
            ratios.append(np.sqrt(np.diag(update.covariance) / np.diag(history[-1].covariance)))
    assert len(ratios) > 15 and np.min(ratios) > 0.8 and np.max(ratios) < 1.25


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


@pytest.mark.slow
def test_labels_of_most_objects_that_are_missing_are_no_change(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """Left are those of the object that covers least of the image, as where a network knows no cars."""

    def left(frame: Frame) -> Frame:
        image = frame.image
        assert image is not None and image.instances is not None
        counts = np.bincount(image.instances[image.mask == SemanticClass.VEHICLE])
        seen = np.flatnonzero(counts)
        kept = seen[np.argmin(counts[seen])] if len(seen) else 0
        gone = (image.mask == SemanticClass.VEHICLE) & (image.instances != kept)
        mask = np.where(gone, np.uint8(SemanticClass.GROUND), image.mask)
        return dataclasses.replace(frame, image=dataclasses.replace(image, mask=mask))

    tracker = tracker_from_truth(street)
    lines = [tracker.add(frame if frame.index < 20 else left(frame)) for frame in frames]
    assert not any(line.alarm for line in lines)
    assert "are missing" in lines[-1].suspected_change and lines[-1].status != "ok"


@pytest.mark.slow
def test_a_scan_without_match_is_not_compared_again_when_its_turn_comes(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    tracker = tracker_from_truth(street)
    for frame in frames:
        tracker.add(frame)
    changes, compared = tracker.monitor.changes, tracker.estimate.for_comparison()
    known, latest = list(changes.scans), changes.statistic.latest
    old = tracker.inputs.window.next_scan - 25
    assert old not in known
    assert changes.check([old], {old: 100}, compared) is None
    assert list(changes.scans) == known and changes.statistic.latest is latest


def test_a_suspected_change_is_said_once_beside_why_nothing_confirms_the_estimate() -> None:
    def said(reason: str, change: str) -> tuple[str, ...]:
        update = TrackUpdate(0, gtsam.Pose3(), 0.0, None, "unconfirmed", True)
        return unconfirmed_sentences(
            dataclasses.replace(update, unconfirmed_reason=reason, suspected_change=change)
        )

    assert said("", "") == () and said("too old", "") == ("too old",) and said("", "one car") == ("one car",)
    assert said("contradicted: one car", "one car") == ("contradicted: one car",)
    assert said("too old", "one car") == ("too old", "one car")
