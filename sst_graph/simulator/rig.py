"""Several cameras on the vehicle of a simulated drive: one world, one LiDAR, one ego motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.errors import ConfigError
from sst_graph.metrics import FORWARD_R_OPTICAL
from sst_graph.simulator.drive import SimulatedDrive, mounting_error
from sst_graph.types import GroundTruth

STEREO_BASELINE_M = 0.5329697
"""KITTI's image_3 stands so far to the right of image_2 [m]."""


@dataclass(frozen=True)
class Mount:
    """A further camera of the vehicle.

    Attributes:
        nominal: the extrinsic cTl that the data claim.
        cTl: the true one.
        time_offset_s: of its images [s].
    """

    nominal: gtsam.Pose3
    cTl: gtsam.Pose3
    time_offset_s: float


def beside(drive: SimulatedDrive, cTa: gtsam.Pose3) -> Mount:
    """A camera that stands to the drive's own exactly as the data say, with the same trigger.

    Args:
        cTa: pose of the drive's own camera in the further one.
    """
    return Mount(cTa * drive.nominal, cTa * drive.truth.cTl, drive.config.time_offset_s)


def stereo_pose() -> gtsam.Pose3:
    """Pose of the left camera in the right one."""
    return gtsam.Pose3(gtsam.Rot3(), np.array([-STEREO_BASELINE_M, 0.0, 0.0]))


def surround(drive: SimulatedDrive, count: int) -> dict[str, Mount]:
    """Cameras all around: at even steps of yaw from that of the drive's own, each nominal pose wrong by the
    configured error in its own way, with lever arms of 0.2 to 1 m and time offsets within 30 ms of the
    drive's."""
    mounts = {}
    for k in range(1, count):
        rng = np.random.default_rng([drive.config.seed, 12, k])
        yaw = 2.0 * np.pi * k / count
        arm = float(rng.uniform(0.2, 1.0))
        where = np.array([arm * np.cos(yaw), arm * np.sin(yaw), -float(rng.uniform(0.0, 0.3))])
        nominal = gtsam.Pose3(gtsam.Rot3.Rz(yaw) * FORWARD_R_OPTICAL, where).inverse()
        time_offset_s = drive.config.time_offset_s + float(rng.uniform(-0.03, 0.03))
        mounts[f"camera_{k}"] = Mount(nominal, nominal * mounting_error(drive.config, rng), time_offset_s)
    return mounts


def with_mounts(
    drive: SimulatedDrive, mounts: Mapping[str, Mount], name: str = "camera_0"
) -> dict[str, SimulatedDrive]:
    """The drive as each camera sees it, by the camera's name; all have the drive's intrinsics and scans.

    Args:
        name: of the drive's own camera.

    Raises:
        ConfigError: a further camera has that name.
    """
    if name in mounts:
        raise ConfigError(f"camera {name!r}: found twice, expected different names")
    further = {
        key: replace(
            drive,
            config=replace(drive.config, time_offset_s=mount.time_offset_s),
            nominal=mount.nominal,
            truth=GroundTruth(mount.cTl, mount.time_offset_s),
            camera_number=number,
        )
        for number, (key, mount) in enumerate(mounts.items(), start=1)
    }
    return {name: drive, **further}
