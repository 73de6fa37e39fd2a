"""Resuming on a drive: its frames that are still to come, whatever one of its sensors lacks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from stored import simulated

from sst_graph import Tracker
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import DataError
from sst_graph.simulator import SimulationConfig
from sst_graph.tracker.storage.resume import frames_to_come
from sst_graph.types import Frame, Scan

SMALL = SimulationConfig(seed=5, frames=7, width=160, height=48, azimuth_step_deg=1.0, motion="no_stop")
ScanChange = Callable[[Scan], Scan | None]


def _drive(changed: int, change: ScanChange, camera_ahead_s: float = 0.0) -> KeptDrive:
    """A drive with another scan in one frame, and with a camera whose clock is ahead of the LiDAR's."""

    def own(frame: Frame) -> Frame:
        assert frame.scan is not None and frame.image is not None
        stamp_ns = frame.image.stamp_ns + round(1e9 * camera_ahead_s)
        scan = change(frame.scan) if frame.index == changed else frame.scan
        return dataclasses.replace(
            frame, scan=scan, image=dataclasses.replace(frame.image, stamp_ns=stamp_ns)
        )

    kept = KeptDrive.of(simulated(SMALL))
    return dataclasses.replace(kept, frames=[own(frame) for frame in kept])


def _none(scan: Scan) -> None:
    return None


def _empty(scan: Scan) -> Scan:
    return dataclasses.replace(scan, points=scan.points[:0], classes=scan.classes[:0], instances=None)


def _nan(scan: Scan) -> Scan:
    return dataclasses.replace(scan, points=np.full_like(scan.points, np.nan))


def _after(drive: KeptDrive, frames: int, path: Path) -> Tracker:
    """A tracker that was saved after some frames, and read."""
    tracker = Tracker(drive.camera, None, drive.nominal)
    for frame in drive.frames[:frames]:
        tracker.add(frame)
    tracker.save(path)
    return Tracker.load(path)


@pytest.mark.parametrize("change", [_none, _empty, _nan])
@pytest.mark.parametrize("changed", [1, 3])
@pytest.mark.parametrize("ahead_s", [0.0, 0.6, -0.3])
def test_the_frames_to_come_are_those_behind_the_saved_ones(
    tmp_path: Path, change: ScanChange, changed: int, ahead_s: float
) -> None:
    """A scan that is missing or of no use, in the last frame or one before it, under any camera's clock."""
    drive = _drive(changed, change, ahead_s)
    tracker = _after(drive, 4, tmp_path / "tracker.npz")
    coming = list(frames_to_come(tracker, drive, "tracker.npz"))
    assert [frame.index for frame in coming] == [4, 5, 6]
    assert not tracker.add(coming[0]).refused


def test_an_image_beside_a_scan_of_no_use_is_compared(tmp_path: Path) -> None:
    """The frame's image was used: a drive in which it is another one is another drive."""
    drive = _drive(1, _nan)
    tracker = _after(drive, 4, tmp_path / "tracker.npz")
    frame = drive.frames[1]
    assert frame.image is not None
    mask = frame.image.mask.copy()
    mask[:9] = 1
    other = dataclasses.replace(frame, image=dataclasses.replace(frame.image, mask=mask))
    frames = [other if one.index == 1 else one for one in drive]
    with pytest.raises(DataError, match="another image of"):
        frames_to_come(tracker, dataclasses.replace(drive, frames=frames), "tracker.npz")
