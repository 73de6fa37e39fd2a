"""Motion of the LiDAR along a drive whose frames are looked at in turn."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from sst_graph.data.frame_parts import RecentReader, scan_positions
from sst_graph.odometry.lidar import LidarOdometry
from sst_graph.types import FloatArray, RelativeMotion


class DriveOdometry:
    """LiDAR odometry that goes along as frames are asked for; each scan is registered once."""

    def __init__(self, drive: RecentReader) -> None:
        self._drive = drive
        self._positions = scan_positions(drive.source)
        self._odometry = LidarOdometry()
        self._motions: list[RelativeMotion | None] = []

    def l_twist(self, position: int) -> FloatArray | None:
        """(6,) twist of the LiDAR [rad/s, m/s] at the scan of a position; None where it is unknown."""
        at = bisect_left(self._positions, position)
        self._go_to(at + 1)
        around = self._motions[max(0, at) : at + 2]
        twists = [motion.mean_twist for motion in around if motion is not None and motion.ok]
        return np.asarray(np.mean(twists, axis=0)) if twists else None

    def _go_to(self, at: int) -> None:
        """Register the scans up to number ``at``: motion k leads to scan k, motion 0 to nothing."""
        while len(self._motions) <= min(at, len(self._positions) - 1):
            scan = self._drive.scan(self._positions[len(self._motions)])
            self._motions.append(None if scan is None else self._odometry.add(scan))
