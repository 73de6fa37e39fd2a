"""Overlays of a drive: which frames, moved by which motion, compared with what."""

from __future__ import annotations

import itertools
import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.cli.drive_odometry import DriveOdometry
from sst_graph.cli.output_places import PICTURE_SOFTWARE
from sst_graph.data.frame_parts import RecentReader, image_positions, scan_positions
from sst_graph.errors import DataError, count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.mask_contour import ContourMap
from sst_graph.fit import MatchedFrame, mask_biases_px
from sst_graph.odometry.lidar import lidar_odometry
from sst_graph.quality.frame_share import ClosePoints, close_points
from sst_graph.report.drawn_frame import DrawnFrame
from sst_graph.result import CalibrationResult
from sst_graph.sampling import evenly_spread
from sst_graph.types import CameraImage, FloatArray, Frame, Scan, SemanticClass, Source
from sst_graph.viz import Placement, draw_placement, stacked

_PNG_HEADER = 33
"""Bytes of a PNG's signature and of its first chunk, IHDR; texts may follow."""


def position_of(drive: RecentReader, index: int) -> int:
    """Position in the drive of the frame numbered ``index``.

    Raises:
        DataError: the drive has no such frame.
    """
    guess = index - drive.number(0)
    if 0 <= guess < len(drive) and drive.number(guess) == index:
        return guess
    for position in range(len(drive)):
        if drive.number(position) == index:
            return position
    raise DataError(drive.source.name, f"no frame {index}", f"one of its {count_of(len(drive), 'frame')}")


@dataclass(frozen=True)
class ShownFrame:
    """A frame to be drawn under a result.

    Attributes:
        source: that it is of.
        own: with its own image.
        frame: with the image that shows the instant of its scan best.
        other_image: whether that is another one.
        c_twist: (6,) of the camera [rad/s, m/s]; None where the motion is unknown.
        time_offset_s: the result's, of this drive [s].
    """

    source: Source
    own: Frame
    frame: Frame
    other_image: bool
    c_twist: FloatArray | None
    time_offset_s: float

    @classmethod
    def of(
        cls,
        drive: RecentReader,
        position: int,
        result: CalibrationResult,
        motion: DriveOdometry | None = None,
    ) -> ShownFrame:
        """The frame at a position of the drive.

        Args:
            motion: along the drive, where its frames are drawn in turn; else that of its neighbours is found.
        """
        time_offset_s, cTl = result.time_offset_of(drive.source.name), result.T_camera_lidar
        if motion is None:
            c_twist = camera_twist(drive, position, cTl)
        else:
            l_twist = motion.l_twist(position)
            c_twist = None if l_twist is None else np.asarray(cTl.AdjointMap() @ l_twist)
        frame, other_image = _at_true_time(drive, position, time_offset_s)
        own = _whole(drive, drive.frame(position), 0.0)
        return cls(drive.source, own, frame, other_image, c_twist, time_offset_s)

    def drawn(self) -> DrawnFrame | None:
        """For the report of a result without a fit; None without scan or picture."""
        frame = self.frame
        if frame.scan is None or frame.image is None or not frame.image.has_picture:
            return None
        base_tau_s = (frame.image.stamp_ns - frame.scan.stamp_ns) * 1e-9
        twist = np.zeros(6) if self.c_twist is None else self.c_twist
        names = self.source.name, frame.index, frame.index
        pair = MatchedFrame(*names, base_tau_s, twist, np.zeros(6))
        return DrawnFrame(pair, frame.scan, frame.image, self.source.camera)


@dataclass(frozen=True, eq=False)
class Overlay:
    """A frame with the LiDAR drawn into it.

    Attributes:
        picture: (h, w, 3) BGR.
        after: close points under the result; None of a frame without labels.
        before: the same under what it is compared with; None without.
    """

    picture: NDArray[np.uint8]
    after: ClosePoints | None
    before: ClosePoints | None


def overlay(shown: ShownFrame, result: CalibrationResult, before: Placement | None) -> Overlay:
    """One frame with the result, below ``before`` where there is one.

    Raises:
        DataError: the frame lacks its scan or its image.
    """
    camera, c_twist = shown.source.camera, shown.c_twist
    own = EstimatedCamera.of(result) if result.camera == camera else camera
    bias_px = mask_biases_px(result.diagnostics, shown.source.name).get(SemanticClass.VEHICLE, 0.0)
    at = Placement(
        result.T_camera_lidar,
        shown.time_offset_s,
        "after (image closest in time)" if shown.other_image else "after",
    )
    after, close = _drawn(shown.frame, own, at, c_twist, bias_px)
    if before is None:
        return Overlay(after, close, None)
    above, close_before = _drawn(shown.own, camera, before, c_twist, bias_px)
    return Overlay(stacked(above, after), close, close_before)


def _drawn(
    frame: Frame,
    camera: PinholeCamera,
    at: Placement,
    c_twist: FloatArray | None,
    bias_px: float,
) -> tuple[NDArray[np.uint8], ClosePoints | None]:
    """The picture of a placement, its close points in the caption, and these."""
    contour = None if frame.image is None else ContourMap.in_image(frame.image, SemanticClass.VEHICLE)
    close = close_points(frame, contour, camera, at, c_twist, bias_px)
    captioned = at if close is None else replace(at, caption=f"{at.caption}: {close.words}")
    return draw_placement(frame, contour, camera, captioned, c_twist), close


