"""What is logged for the viewer, read back from the file with rerun's own reader."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rrd import RrdFile

from sst_graph.errors import ConfigError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator import SimulatedDrive
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.tracker import Tracker
from sst_graph.types import Frame, SemanticClass
from sst_graph.viewer import FrameView, Recording
from sst_graph.viewer.fixed_calibration import views_under
from sst_graph.viewer.tracker_view import TrackerView

CAR = (SemanticClass.VEHICLE,)
COUNT = 10


def _truth(street: SimulatedDrive) -> tuple[gtsam.Pose3, float]:
    assert street.truth.time_offset_s is not None
    return street.truth.cTl, street.truth.time_offset_s


def _saved(path: Path, views: list[FrameView], camera: PinholeCamera) -> RrdFile:
    with Recording(camera, live=False, save=path, tracked=False) as recording:
        for view in views:
            recording.frame(view)
    return RrdFile(path)


def _residual_px(views: list[FrameView]) -> float:
    """Median distance of the boundary points to their contours [px]."""
    return float(np.median(np.concatenate([np.abs(v.matches.residuals_px) for v in views if v.matches])))


@pytest.mark.slow
def test_a_drive_under_its_calibration(street: SimulatedDrive, frames: list[Frame], tmp_path: Path) -> None:
    cTl, time_offset_s = _truth(street)
    views = list(views_under(frames[:COUNT], street.camera, cTl, time_offset_s, CAR))
    file = _saved(tmp_path / "a.rrd", views, street.camera)
    image = "/world/lidar/camera/image"
    assert file.entities >= {
        "/world/lidar/cloud",
        "/world/trajectory",
        "/world/tracks",
        image,
        f"{image}/points_by_depth",
        f"{image}/points_by_class",
        f"{image}/matches/residuals",
        f"{image}/matches/boundary_points",
        f"{image}/matches/contour_points",
    }
    # Every frame once, by its number.
    for entity, component in (("/world/lidar/cloud", "positions"), (image, "blob")):
        assert sorted(file.of(entity, component)) == [frame.index for frame in frames[:COUNT]]
    # The camera in the LiDAR: the inverse of the calibration; the matrix is stored by columns.
    placed = file.of("/world/lidar/camera", "translation")[3][0]
    np.testing.assert_allclose(placed, cTl.inverse().translation(), atol=1e-6)
    turned = np.reshape(file.of("/world/lidar/camera", "mat3x3")[3][0], (3, 3)).T
    np.testing.assert_allclose(turned, cTl.inverse().rotation().matrix(), atol=1e-6)
    path = np.array(file.of("/world/trajectory", "strips")[COUNT - 1][0])
    assert len(path) == COUNT
    first, last = (street.wTl(1e-9 * views[k].scan.stamp_ns) for k in (0, COUNT - 1))
    np.testing.assert_allclose(path[-1], first.between(last).translation(), atol=0.05)
    lines = np.array(file.of(f"{image}/matches/residuals", "strips")[5])
    assert lines.shape[1:] == (2, 2) and len(lines) > 50
    matches = views[5].matches
    assert matches is not None
    np.testing.assert_allclose(lines[:, 0], matches.boundary, atol=0.01)
    np.testing.assert_allclose(lines[:, 1], matches.contour, atol=0.01)


def test_points_lie_where_they_are_projected(street: SimulatedDrive, frames: list[Frame]) -> None:
    cTl, time_offset_s = _truth(street)
    view = list(views_under(frames[:3], street.camera, cTl, time_offset_s, CAR))[1]
    cPs = view.scan.points[view.seen].astype(float) @ cTl.rotation().matrix().T + cTl.translation()
    # Without motion between scan and image they would lie at the projection; the motion is 0.2 m at most.
    assert np.median(np.linalg.norm(street.camera.project(cPs) - view.uvs, axis=1)) < 3.0
    np.testing.assert_allclose(view.depths_m, cPs[:, 2], atol=0.3)
    assert view.image is not None and abs(view.image.stamp_ns - view.scan.stamp_ns) < 60e6


def test_a_wrong_calibration_shows(street: SimulatedDrive, frames: list[Frame]) -> None:
    cTl, time_offset_s = _truth(street)
    wrong = cTl * gtsam.Pose3(gtsam.Rot3.Rz(np.radians(0.5)), np.zeros(3))
    right, off = (
        list(views_under(frames[:COUNT], street.camera, one, time_offset_s, CAR)) for one in (cTl, wrong)
    )
    assert _residual_px(right) < 0.8 < 1.2 < _residual_px(off)


def test_images_that_come_later_than_their_scans(street: SimulatedDrive, frames: list[Frame]) -> None:
    later_ns = 250_000_000
    apart = []
    for frame in frames[:COUNT]:
        assert frame.image is not None
        image = dataclasses.replace(frame.image, stamp_ns=frame.image.stamp_ns + later_ns)
        apart += [dataclasses.replace(frame, image=None), Frame(frame.index, None, image)]
    apart.sort(key=lambda one: one.scan.stamp_ns if one.scan else one.image.stamp_ns)  # type: ignore[union-attr]
    cTl, time_offset_s = _truth(street)
    views = list(views_under(apart, street.camera, cTl, time_offset_s - 1e-9 * later_ns, CAR))
    together = list(views_under(frames[:COUNT], street.camera, cTl, time_offset_s, CAR))
    assert [view.number for view in views] == [view.number for view in together]
    assert all(view.matches for view in views[1:]) and all(view.matches for view in together[1:])
    assert _residual_px(views) == pytest.approx(_residual_px(together), abs=0.1)


def test_without_labels_there_are_no_matches(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    bare = []
    for frame in frames[:4]:
        assert frame.scan is not None and frame.image is not None
        ignored = np.full_like(frame.scan.classes, SemanticClass.IGNORE)
        mask = np.full_like(frame.image.mask, SemanticClass.IGNORE)
        scan = dataclasses.replace(frame.scan, classes=ignored, instances=None)
        bare.append(Frame(frame.index, scan, dataclasses.replace(frame.image, mask=mask, instances=None)))
    views = list(views_under(bare, street.camera, *_truth(street), CAR))
    assert len(views) == 4 and all(view.matches is None and len(view.uvs) > 100 for view in views)
    file = _saved(tmp_path / "a.rrd", views, street.camera)
    assert "/world/lidar/camera/image/points_by_depth" in file.entities
    assert "/world/lidar/camera/image/matches/boundary_points" not in file.entities


def test_a_frame_that_cannot_be_used_is_passed_over(
    street: SimulatedDrive, frames: list[Frame], caplog: pytest.LogCaptureFixture
) -> None:
    bad = dataclasses.replace(frames[1], scan=frames[0].scan)  # the same stamp again
    views = list(views_under([frames[0], bad, frames[2]], street.camera, *_truth(street), CAR))
    assert [view.number for view in views] == [0, 2]
    assert "frame 1 is not shown" in caplog.text


@pytest.mark.slow
def test_the_tracker_is_logged_and_not_changed(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    config = TrackerConfig(start_scans=8)
    cTl, time_offset_s = _truth(street)
    start = cTl * gtsam.Pose3(gtsam.Rot3.Ypr(0.005, 0.002, -0.003), np.array([0.02, 0.01, 0.0]))
    plain, watched = (Tracker(street.camera, config, start, time_offset_s + 0.01) for _ in range(2))
    expected = [plain.add(frame) for frame in frames[:20]]
    path = tmp_path / "a.rrd"
    with Recording(street.camera, live=False, save=path, tracked=True) as recording:
        view = TrackerView(watched, recording)
        updates = [view.add(frame) for frame in frames[:20]]
        view.finish(updates[-1])
    assert updates == expected
    file = RrdFile(path)
    assert sorted(file.of("/world/lidar/cloud", "positions")) == list(range(20))
    last = updates[-1]
    assert last.covariance is not None
    value, low, high = file.of("/estimate/time_offset/offset", "scalars")[19]
    assert value == pytest.approx(1e3 * (last.time_offset_s - time_offset_s - 0.01), abs=1e-6)
    assert high - low == pytest.approx(4e3 * np.sqrt(last.covariance[6, 6]), rel=1e-6)
    turn = np.degrees(gtsam.Pose3.Logmap(start.inverse() * last.T_camera_lidar)[2])
    assert file.of("/estimate/rotation/z", "scalars")[19][0] == pytest.approx(turn, abs=1e-6)
    started = [k for k, update in enumerate(updates) if update.covariance is not None]
    sigmas = file.of("/sigma/translation/x", "scalars")
    assert sorted(k for k in sigmas if k is not None) == started
    assert sigmas[19] == pytest.approx([100.0 * np.sqrt(last.covariance[3, 3])])
    said = [text[0] for text in file.of("/tracker/log", "text").values()]
    assert said[0].startswith("starting") and any(text.startswith(last.status) for text in said)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a viewer needs no display server")
def test_without_a_screen_no_viewer_is_started(
    street: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"cannot be opened: there is no screen .*: save a file"):
        Recording(street.camera, live=True, save=None, tracked=False)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a viewer needs no display server")
def test_a_viewer_that_ends_is_told_in_one_line(
    street: SimulatedDrive, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The real viewer is started, finds no such screen and ends; nothing waits for it for ever."""
    monkeypatch.setenv("DISPLAY", ":987")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    views = list(views_under(frames[:2], street.camera, *_truth(street), CAR))
    with (
        pytest.raises(ConfigError, match=r"rerun (has gone|cannot be opened)"),
        Recording(street.camera, live=True, save=None, tracked=False) as recording,
    ):
        for view in views:
            recording.frame(view)
