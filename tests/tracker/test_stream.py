"""The tracker on a short simulated drive: start, refusals, retirement, checkpoint."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gtsam
import numpy as np
import pytest
from linear_systems import system_of
from streets import EARLY_START, saved_tracker, sigmas_apart, tracker_from_truth

from sst_graph import Tracker
from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.covariance.image_shifts import image_shifts
from sst_graph.errors import DataError, EstimationError
from sst_graph.factors import FactorError
from sst_graph.files.object_store import stored
from sst_graph.graph.building import joint_graph, state_from
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import associate
from sst_graph.inspect.gained import gained_of
from sst_graph.objects.tracks import object_tracks
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulatedDrive
from sst_graph.tracker import estimate
from sst_graph.tracker.track_update import current_update
from sst_graph.tracker.window.epochs import MatchedPair
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import Frame


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of a tracker after 20 frames."""
    path = tmp_path_factory.mktemp("tracker") / "tracker.npz"
    path.write_bytes(saved_tracker(20))
    assert Tracker.load(path).estimate.exists
    return path


@pytest.mark.slow
def test_from_the_first_frame_to_the_truth(street: SimulatedDrive, frames: list[Frame]) -> None:
    tracker = Tracker(street.camera, EARLY_START, street.nominal)
    updates = [tracker.add(frame) for frame in frames]
    assert updates[0].status == "starting" and not updates[0].accepted
    assert updates[0].sigmas[6] == 1.0
    assert updates[-1].accepted and updates[-1].status in ("ok", "unobservable")
    assert updates[-1].sigmas[6] < 0.02
    assert not any(update.alarm for update in updates)
    assert (
        sigmas_apart(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0
    )  # chi-square of 7: 24


@pytest.mark.slow
def test_the_covariance_is_the_batch_s(running: Path) -> None:
    """Of the same matches: those towards the ground included, where the tracker makes any."""
    tracker = Tracker.load(running)
    tracker.optimize()
    drive, _ = tracker.inputs.window.drive()
    state, config = tracker.estimate.point.state(tracker.matcher.classes), tracker.matcher.graph
    tracks = object_tracks(drive)
    kernel = tracker.matcher.kernel
    pairs = associate([drive], motions_of([drive], [tracks]), state, kernel, config)
    graph, values = joint_graph(pairs, state, config)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    state = state_from(values, state, pairs)
    robust = robust_covariance(system_of(graph, values), values, pairs, state, [tracks])
    shifts = image_shifts(robust, pairs, values, state)
    assert shifts.sigmas.any()
    expected = robust.matrix[:7, :7] + shifts.covariance
    ratio = np.sqrt(np.diag(tracker.estimate.covariance)[:7] / np.diag(expected))
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)


def test_the_result_has_the_information_of_each_scan(running: Path) -> None:
    tracker = Tracker.load(running)
    gained = gained_of(CalibrationResult.from_json(tracker.result("drive").to_json()))
    assert gained is not None and gained.kind == "as they came"
    first, *rest = gained.gains
    assert first.bits is None and len(rest) > 5
    assert sum(gain.bits or 0.0 for gain in rest) > 3.0
    np.testing.assert_allclose(rest[-1].values, current_update(tracker).sigmas, rtol=1e-3)


