"""Frames without labels in the tracker: what is kept of them, what edges add to a covariance, and what a
drive ends at."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from layouts import without_label_files
from stored import simulated
from streets import TRACKED_STREET

from sst_graph import CalibrationConfig, Tracker, TrackerConfig, open_source
from sst_graph.association.edge_matching import MatchConfig
from sst_graph.batch.by_edges.problem import POINTS_A_SCAN
from sst_graph.cli import main
from sst_graph.experiments.starts import error_of, errors_of
from sst_graph.factors.alignment import weighted_residuals
from sst_graph.features.picture_gradients import PictureGradients
from sst_graph.fit import EDGE_BIAS, MASK_BIAS
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.state import State
from sst_graph.hand_eye.graph import camera_steps
from sst_graph.result import CalibrationResult, read_result
from sst_graph.tracker.by_edges.review import EdgeReview, variance_ratio
from sst_graph.tracker.estimate import OnlineEstimate
from sst_graph.tracker.start.first_estimate import FirstEstimate
from sst_graph.tracker.start.initializer import InitialGraph
from sst_graph.tracker.sums.held import EDGE_ERRORS, SHIFTS, edge_error_columns, held_names
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass, Source
from studies.edges_streets import source_of, start_step

VEHICLE, OBJECT, IGNORE = SemanticClass.VEHICLE, SemanticClass.OBJECT, int(SemanticClass.IGNORE)
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FRAMES = 8


def no_mask(image: CameraImage) -> CameraImage:
    return dataclasses.replace(image, mask=np.full_like(image.mask, IGNORE), instances=None)


def no_classes(scan: Scan) -> Scan:
    return dataclasses.replace(scan, classes=np.full_like(scan.classes, IGNORE), instances=None)


def without_labels(frame: Frame) -> Frame:
    assert frame.scan is not None and frame.image is not None
    return dataclasses.replace(frame, scan=no_classes(frame.scan), image=no_mask(frame.image))


def config(method: str, **further: int) -> TrackerConfig:
    return TrackerConfig(calibration=CalibrationConfig(method=method), **further)  # type: ignore[arg-type]


def begun(method: str, labelled: int, **further: int) -> Tracker:
    """A tracker that goes on from the truth over some frames, the first of them with labels.

    A start on so few frames is not what is tested: the graph is made at the truth.
    """
    street = simulated(TRACKED_STREET)
    tracker = Tracker(
        street.camera, config(method, **further), street.truth.cTl, street.truth.time_offset_s or 0.0
    )
    tracker.initializer.work = lambda matcher: None  # type: ignore[method-assign]
    for position in range(FRAMES):
        frame = street[position]
        tracker.add(frame if position < labelled else without_labels(frame))
    del tracker.initializer.work
    point = tracker.initializer.guess.point(tracker.matcher.classes)
    known = KnownCalibration(
        State(point.cTl.retract(np.array([0.3, 0, 0, 0, 0, 0])), (point.time_offset_s,)),
        np.diag(np.square([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 1.0])),
    )
    first = FirstEstimate(point, known, reviewed=False)
    numbers = [number for number, _ in tracker.inputs.window.scans]
    tracker.initializer.graph = InitialGraph(first, numbers, tracker.initializer.config)
    made = tracker.initializer._made(tracker.matcher, None)
    assert made is not None
    tracker.estimate.begin(made)
    tracker.initializer.succeeded()
    tracker.monitor.begin(tracker.inputs.window.next_scan)
    return tracker


@cache
def by_edges() -> Tracker:
    return begun("edges", 0)


def test_classes_by_method() -> None:
    assert config("edges").estimating.calibration.classes == (OBJECT,)
    assert config("both").estimating.calibration.classes == (VEHICLE, OBJECT)
    for method in ("auto", "joint"):
        assert config(method).estimating.calibration.classes == (VEHICLE,)


def test_what_is_kept_of_frames_without_labels() -> None:
    window = by_edges().inputs.window
    for _, scan in window.scans:
        assert set(scan.boundaries) == {OBJECT} and 0 < len(scan.boundaries[OBJECT]) <= POINTS_A_SCAN
    assert all(isinstance(image.contours[OBJECT], PictureGradients) for image in window.images)
    assert len(window.image_pairs) == FRAMES - 1


def test_labels_are_not_read_by_method_edges() -> None:
    labelled, bare = begun("edges", FRAMES), by_edges()
    for (_, one), (_, other) in zip(labelled.inputs.window.scans, bare.inputs.window.scans, strict=True):
        np.testing.assert_array_equal(one.boundaries[OBJECT].lPs, other.boundaries[OBJECT].lPs)
    assert set(labelled.inputs.window.images[0].contours) == {OBJECT}


def test_images_are_bounded_where_no_scan_comes() -> None:
    street = simulated(dataclasses.replace(TRACKED_STREET, frames=1, width=124, height=38))
    tracker = Tracker(street.camera, config("edges"), street.truth.cTl)
    image = without_labels(street[0]).image
    assert image is not None
    for k in range(103):
        late = dataclasses.replace(image, stamp_ns=image.stamp_ns + k * 1_000_000)
        tracker.add_image(late)
    assert len(tracker.inputs.window.images) == 100


def test_the_graph_is_linearized_where_its_matches_were_made() -> None:
    """The prior's mean is 17 degrees away: there no edge would have a weight."""
    tracker = by_edges()
    assert tracker.estimate.smoother is not None and tracker.estimate.smoother.begun
    step = tracker.setup.initial.localCoordinates(tracker.estimate.point.cTl)  # type: ignore[union-attr]
    assert np.degrees(np.linalg.norm(step[:3])) < 1.0 and np.linalg.norm(step[3:]) < 0.2