def close_words(after: ClosePoints | None, before: ClosePoints | None) -> str:
    """Close points of pictures for a line on a terminal; empty without labels."""
    if after is None:
        return ""
    if not after.points or before is None or not before.points:
        return f"; {after.words}"
    return f"; {after.words} (before: {100.0 * before.close / before.points:.0f} %)"


def png(picture: NDArray[np.uint8]) -> bytes:
    """The picture (h, w, 3) BGR as the bytes of a PNG file that names this program."""
    data = bytes(cv2.imencode(".png", picture)[1])
    content = b"tEXt" + PICTURE_SOFTWARE
    chunk = struct.pack(f">I{len(content)}sI", len(PICTURE_SOFTWARE), content, zlib.crc32(content))
    return data[:_PNG_HEADER] + chunk + data[_PNG_HEADER:]


def _at_true_time(drive: RecentReader, position: int, time_offset_s: float) -> tuple[Frame, bool]:
    """The frame, with the image that shows the instant of its scan best, and whether that is another one."""
    frame = drive.frame(position)
    if frame.scan is None or frame.image is None:
        return _whole(drive, frame, time_offset_s), False
    scan, image = frame.scan, frame.image
    if hasattr(drive.source, "image_positions"):
        stamp_ns = scan.stamp_ns - round(time_offset_s * 1e9)
        nearest = _closest(drive.image, image_positions(drive.source), stamp_ns) or image
        return replace(frame, image=nearest), nearest.stamp_ns != image.stamp_ns
    neighbour = drive.scan(position - 1 if position else min(1, len(drive) - 1))
    if neighbour is None or neighbour.stamp_ns == scan.stamp_ns:
        return frame, False
    period_s = abs(scan.stamp_ns - neighbour.stamp_ns) * 1e-9
    guess = position - round(time_offset_s / period_s)
    nearby = range(max(0, guess - 1), min(len(drive), guess + 2))
    images = [image, *(other for other in map(drive.image, nearby) if other is not None)]
    best = min(images, key=lambda other: abs(other.stamp_ns * 1e-9 + time_offset_s - scan.stamp_ns * 1e-9))
    return replace(frame, image=best), best.stamp_ns != image.stamp_ns


def _whole(drive: RecentReader, frame: Frame, time_offset_s: float) -> Frame:
    """The frame; a part that it lacks is that of the source's frames of the other sensor closest in time.

    Where a source's frames may have both, nothing is added.
    """
    apart = hasattr(drive.source, "image_positions")
    images, scans = image_positions(drive.source), scan_positions(drive.source)
    if frame.scan is not None and frame.image is None and apart:
        return replace(
            frame, image=_closest(drive.image, images, frame.scan.stamp_ns - round(time_offset_s * 1e9))
        )
    if frame.image is not None and frame.scan is None and apart:
        return replace(
            frame, scan=_closest(drive.scan, scans, frame.image.stamp_ns + round(time_offset_s * 1e9))
        )
    return frame


T = TypeVar("T", Scan, CameraImage)


def _closest(at: Callable[[int], T | None], positions: Sequence[int], stamp_ns: int) -> T | None:
    """What is closest in time to a stamp, by bisection of positions whose stamps rise."""

    def stamp(position: int) -> int:
        found = at(position)
        return stamp_ns if found is None else found.stamp_ns

    after = bisect_left(positions, stamp_ns, key=stamp)
    nearby = (at(position) for position in positions[max(0, after - 1) : after + 1])
    return min(
        (one for one in nearby if one is not None), key=lambda o: abs(o.stamp_ns - stamp_ns), default=None
    )


def camera_twist(drive: RecentReader, position: int, cTl: gtsam.Pose3) -> FloatArray | None:
    """(6,) twist of the camera [rad/s, m/s] at a frame, by LiDAR odometry over it and its neighbours.

    None where the motion is unknown.
    """
    positions = scan_positions(drive.source)
    at = bisect_left(positions, position)
    around = map(drive.scan, positions[max(0, at - 1) : at + 2])
    motions = lidar_odometry(scan for scan in around if scan is not None)
    l_twists = [motion.mean_twist for motion in motions if motion.ok]
    if not l_twists:
        return None
    return np.asarray(cTl.AdjointMap() @ np.mean(l_twists, axis=0))


def telling_positions(drive: RecentReader, result: CalibrationResult, count: int) -> list[int]:
    """Up to ``count`` positions spread over the frames used, each the richest in vehicles of a few."""
    used = sorted(frame.frame for frame in result.frames_used if frame.drive == drive.source.name)
    chosen = []
    for part in np.array_split(np.array(used, dtype=np.int64), max(1, min(count, len(used)))):
        positions = [position_of(drive, index) for index in evenly_spread(part.tolist(), 4)]
        richest = sorted(positions, key=lambda position: -_vehicle_points(drive.scan(position)))
        frames = ((p, _whole(drive, drive.frame(p), 0.0)) for p in richest)
        whole = (p for p, frame in frames if frame.scan is not None and frame.image is not None)
        chosen += list(itertools.islice(whole, 1))
    return chosen


def _vehicle_points(scan: Scan | None) -> int:
    """Number of vehicle points."""
    return 0 if scan is None else int(np.count_nonzero(scan.classes == int(SemanticClass.VEHICLE)))
