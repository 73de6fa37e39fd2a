"""Writing a simulated drive in the layout of KITTI odometry and SemanticKITTI, with its truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.arguments import checked_callback
from sst_graph.files import OutputKind, atomic_directory
from sst_graph.simulator.drive import RawFrame, SimulatedDrive
from sst_graph.simulator.rig import beside, with_mounts
from sst_graph.simulator.surfaces import CITYSCAPES, SEMANTIC_KITTI
from sst_graph.types import FloatArray

CAMERA_SHIFTS_M = (
    np.array([0.0, 0.0, 0.0]),
    np.array([-0.5371506, 0.0, 0.0]),
    np.array([0.0598493, -0.000357931, 0.002745884]),
    np.array([-0.4731050, 0.00215012, 0.002729905]),
)
"""Camera 0's origin in cameras 0 to 3 [m], as in KITTI: P_i = K [I | shift_i]."""
PNG_SPEED = [cv2.IMWRITE_PNG_COMPRESSION, 1]
FOLDERS = ("image_2", "semantic_2", "velodyne", "labels")
RIGHT_FOLDERS = ("image_3", "semantic_3")
DRIVE = OutputKind("simulated drive", exclusive=("sequences",))
FRAME_NAME = "{:06d}"

Progress = Callable[[int, int], None]


def write_drive(
    drive: SimulatedDrive,
    path: str | Path,
    progress: Progress | None = None,
    stereo: bool = False,
) -> Path:
    """Write the drive as ``path``/sequences/00 and return that folder; all of it or nothing appears.

    The camera is image_2. calib.txt carries the nominal extrinsic, groundtruth.json the true one.
    poses.txt is in the convention of KITTI's camera 0 and holds calib.txt's Tr inside, as KITTI's
    does: with that Tr it gives the LiDAR's true motion at the scans' stamps, and nothing else.
    Where the drive tells them, velodyne_times holds each point's time after the stamp (float32 [s]).

    Args:
        drive: from :func:`sst_graph.simulator.simulate`.
        path: folder to be made.
        progress: called with (frames done, frames in all).
        stereo: write image_3 and semantic_3 as well: the right camera, where calib.txt has it.

    Raises:
        ConfigError: ``path`` is there, and not empty.
        OSError: it cannot be written.
        FactorError: ``progress`` cannot be called so.
    """
    with atomic_directory(path, False, DRIVE) as root:
        fill_drive(drive, root, progress, stereo)
    return Path(path) / "sequences" / "00"


def fill_drive(drive: SimulatedDrive, root: Path, progress: Progress | None, stereo: bool = False) -> None:
    """Write the drive's files into ``root``/sequences/00, which must not be there; :func:`write_drive`.

    Raises:
        OSError: it cannot be written.
        FactorError: ``progress`` cannot be called so.
    """
    checked_callback("progress", progress, ("done", "total"))
    folder = root / "sequences" / "00"
    right = right_camera(drive) if stereo else None
    more = (*(("velodyne_times",) if drive.config.gives_times else ()), *(RIGHT_FOLDERS if stereo else ()))
    for name in (*FOLDERS, *more):
        (folder / name).mkdir(parents=True)
    (folder / "calib.txt").write_text(_calibration(drive))
    (folder / "times.txt").write_text("".join(f"{stamp * 1e-9:.9e}\n" for stamp in drive.stamps_ns))
    (folder / "poses.txt").write_text(_poses(drive))
    (folder / "groundtruth.json").write_text(json.dumps(_truth(drive), indent=1) + "\n")
    for index in range(len(drive)):
        name = FRAME_NAME.format(index)
        _write_frame(folder, name, drive.raw(index), drive.config.gives_times)
        if right is not None:
            _write_image(folder, name, 3, *right.raw_image(index)[:2])
        if progress is not None:
            progress(index + 1, len(drive))


def _write_frame(folder: Path, name: str, raw: RawFrame, times: bool) -> None:
    """One frame's image, mask, cloud and labels."""
    _write_image(folder, name, 2, raw.pixels, raw.pixel_kinds)
    cloud = np.column_stack([raw.points, np.zeros(len(raw.points), np.float32)])
    (folder / "velodyne" / f"{name}.bin").write_bytes(cloud.astype("<f4").tobytes())
    labels = SEMANTIC_KITTI[raw.point_kinds] | (raw.point_instances.astype(np.uint32) << 16)
    (folder / "labels" / f"{name}.label").write_bytes(labels.astype("<u4").tobytes())
    if times:
        (folder / "velodyne_times" / f"{name}.bin").write_bytes(raw.offsets_s.astype("<f4").tobytes())


def _write_image(
    folder: Path, name: str, camera: int, pixels: NDArray[np.uint8], kinds: NDArray[np.uint8]
) -> None:
    """Picture and mask of one camera."""
    _write_png(folder / f"image_{camera}" / f"{name}.png", pixels)
    _write_png(folder / f"semantic_{camera}" / f"{name}.png", CITYSCAPES[kinds])


def right_camera(drive: SimulatedDrive) -> SimulatedDrive:
    """The drive seen by KITTI's image_3, right of image_2; both have one trigger."""
    right = gtsam.Pose3(gtsam.Rot3(), CAMERA_SHIFTS_M[3] - CAMERA_SHIFTS_M[2])
    return with_mounts(drive, {"image_3": beside(drive, right)}, "image_2")["image_3"]


def _write_png(path: Path, image: np.typing.NDArray[np.uint8]) -> None:
    # OpenCV's own writing says neither what failed nor why.
    _, data = cv2.imencode(".png", image, PNG_SPEED)
    path.write_bytes(data.tobytes())


def _lidar_in_camera0(drive: SimulatedDrive) -> gtsam.Pose3:
    """Tr of calib.txt: the nominal extrinsic, for camera 0."""
    return gtsam.Pose3(gtsam.Rot3(), -CAMERA_SHIFTS_M[2]) * drive.nominal


def _row(matrix: FloatArray) -> str:
    return " ".join(f"{value:.12e}" for value in np.asarray(matrix)[:3, :4].ravel())


def _calibration(drive: SimulatedDrive) -> str:
    """The text of calib.txt."""
    K = drive.camera.matrix
    lines = [
        f"P{i}: {_row(K @ np.column_stack([np.eye(3), shift]))}" for i, shift in enumerate(CAMERA_SHIFTS_M)
    ]
    return "\n".join([*lines, f"Tr: {_row(_lidar_in_camera0(drive).matrix())}"]) + "\n"


def _poses(drive: SimulatedDrive) -> str:
    """The text of poses.txt: camera 0 at each scan's stamp, in camera 0 at the first."""
    Tr = _lidar_in_camera0(drive)
    poses = [drive.wTl(stamp * 1e-9) for stamp in drive.stamps_ns]
    return "".join(_row((Tr * poses[0].between(pose) * Tr.inverse()).matrix()) + "\n" for pose in poses)


def _truth(drive: SimulatedDrive) -> dict[str, object]:
    """The content of groundtruth.json."""
    return {
        "T_camera_lidar": drive.truth.cTl.matrix().tolist(),
        "time_offset_s": drive.truth.time_offset_s,
        "camera": "image_2",
        "T_world_lidar": [drive.wTl(stamp * 1e-9).matrix().tolist() for stamp in drive.stamps_ns],
        "T_world_camera": [drive.wTc(stamp * 1e-9).matrix().tolist() for stamp in drive.stamps_ns],
        "moving_instances": sorted(vehicle.instance for vehicle in drive.street.moving),
        "config": asdict(drive.config),
    }