def test_edges_decide_where_they_are_alone() -> None:
    """The estimate follows a shift that all edges see, but for what the prior holds."""
    share = by_edges().estimate.uncertainty.edge_share
    assert share.shape == (7, 7)
    np.testing.assert_allclose(np.diag(share)[:3], 1.0, atol=0.02)


def test_scans_that_leave_the_window_keep_what_edges_share() -> None:
    tracker, street = begun("edges", 0, window=FRAMES, start_scans=4), simulated(TRACKED_STREET)
    for position in range(FRAMES, FRAMES + 6):
        update = tracker.add(without_labels(street[position]))
        assert update.accepted and update.status != "starting"
    smoother = tracker.estimate.smoother
    assert smoother is not None and len(smoother.entries) <= FRAMES and smoother.sums.weight > 0.0
    np.testing.assert_allclose(np.diag(tracker.estimate.uncertainty.edge_share)[:3], 1.0, atol=0.02)
    step = error_of(update.calibration, street.truth)
    assert (np.abs(step) < 4.0 * update.sigmas).all()


def test_in_a_frame_with_labels_nothing_is_matched_by_edges() -> None:
    tracker = begun("both", FRAMES)
    smoother = tracker.estimate.smoother
    assert smoother is not None and smoother.entries
    assert all(set(entry.pair.matches) == {VEHICLE} for entry in smoother.entries.values())
    assert not tracker.estimate.uncertainty.edge_share.any()
    assert not tracker.estimate.uncertainty.edge_steps.any()


def test_both_kinds_in_one_graph() -> None:
    tracker = begun("both", 4)
    smoother = tracker.estimate.smoother
    assert smoother is not None
    kinds = [next(iter(entry.pair.matches)) for _, entry in sorted(smoother.entries.items())]
    assert kinds[0] == VEHICLE and kinds[-1] == OBJECT
    share = np.diag(tracker.estimate.uncertainty.edge_share)[:3]
    assert (share > 0.02).all() and (share < 0.98).all()
    kernels = {
        c: matches.alignment.kernel.scale
        for entry in smoother.entries.values()
        for c, matches in entry.pair.matches.items()
    }
    assert kernels == pytest.approx({VEHICLE: 3.0, OBJECT: 1.2})


def test_what_edges_have_in_common_is_in_the_covariance() -> None:
    """At least the floor of the batch: 1 cm by axis and 4 ms, as far as edges decide."""
    estimate: OnlineEstimate = by_edges().estimate
    more = estimate.reported_covariance() - estimate.covariance[:7, :7] - estimate.considered().covariance(7)
    share = estimate.uncertainty.edge_share
    floor = share @ np.diag(np.square([0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0.004])) @ share.T
    assert np.linalg.eigvalsh(more - floor).min() > -1e-12
    assert (np.diag(more) > 0.0).all()


def test_errors_of_edges_as_columns() -> None:
    """A shift as all edges see it is a step of extrinsic and time offset."""
    smoother = by_edges().estimate.smoother
    assert smoother is not None
    assert held_names((), (VEHICLE,)) == held_names((), (VEHICLE, OBJECT))[: -len(EDGE_ERRORS)]
    entry = next(iter(smoother.entries.values()))
    matches, at = entry.pair.matches[OBJECT], entry.linear.information.point
    _, J, _ = weighted_residuals(matches.alignment, at.cTl, at.time_offset_s, entry.pair.motion.c_twist, 0.0)
    columns = edge_error_columns(J, matches, MatchConfig())
    np.testing.assert_array_equal(columns[:, -len(SHIFTS) :], J[:, :7])
    upward = columns[:, EDGE_ERRORS.index("upward")]
    assert (upward[matches.sides != 2] == 0.0).all()


def test_softness() -> None:
    assert variance_ratio(np.zeros((7, 7)), np.eye(9)) == 1.0
    assert variance_ratio(3.0 * np.eye(7), np.eye(9)) == pytest.approx(4.0)


