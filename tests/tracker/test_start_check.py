"""Steps among the frames of a start and right after it; what static objects alone determine."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from streets import knocked, tracker_from_truth

from sst_graph import Tracker
from sst_graph.simulator import SimulatedDrive
from sst_graph.tracker.monitor.change_detector import _KERNEL
from sst_graph.tracker.track_update import TrackUpdate, current_update
from sst_graph.tracker.uncertainty import Uncertainty
from sst_graph.types import Frame, SemanticClass

KNOCK_DEG = 1.5


def updates_of(
    street: SimulatedDrive, frames: list[Frame], step: int | None
) -> tuple[Tracker, list[TrackUpdate]]:
    """A tracker, which starts with the eighth frame, and its updates_of where the camera is knocked at
    one."""
    tracker, updates = tracker_from_truth(street), []
    for frame in frames:
        assert frame.image is not None
        late = step is not None and frame.index >= step
        image = knocked(frame.image, street, KNOCK_DEG) if late else frame.image
        updates.append(tracker.add(dataclasses.replace(frame, image=image)))
    return tracker, updates


@pytest.mark.parametrize("step", [4, 11])
@pytest.mark.slow
def test_a_knock_during_or_after_a_start_is_not_averaged(
    street: SimulatedDrive, frames: list[Frame], step: int
) -> None:
    """The start is given up within some frames, not ok before; the next one is of the frames since."""
    tracker, updates = updates_of(street, frames, step)
    given_up = [i for i, update in enumerate(updates) if "estimated again" in update.reason]
    assert given_up and step <= given_up[0] < step + 12 and len(given_up) <= 2
    assert not any(update.status == "ok" for update in updates[: given_up[0]])
    assert all(updates[i].status == "starting" and not updates[i].accepted for i in given_up)
    assert not any(update.alarm for update in updates)
    assert tracker.estimate.exists
    turned = gtsam.Rot3.Ry(np.radians(KNOCK_DEG)) * street.truth.cTl.rotation()
    off = np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(turned.between(tracker.estimate.point.cTl.rotation()))))
    assert off < 0.2


def test_quiet_frames_contradict_no_start(street: SimulatedDrive, frames: list[Frame]) -> None:
    _, updates = updates_of(street, frames[:26], None)
    assert not any("estimated again" in update.reason for update in updates)
    assert updates[7].accepted


@pytest.mark.slow
def test_labels_that_always_contradict_do_not_restart_for_ever(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """A limit that any frames are past: two starts are refused, the third stays."""
    tracker = tracker_from_truth(street)
    tracker.monitor.changes.start_threshold = 0.1
    updates = [tracker.add(frame) for frame in frames[:30]]
    assert sum("estimated again" in update.reason for update in updates) == 2
    assert tracker.estimate.exists


def _shifted(frame: Frame, street: SimulatedDrive, instance: int) -> Frame:
    """The image's labels around one vehicle are moved to the side, and all others as they are."""
    assert frame.image is not None and frame.scan is not None and frame.scan.instances is not None
    own = (frame.scan.classes == SemanticClass.VEHICLE) & (frame.scan.instances == instance)
    cTl = street.truth.cTl
    uvs = street.camera.project(frame.scan.points[own] @ cTl.rotation().matrix().T + cTl.translation())
    uvs = uvs[street.camera.in_image(uvs)]
    if not len(uvs):
        return frame
    (left, top), (right, bottom) = uvs.min(axis=0) - 10.0, uvs.max(axis=0) + 10.0
    mask = frame.image.mask.copy()
    box = (slice(max(0, int(top)), int(bottom)), slice(max(0, int(left)), int(right)))
    mask[box] = np.roll(frame.image.mask, 7, axis=1)[box]
    return dataclasses.replace(frame, image=dataclasses.replace(frame.image, mask=mask))


def test_a_start_is_confirmed_though_the_labels_of_one_vehicle_contradict_it(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """The others in the same frames would have shown a turn of the camera, and show none."""
    tracker, instance = tracker_from_truth(street), 34
    for frame in frames[:15]:
        tracker.add(_shifted(frame, street, instance) if 8 <= frame.index < 14 else frame)
    assert tracker.estimate.exists and not tracker.monitor.changes.start_unconfirmed
    # All together contradict it.
    changes, estimate = tracker.monitor.changes, tracker.estimate.for_comparison()
    moving = tracker.inputs.window.dynamics.recently_moving()
    pairs = changes.matcher.pairs_at(estimate.point, sorted(estimate.scans), _KERNEL)
    linearized = changes.matcher.linearized
    scores = {scan: linearized({scan: pair}, estimate.point, moving) for scan, pair in pairs.items()}
    assert changes._largest_of_parts(scores, estimate)[0] > changes.start_threshold


def test_what_only_moving_objects_determine_is_weak(street: SimulatedDrive, frames: list[Frame]) -> None:
    """One object of each pair counts half as static: static ones alone determine less, and decide."""
    tracker, _ = updates_of(street, frames[:20], None)
    assert tracker.estimate.smoother is not None
    assert (
        tracker.estimate.smoother.static_information() is None
        and tracker.estimate.uncertainty.by_static_objects is None
    )
    # 1. One object's matches count as those of a moving one.
    smoother = tracker.estimate.smoother
    for scan, entry in smoother.entries.items():
        seen = sorted(entry.linear.places)
        part = entry.linear.information.without(seen[:1])[0] if seen else entry.linear.information
        half = dataclasses.replace(part, information=0.5 * part.information)
        linear = dataclasses.replace(entry.linear, static=half)
        smoother.entries[scan] = dataclasses.replace(entry, linear=linear)
    alone, whole = smoother.static_information(), Uncertainty.of(smoother)
    assert alone is not None and whole.by_static_objects is not None
    assert np.linalg.eigvalsh(whole.by_static_objects - whole.covariance[:7, :7])[0] > -1e-9
    assert (np.diag(whole.by_static_objects) > 1.2 * np.diag(whole.covariance)[:7]).any()
    # 2. What they cannot separate is weak, though the whole covariance is small.
    good = np.diag(np.array([1e-3] * 3 + [0.01] * 3 + [0.0005]) ** 2)
    joint = dataclasses.replace(whole.joint, matrix=whole.joint.matrix.copy())
    joint.matrix[:7, :], joint.matrix[:, :7] = 0.0, 0.0
    joint.matrix[:7, :7] = good
    step = np.array([0.0, 0.0, 0.0, 0.06, 0.0, 0.0, 0.0075])
    for by_static_objects, weak in ((None, 0), (good, 0), (good + np.outer(step, step), 1)):
        tracker.estimate.uncertainty = Uncertainty(joint, 1.0, by_static_objects)
        update = current_update(tracker)
        assert len(update.weak_directions) == weak
        assert (update.status == "unobservable") == bool(weak)
    assert "by static objects alone" in update.weak_directions[0].sentence
