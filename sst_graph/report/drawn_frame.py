"""A scan and an image that are drawn together: where points land under a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.data.frame_parts import RecentReader
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import CameraTwist, move_points
from sst_graph.fit import MatchedFrame
from sst_graph.types import CameraImage, FloatArray, Scan, Source


@dataclass(frozen=True)
class DrawnFrame:
    """A scan, an image and the motion between them.

    Attributes:
        frame: what they are.
        scan, image: themselves.
        camera: of the image.
    """

    frame: MatchedFrame
    scan: Scan
    image: CameraImage
    camera: PinholeCamera

    def through(self, camera: PinholeCamera) -> DrawnFrame:
        """The frame with its points projected by another camera of the same pictures."""
        same = (camera.width, camera.height) == (self.camera.width, self.camera.height)
        return replace(self, camera=camera) if same else self

    def projected(self, cTl: gtsam.Pose3, time_offset_s: float) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels of the scan's points, NaN behind the camera, and their depths (n,) [px], [m]."""
        taus = np.full(len(self.scan.points), time_offset_s + self.frame.base_tau_s)
        if self.scan.offsets_s is not None:
            taus -= self.scan.offsets_s
        return self.placed(self.scan.points.astype(np.float64), taus, cTl)

    def placed(self, lPs: FloatArray, taus_s: FloatArray, cTl: gtsam.Pose3) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels of points (n, 3) in the LiDAR frame, NaN behind the camera, and their depths (n,).

        Args:
            taus_s: (n,) from the instant of each point to that of the image [s].
        """
        each = (np.repeat(a[:, None], len(lPs), 1) for a in (self.frame.c_twist, self.frame.c_acceleration))
        columns = np.ascontiguousarray(lPs.T)
        cPs = np.asarray(move_points(cTl, columns, taus_s, CameraTwist(*each)).cPs).T
        return self.camera.project(cPs), cPs[:, 2]


class DriveReader:
    """Scans and images of several drives, by the drive's name and the frame's number."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._drives = {source.name: RecentReader(source) for source in sources}
        self._positions: dict[str, dict[int, int]] = {}

    def frame(self, frame: MatchedFrame) -> DrawnFrame | None:
        """Scan and image of a frame; None where one is not there, or without a picture."""
        scan, image = self._at(frame.drive, frame.scan), self._at(frame.drive, frame.image)
        if scan is None or image is None:
            return None
        drive = self._drives[frame.drive]
        points, picture = drive.scan(scan), drive.image(image)
        if points is None or picture is None or not picture.has_picture:
            return None
        return DrawnFrame(frame, points, picture, drive.source.camera)

    def _at(self, name: str, number: int) -> int | None:
        if name not in self._drives:
            return None
        if name not in self._positions:
            drive = self._drives[name]
            self._positions[name] = {drive.number(k): k for k in range(len(drive))}
        return self._positions[name].get(number)
