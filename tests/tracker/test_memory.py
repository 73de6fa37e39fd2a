"""What a tracker keeps does not grow: with both sensors, with either alone, with one that dies."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph import Tracker, TrackerConfig
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.object_store import stored
from sst_graph.tracker.inputs import _MAX_IMAGES
from sst_graph.tracker.storage import resume
from sst_graph.types import CameraImage, Frame, Scan

CAMERA = PinholeCamera(8.0, 8.0, 4.0, 3.0, 9, 7)
PERIOD_NS = 100_000_000
FRAMES = 1600
"""Nearly three minutes; what is kept longest, 600 images, is one."""


def _scan(k: int) -> Scan:
    rng = np.random.default_rng(k % 7)
    points = rng.uniform(5.0, 20.0, (24, 3)).astype(np.float32)
    return Scan(k * PERIOD_NS, points, (np.arange(24) % 2).astype(np.uint8))


def _image(k: int, ahead_ns: int = 0) -> CameraImage:
    mask = np.zeros((7, 9), np.uint8)
    mask[2:5, 2 + k % 3 : 6] = 1
    return CameraImage(k * PERIOD_NS + ahead_ns, mask, np.zeros((7, 9, 3), np.uint8))


def _size(tracker: Tracker) -> int:
    """Bytes of all that a tracker holds."""
    node, data = stored(tracker)
    return len(str(node)) + len(data)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", ["images", "scans", "both", "scans die", "images die"])
def test_what_is_kept_is_bounded(sensors: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resume, "MOST", 300)
    tracker = Tracker(CAMERA, TrackerConfig())
    sizes = []
    for k in range(FRAMES):
        both = sensors == "both" or (sensors.endswith("die") and not 200 <= k < FRAMES - 100)
        scan = _scan(k) if both or sensors in ("scans", "images die") else None
        image = _image(k) if both or sensors in ("images", "scans die") else None
        update = tracker.add(Frame(k, scan, image))
        assert not update.refused
        assert len(tracker.inputs.window.scans) <= tracker.setup.config.window
        assert len(tracker.inputs.window.images) <= _MAX_IMAGES
        if k % 200 == 99 and 800 < k < FRAMES - 100:
            sizes.append(_size(tracker))
    assert max(sizes) < 1.1 * min(sizes) and max(sizes) < 2e6


def test_the_first_and_the_latest_frames_are_recognized(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resume, "MOST", 5)
    seen = resume.SeenFrames()
    for k in range(20):
        seen.add(_scan(k))
    assert (seen.scans[:, 0] // PERIOD_NS).tolist() == [0, 1, 2, 15, 16, 17, 18, 19]


def test_images_at_any_rate_are_bounded() -> None:
    """A thousand stamps within a microsecond, as a broken driver may give them."""
    tracker = Tracker(CAMERA)
    for k in range(1000):
        image = _image(0)
        tracker.add_image(CameraImage(k, image.mask, image.pixels))
    assert len(tracker.inputs.window.images) == _MAX_IMAGES


@pytest.mark.parametrize("ahead_s", [-60, -6, 0, 6, 60])
def test_scans_keep_their_images_whatever_the_camera_s_clock(ahead_s: int) -> None:
    tracker, ahead_ns = Tracker(CAMERA, initial_time_offset_s=-ahead_s), ahead_s * 10**9
    for k in range(100):
        assert not tracker.add(Frame(k, _scan(k), _image(k, ahead_ns))).refused
    window = tracker.inputs.window
    stamps = [image.stamp_ns for image in window.images]
    assert set(stamps) >= {scan.stamp_ns + ahead_ns for _, scan in window.scans}
    assert len(window.scans) == 60 and len(stamps) < 60 + 30  # 2.5 s of images before the first


def test_a_scan_meets_images_again_after_an_hour_without() -> None:
    tracker = Tracker(CAMERA)
    for k in range(30):
        tracker.add(Frame(k, _scan(k), _image(k)))
    hour = 36_000
    for k in range(hour, hour + 30):
        assert not tracker.add(Frame(k, _scan(k), _image(k))).refused
    assert tracker.inputs.window.images[-1].stamp_ns == (hour + 29) * PERIOD_NS
