"""Clouds that are not in the axes of their LiDAR: those of the vehicle, say."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source_view import ChangedSource
from sst_graph.errors import ConfigError
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import GroundTruth, Scan, Source

_EXPECTED = "expected X,Y,Z or X,Y,Z,ROLL,PITCH,YAW [m, deg]"
_FARTHEST_M = 100.0


def parse_lidar_pose(text: str) -> gtsam.Pose3:
    """T_cloud_lidar of "X,Y,Z" or "X,Y,Z,ROLL,PITCH,YAW" [m, deg]: R = Rz(yaw) Ry(pitch) Rx(roll), as URDF.

    Raises:
        ConfigError: the text is none of these.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"lidar pose {text!r:.80}: {_EXPECTED}") from None
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        raise ConfigError(f"lidar pose {text!r:.80}: {_EXPECTED}")
    if max(map(abs, values[:3])) > _FARTHEST_M or max(map(abs, [0.0, *values[3:]])) > 360.0:
        raise ConfigError(
            f"lidar pose {text!r:.80}: expected metres, {_FARTHEST_M:g} at most, and degrees, 360 at most"
        )
    turn = gtsam.Rot3.RzRyRx(*np.radians(values[3:])) if len(values) == 6 else gtsam.Rot3()
    return gtsam.Pose3(turn, np.array(values[:3]))


def lidar_pose_text(T_cloud_lidar: gtsam.Pose3) -> str:
    """A pose as :func:`parse_lidar_pose` reads it: to centimetres and tenths of a degree."""
    # Without a minus before a zero.
    angles = np.degrees(T_cloud_lidar.rotation().rpy()).round(1) + 0.0
    metres = ",".join(f"{value:.2f}" for value in T_cloud_lidar.translation().round(2) + 0.0)
    turned = ",".join(f"{value:.1f}" for value in angles)
    return f"{metres},{turned}" if angles.any() else metres


def _moved(points: NDArray[np.float32], T_cloud_lidar: gtsam.Pose3) -> NDArray[np.float32]:
    """Points (n, 3) in the LiDAR's axes [m]."""
    R, t = T_cloud_lidar.rotation().matrix(), T_cloud_lidar.translation()
    return np.asarray(((points.astype(np.float64) - t) @ R).astype(np.float32))


@dataclass(frozen=True)
class TimingFromCloud(SweepTiming):
    """Times of points in the cloud's axes, by their azimuths about the LiDAR.

    Attributes:
        T_cloud_lidar: where the LiDAR is in them.
    """

    T_cloud_lidar: gtsam.Pose3 = field(default_factory=gtsam.Pose3)

    @classmethod
    def of(cls, timing: SweepTiming, T_cloud_lidar: gtsam.Pose3) -> TimingFromCloud:
        """The timing of a LiDAR for points that are not in its axes."""
        return cls(timing.fraction, timing.start_rad, timing.period_s, timing.stamp, T_cloud_lidar)

    def offsets_s(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Time (n,) of points (n, 3) in the cloud's axes [m] relative to the stamp [s]."""
        return super().offsets_s(_moved(points, self.T_cloud_lidar))


def in_lidar_axes(scan: Scan, T_cloud_lidar: gtsam.Pose3) -> Scan:
    """A scan moved to the LiDAR's axes. Lasers by its order are seen from there; recorded ones stay."""
    points = _moved(scan.points, T_cloud_lidar)
    rings = scan.rings
    # Readers number the lasers by the order of the points where the data do not.
    if rings is None or _is_by_order(rings, scan.points):
        by_order = rings_from_order(points)
        rings = rings if by_order is None else by_order
    return replace(scan, points=points, rings=rings)


def _is_by_order(rings: NDArray[np.uint16], points: NDArray[np.float32]) -> bool:
    """Whether rings (n,) are those that the order of the points (n, 3) shows from where these are."""
    by_order = rings_from_order(points)
    return by_order is not None and np.array_equal(rings, by_order)


class LidarFrameSource(ChangedSource):
    """A source whose clouds are moved to the LiDAR's axes as they are read; poses are of these axes."""

    def __init__(self, source: Source, T_cloud_lidar: gtsam.Pose3) -> None:
        self.source, self.T_cloud_lidar = source, T_cloud_lidar

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        """Nominal cTl of the data, of the LiDAR's axes."""
        nominal = self.source.nominal
        return None if nominal is None else nominal * self.T_cloud_lidar

    @property
    def truth(self) -> GroundTruth | None:
        """Truth, where the data bring it, of the LiDAR's axes."""
        truth = self.source.truth
        return None if truth is None else replace(truth, cTl=truth.cTl * self.T_cloud_lidar)

    def changed_scan(self, scan: Scan) -> Scan:
        """The scan in the LiDAR's axes."""
        return in_lidar_axes(scan, self.T_cloud_lidar)