def test_a_result_names_frames_by_their_numbers_in_the_drive(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    """Of a drive from its fifth frame on, as the lines of each frame do, and calibrate."""
    tracker = tracker_from_truth(street)
    updates = [tracker.add(frame) for frame in frames[5:20]]
    result = tracker.result("drive")
    used = {one.frame for one in result.frames_used}
    assert used <= set(range(5, 20)) and max(used) == updates[-1].frame == 19
    gained = gained_of(result)
    assert gained is not None and gained.gains[-1].frame.frame == 19
    assert set(result.versions) >= {"sst-graph", "gtsam"}
    for wrong in (lambda: tracker.result(3), lambda: tracker.optimize(1.5), lambda: tracker.optimize(-1)):  # type: ignore[arg-type]
        with pytest.raises(FactorError, match=r"drive: found 3|max_iterations: found"):
            wrong()


def test_information_is_that_of_the_scan_that_entered(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Where images come late, a scan enters with the next one."""
    tracker = tracker_from_truth(street)
    for frame, late in zip(frames[5:16], frames[4:], strict=False):
        tracker.add_scan(frame.scan, frame.index)
        tracker.add_image(late.image)
    gained = gained_of(tracker.result("drive"))
    assert gained is not None
    # The first estimate comes with the eighth scan.
    assert [gain.frame.frame for gain in gained.gains] == [11, 12, 13, 14]


def test_what_is_told_of_the_last_data_is_theirs(running: Path, frames: list[Frame]) -> None:
    """Whether frames are added, or scans and images alone."""
    tracker, good = Tracker.load(running), frames[20]
    assert good.scan is not None and good.image is not None and frames[21].image is not None
    nothing = dataclasses.replace(good.scan, points=np.full_like(good.scan.points, np.nan))
    refused = tracker.add(Frame(20, nothing, good.image))
    assert refused.refused == ("scan",) and refused is tracker.last_update
    scan = tracker.add_scan(good.scan)
    told = current_update(tracker, tracker.last_update)
    assert (told.stamp_ns, told.frame, told.refused) == (scan.stamp_ns, None, ())
    assert told.accepted and told.chi2 == scan.chi2
    image = tracker.add_image(frames[21].image)
    assert current_update(tracker, tracker.last_update).stamp_ns == image.stamp_ns


@pytest.mark.slow
def test_what_leaves_the_window_still_counts(street: SimulatedDrive, frames: list[Frame]) -> None:
    whole, short = (
        tracker_from_truth(street),
        tracker_from_truth(street, dataclasses.replace(EARLY_START, window=10)),
    )
    for frame in frames:
        whole.add(frame)
        short.add(frame)
    assert short.estimate.smoother is not None and whole.estimate.smoother is not None
    assert len(short.estimate.smoother.entries) <= 10 < len(whole.estimate.smoother.entries)
    assert sigmas_apart(whole, short.estimate.point.cTl, short.estimate.point.time_offset_s) < 2.5
    ratio = np.sqrt(np.diag(short.estimate.covariance) / np.diag(whole.estimate.covariance))
    assert ratio.min() > 0.7 and ratio.max() < 1.5


def test_bad_frames_leave_the_estimate(running: Path, frames: list[Frame]) -> None:
    tracker, good = Tracker.load(running), frames[20]
    before = tracker.estimate.point
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
        assert tracker.estimate.point is before
    assert tracker.add(good).accepted


def test_images_and_scans_at_their_own_rates(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Every other image missing, and one late: all scans are used or say why."""
    tracker = tracker_from_truth(street)
    late = frames[10].image
    for frame in frames:
        if frame.index % 2 == 0 and frame.index != 10:
            assert tracker.add_image(frame.image).accepted
        update = tracker.add_scan(frame.scan)
        if frame.index == 12:
            assert tracker.add_image(late).accepted
    assert update.accepted
    assert sigmas_apart(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


def test_gaps_and_half_as_many_scans(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Scans at half the images' rate, and a second in which nothing comes."""
    tracker = tracker_from_truth(street, dataclasses.replace(EARLY_START, start_scans=6))
    for frame in frames:
        if 20 <= frame.index < 29:
            continue
        scan = frame.scan if frame.index % 2 == 0 else None
        update = tracker.add(Frame(frame.index, scan, frame.image))
    assert tracker.estimate.exists and update.status in ("ok", "unobservable")
    assert sigmas_apart(tracker, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


def test_what_comes_too_late_or_out_of_order_is_refused(running: Path, frames: list[Frame]) -> None:
    """An image that is late but not too late is sorted in; older ones, and any older scan, are refused."""
    tracker = Tracker.load(running)
    before, images = tracker.estimate.point, [image.stamp_ns for image in tracker.inputs.window.images]
    old = frames[1].image
    assert old is not None and frames[10].scan is not None and frames[19].image is not None
    update = tracker.add_image(dataclasses.replace(old, stamp_ns=old.stamp_ns + 7))
    assert not update.accepted and "behind the newest scan" in update.reason and "1.5 s" in update.reason
    update = tracker.add_scan(frames[10].scan)
    assert not update.accepted and "one after" in update.reason
    assert (
        tracker.estimate.point is before
        and [image.stamp_ns for image in tracker.inputs.window.images] == images
    )
    between = dataclasses.replace(frames[19].image, stamp_ns=frames[19].image.stamp_ns - 30_000_000)
    assert tracker.add_image(between).accepted
    stamps = [image.stamp_ns for image in tracker.inputs.window.images]
    assert between.stamp_ns in stamps and stamps == sorted(stamps)


def test_an_update_that_fails_changes_nothing(running: Path, frames: list[Frame]) -> None:
    tracker = Tracker.load(running)
    smoother = tracker.estimate.smoother
    assert smoother is not None
    scan, entry = next(iter(smoother.entries.items()))
    assert entry.pair.l_twist is not None
    broken = dataclasses.replace(entry.pair.l_twist, covariance=-np.eye(6))
    pair = dataclasses.replace(entry.pair, l_twist=broken)
    before, entries = smoother.point, dict(smoother.entries)
    with pytest.raises(EstimationError, match="covariance"):
        smoother.update({scan: MatchedPair(pair, entry.linear, 0, entry.image)}, set(), 0)
    assert smoother.point is before and smoother.entries == entries
    assert tracker.add(frames[20]).accepted


def test_a_solution_of_the_window_that_fails_changes_nothing(
    running: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where its last step does, behind the update of the graph."""

    def fails(*_: object) -> None:
        raise EstimationError("no optimum")

    tracker = Tracker.load(running)
    monkeypatch.setattr(WindowSmoother, "optimize", fails)
    before = stored(tracker)
    update = tracker.optimize(1)
    assert update.converged is None and stored(tracker) == before


def test_an_epoch_that_has_no_match_in_the_end_stays_in_the_history(
    running: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solved(smoother: WindowSmoother, *_: object) -> bool:
        smoother.retired += smoother.live_epochs()
        return True

    tracker = Tracker.load(running)
    monkeypatch.setattr(estimate, "relinearize_window", solved)
    before = tracker.estimate.history()
    assert tracker.optimize().converged
    assert len(tracker.estimate.history()) == len(before) + 1


@pytest.mark.slow
def test_a_checkpoint_resumes_to_the_same_estimates(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    kept = tracker_from_truth(street)
    for frame in frames[:20]:
        kept.add(frame)
    kept.save(tmp_path / "tracker.npz")
    resumed = Tracker.load(tmp_path / "tracker.npz")
    assert resumed.estimate.point.cTl.equals(kept.estimate.point.cTl, 1e-12)
    assert resumed.estimate.point.time_offset_s == kept.estimate.point.time_offset_s
    np.testing.assert_allclose(resumed.estimate.covariance, kept.estimate.covariance, rtol=1e-12)
    assert resumed.matcher.graph == kept.matcher.graph and kept.matcher.graph.lower_edges
    for (_, a), (_, b) in zip(resumed.inputs.window.scans, kept.inputs.window.scans, strict=True):
        assert {c: len(points) for c, points in a.lower_edges.items()} == {
            c: len(points) for c, points in b.lower_edges.items()
        }
    for frame in frames[20:]:
        kept.add(frame)
        resumed.add(frame)
        assert sigmas_apart(kept, resumed.estimate.point.cTl, resumed.estimate.point.time_offset_s) < 1e-5
    np.testing.assert_allclose(resumed.estimate.covariance, kept.estimate.covariance, rtol=1e-5)
    assert (
        resumed.monitor.changes.statistic.recent
        and resumed.monitor.changes.statistic.usual == pytest.approx(kept.monitor.changes.statistic.usual)
    )


@pytest.mark.slow
def test_saving_hardly_moves_what_follows(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    """It relinearizes: a further Gauss-Newton step, which the frames to come would have brought, too."""
    saved, unsaved = tracker_from_truth(street), tracker_from_truth(street)
    for k, frame in enumerate(frames):
        saved.add(frame)
        unsaved.add(frame)
        if k % 10 == 9:
            before = saved.estimate.point
            saved.save(tmp_path / "tracker.npz")
            assert saved.estimate.point is before
    assert sigmas_apart(unsaved, saved.estimate.point.cTl, saved.estimate.point.time_offset_s) < 0.2


def test_a_broken_checkpoint_is_named(tmp_path: Path, running: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        Tracker.load(tmp_path / "none.npz")
    half = tmp_path / "half.npz"
    half.write_bytes(running.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"half\.npz: found no readable checkpoint"):
        Tracker.load(half)
