"""``source[position]`` of every kind of drive: a frame, for a slice a drive, or an error that names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from layouts import as_folder, as_kitti_raw, as_nuscenes

from sst_graph.data import open_source
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.data.lidar_pose import LidarFrameSource
from sst_graph.drive.geometric_labels import GeometricallyLabelled
from sst_graph.errors import DataError
from sst_graph.odometry.sweep import with_sweep
from sst_graph.simulator import SimulationConfig, simulate

SMALL = SimulationConfig(seed=5, frames=4, width=64, height=32, azimuth_step_deg=2.0, motion="no_stop")
MAKE: dict[str, Callable[[Path, Path], Any]] = {
    "KITTI": lambda drive, folder: open_source(drive),
    "KITTI raw": lambda drive, folder: open_source(as_kitti_raw(drive, folder / "raw")),
    "folder": lambda drive, folder: open_source(as_folder(drive, folder / "street")),
    "nuScenes": lambda drive, folder: open_source(as_nuscenes(drive, folder / "nus"), sequence="scene-0061"),
    "a slice": lambda drive, folder: open_source(drive)[1:],  # type: ignore[index]
    "kept": lambda drive, folder: KeptDrive.of(open_source(drive)),
    "in other axes": lambda drive, folder: LidarFrameSource(open_source(drive), gtsam.Pose3()),
    "swept": lambda drive, folder: with_sweep(open_source(drive), decide=False),
    "swept, looked at": lambda drive, folder: with_sweep(open_source(drive)),
    "labelled": lambda drive, folder: GeometricallyLabelled(open_source(drive)),
    "simulated": lambda drive, folder: simulate(SMALL),
}
SLICED = {"KITTI", "KITTI raw", "folder", "nuScenes", "a slice", "kept", "in other axes"}
WRONG = [1.0, np.float64(1.0), "1", b"1", None, True, np.True_, [1], (0, 1), np.array([1]), object(), 1j]


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.slow if kind == "simulated" else ()) for kind in MAKE],
)
def test_a_position_is_a_whole_number_of_a_frame(kind: str, kitti_drive: Path, tmp_path: Path) -> None:
    source = MAKE[kind](kitti_drive, tmp_path)
    count = len(source)
    numbers = [frame.index for frame in source]
    for whole in (int, np.int64, np.int32, np.uint8):
        assert [source[whole(k)].index for k in range(count)] == numbers
    assert [source[-1 - k].index for k in range(count)] == numbers[::-1]
    asked = [source.__getitem__]
    asked += [getattr(source, n) for n in ("read_scan", "read_image", "frame_number") if hasattr(source, n)]
    for ask in asked:
        for wrong in WRONG:
            with pytest.raises(DataError, match=r"position of a frame: found .*, expected a whole number"):
                ask(wrong)
        for beyond in (count, -count - 1, np.int64(count), 10**30, -(10**5000)):
            with pytest.raises(IndexError, match=f"the drive has {count}"):
                ask(beyond)
    assert [frame.index for frame in map(source.__getitem__, range(count))] == numbers


@pytest.mark.parametrize("kind", MAKE)
def test_a_slice_is_a_drive_or_refused(kind: str, kitti_drive: Path, tmp_path: Path) -> None:
    source = MAKE[kind](kitti_drive, tmp_path)
    if kind not in SLICED:
        with pytest.raises(DataError, match="position of a frame: found a slice, expected a whole number"):
            source[1:]
        return
    numbers = [frame.index for frame in source]
    for part in (slice(1, 3), slice(None, -1), slice(None, None, 2), slice(np.int64(1), None), slice(9, 99)):
        assert [frame.index for frame in source[part]] == numbers[part]
        assert (source[part].name, len(source[part])) == (source.name, len(numbers[part]))
    for wrong in (slice(0.5, 2), slice("a", None), slice(None, None, 0), slice(None, None, 1.0)):
        with pytest.raises(DataError, match=r"slice of frames: found .*, expected whole numbers or None"):
            source[wrong]