def test_the_softness_is_that_of_all_that_was_seen() -> None:
    """A review's spread is of an estimate from the window alone; the running one has seen more."""
    tracker = begun("edges", 0)
    estimate, smoother = tracker.estimate, tracker.estimate.smoother
    assert estimate.edges is not None and smoother is not None
    estimate.edges.found = EdgeReview(spread=3.0 * estimate.covariance[:7, :7])
    assert estimate.for_comparison().variance_ratio == pytest.approx(4.0)
    smoother.sums.weight = 2.0 * sum(entry.linear.weight for entry in smoother.entries.values())
    assert estimate.for_comparison().variance_ratio == pytest.approx(2.0)


def test_motion_of_images_that_are_forgotten_is_forgotten() -> None:
    """After an alarm, the images from before it are gone: a start from those since goes on."""
    window = begun("edges", 0).inputs.window
    window.forget_images_before(window.next_image - 3)
    drive, _ = window.drive()
    stamps = [image.stamp_ns for image in drive.images]
    assert [(pair.tracks.from_ns, pair.tracks.to_ns) for pair in drive.image_pairs] == list(pairwise(stamps))
    assert len(camera_steps([drive])) <= len(drive.image_pairs) == 2


def test_new_frames_are_compared_with_turned_poses() -> None:
    tracker = begun("edges", 0)
    assert not tracker.monitor.turned.gains
    for position in range(FRAMES, FRAMES + 2):
        tracker.add(without_labels(simulated(TRACKED_STREET)[position]))
    turned = tracker.monitor.turned
    assert len(turned.gains) == len(turned.usual) == 2 and np.mean(turned.usual) > 0.0
    # Frames that are past the threshold of these are no confirmation.
    turned.usual.extend([0.1] * 10)
    turned.gains.extend([np.eye(8)[3]] * 2)
    assert turned.contradicted and tracker.monitor.contradicted
    turned.gains.extend([np.eye(8)[3]] * 6)
    restart = tracker.monitor._turned(tracker.estimate.point, None)
    assert restart is not None and restart.alarm and restart.scans == 8


def test_a_doubt_is_a_status() -> None:
    tracker = begun("edges", 0)
    edges = tracker.estimate.edges
    assert edges is not None
    edges.reasons = ("the pose may be wrong altogether",)
    assert tracker.estimate.reasons == ("the pose may be wrong altogether",)
    result = tracker.result()
    assert result.status == "not_converged" and "the pose may be wrong altogether" in result.reasons[0]
    assert list(result.diagnostics[EDGE_BIAS]) == ["stream:object"] and MASK_BIAS not in result.diagnostics


def test_a_checkpoint_before_the_start_goes_on_alike(tmp_path: Path) -> None:
    """Gradients of pictures and what images show of motion are stored, too."""
    street = simulated(TRACKED_STREET)
    whole = Tracker(street.camera, config("edges"), street.truth.cTl)
    for position in range(3):
        whole.add(without_labels(street[position]))
    whole.save(tmp_path / "tracker.npz")
    again = Tracker.load(tmp_path / "tracker.npz", whole.setup)
    for tracker in (whole, again):
        tracker.add(without_labels(street[3]))
    (drive, _), (other, _) = whole.inputs.window.drive(), again.inputs.window.drive()
    assert len(drive.image_pairs) == len(other.image_pairs) == 3
    for one, two in zip(drive.image_pairs, other.image_pairs, strict=True):
        assert one.direction.rotation.equals(two.direction.rotation, 1e-12)
        np.testing.assert_array_equal(one.tracks.uv_b, two.tracks.uv_b)
    for image, stored_image in zip(drive.images, other.images, strict=True):
        gradients, stored_gradients = image.contours[OBJECT], stored_image.contours[OBJECT]
        assert isinstance(gradients, PictureGradients) and isinstance(stored_gradients, PictureGradients)
        np.testing.assert_array_equal(gradients.strengths, stored_gradients.strengths)


@pytest.mark.slow
def test_a_checkpoint_with_a_review_under_way(tmp_path: Path) -> None:
    """The tracker that is read back does the work of it again: both are at the same step."""
    tracker = begun("edges", 0)
    edges, smoother = tracker.estimate.edges, tracker.estimate.smoother
    assert edges is not None and smoother is not None
    edges.next = 0
    edges.advance(tracker.matcher, smoother, None)
    assert edges.review is not None and edges.review.work > 0
    tracker.save(tmp_path / "tracker.npz")
    again = Tracker.load(tmp_path / "tracker.npz").estimate.edges
    assert again is not None and again.review is not None
    assert again.review.work == edges.review.work
    found = [each.review.advance(None) for each in (edges, again)]  # type: ignore[union-attr]
    np.testing.assert_allclose(found[0].spread, found[1].spread, rtol=1e-6, atol=1e-12)  # type: ignore[union-attr]
    assert found[0].reasons == found[1].reasons  # type: ignore[union-attr]


def test_a_frame_that_cannot_be_used_changes_nothing() -> None:
    tracker = begun("edges", 0)
    street = simulated(TRACKED_STREET)
    frame = without_labels(street[FRAMES])
    assert frame.image is not None and frame.scan is not None
    before = tracker.estimate.point
    wrong = dataclasses.replace(frame.image, pixels=frame.image.pixels[:10])
    update = tracker.add_image(wrong)
    assert not update.accepted and update.refused == ("image",)
    dark = dataclasses.replace(frame.image, pixels=np.zeros_like(frame.image.pixels))
    assert tracker.add_image(dark).accepted
    tracker.add_scan(frame.scan)
    step = before.cTl.localCoordinates(tracker.estimate.point.cTl)
    assert np.isfinite(step).all() and np.degrees(np.linalg.norm(step[:3])) < 0.5


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared")
@pytest.mark.parametrize(("name", "statuses"), [("stop", {"ok"}), ("parked", {"ok", "unobservable"})])
def test_a_real_drive_without_label_files(
    name: str, statuses: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only clouds, pictures, stamps and intrinsics are there; method auto. The last line is the file."""
    without_label_files(DATA / f"kitti_2011_09_26_{name}", tmp_path)
    truth = open_source(tmp_path, image_shift=1).truth
    assert truth is not None and truth.time_offset_s is not None
    away = np.array([*np.radians([3.0, -4.0, 2.5]), 0.06, -0.08, 0.05])
    camera = open_source(tmp_path).camera
    init, out = tmp_path / "init.json", tmp_path / "out.json"
    init.write_text(CalibrationResult(truth.cTl.retract(away), 0.0, np.eye(7), "ok", camera).to_json())
    main(["track", str(tmp_path), "--image-shift", "1", "--init", str(init), "--out", str(out)])
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    result = read_result(out)
    np.testing.assert_array_equal(last["T_camera_lidar"], result.T_camera_lidar.matrix())
    np.testing.assert_array_equal(last["covariance"], result.covariance)
    assert last["time_offset_s"] == result.time_offset_s and last["status"] in statuses
    errors = errors_of(result, truth)
    assert errors.qad_deg < 0.25 and errors.atd_m < 0.03
    assert errors.time_offset_s is not None and abs(errors.time_offset_s) < 0.015
    step = error_of(result.calibration, truth)
    assert (np.abs(step) < 3.0 * np.sqrt(np.diag(result.covariance))).all()


def tracked(source: Source, initial: gtsam.Pose3) -> tuple[Tracker, TrackUpdate]:
    """The tracker at the end of a drive, by edges."""
    tracker = Tracker(source.camera, config("edges"), initial)
    for frame in source:
        tracker.add(frame)
    return tracker, tracker.optimize()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own-504", "own-507", "third-901"])
def test_a_street_without_labels(name: str) -> None:
    """The last moves by 3.5 cm where edges farther away are met, and comes back."""
    street = source_of(name)
    truth = street.truth
    assert truth is not None and truth.time_offset_s is not None
    _, update = tracked(street, truth.cTl.retract(start_step(name)))
    assert update.status == "ok"
    step = error_of(update.calibration, truth)
    assert np.degrees(np.linalg.norm(step[:3])) < 0.25 and np.linalg.norm(step[3:6]) < 0.05
    assert abs(step[6]) < 0.01 and (np.abs(step) < 3.0 * update.sigmas).all()


@pytest.mark.slow
def test_pictures_of_another_street_are_not_trusted() -> None:
    street, other = source_of("own-504"), source_of("own-508")
    frames = [
        dataclasses.replace(frame, image=dataclasses.replace(frame.image, pixels=wrong.image.pixels))
        for frame, wrong in zip(street, other, strict=True)
        if frame.image is not None and wrong.image is not None
    ]
    assert street.truth is not None
    tracker = Tracker(street.camera, config("edges"), street.truth.cTl)
    for frame in frames:
        assert tracker.add(frame).status != "ok"
    assert tracker.optimize().status != "ok"


@pytest.mark.parametrize("method", ["edges", "joint"])
def test_a_result_says_why_there_is_no_start(method: str) -> None:
    street = simulated(TRACKED_STREET)
    tracker = Tracker(street.camera, config(method), street.truth.cTl)
    tracker.initializer.failed("no LiDAR edge in any picture")
    no_estimate, why = tracker.result().reasons
    assert "no estimate yet" in no_estimate and why == "no LiDAR edge in any picture"
    tracker.initializer.restart(tracker.initializer.guess, 0, alarmed=True)
    assert "the calibration has changed" in tracker.result().reasons[0]
