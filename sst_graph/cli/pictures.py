"""Overlays of a drive: which frames, moved by which motion, compared with what."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.frame_parts import RecentReader
from sst_graph.errors import DataError
from sst_graph.odometry.lidar import lidar_odometry
from sst_graph.result import CalibrationResult
from sst_graph.types import Frame, Scan, SemanticClass, Source
from sst_graph.viz import Placement, draw_overlay, stacked

FloatArray = NDArray[np.float64]


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
    raise DataError(drive.source.name, f"no frame {index}", f"one of its {len(drive)} frames")


def overlay(
    drive: RecentReader, position: int, result: CalibrationResult, before: Placement | None
) -> NDArray[np.uint8]:
    """Picture of one frame with the result, below ``before`` where there is one -> (h, w, 3) BGR.

    Raises:
        DataError: the frame lacks its scan or its image.
    """
    camera = drive.source.camera
    offset_s = _offset_of(result, drive.source)
    c_twist = camera_twist(drive, position, result.T_camera_lidar)
    frame, other_image = _at_true_time(drive, position, offset_s)
    caption = "after (image closest in time)" if other_image else "after"
    after = draw_overlay(frame, camera, result.T_camera_lidar, offset_s, c_twist, caption)
    if before is None:
        return after
    start = drive.frame(position), camera, before.cTl, before.time_offset_s, c_twist, before.caption
    return stacked(draw_overlay(*start), after)


def png(picture: NDArray[np.uint8]) -> bytes:
    """The picture (h, w, 3) BGR as the bytes of a PNG file."""
    _, data = cv2.imencode(".png", picture)
    return bytes(data)


def _at_true_time(drive: RecentReader, position: int, offset_s: float) -> tuple[Frame, bool]:
    """The frame, with the image that shows the instant of its scan best, and whether that is another one."""
    frame = drive.frame(position)
    neighbour = drive.scan(position - 1 if position else min(1, len(drive) - 1))
    scan, image = frame.scan, frame.image
    if scan is None or image is None or neighbour is None or neighbour.stamp_ns == scan.stamp_ns:
        return frame, False
    period_s = abs(scan.stamp_ns - neighbour.stamp_ns) * 1e-9
    guess = position - round(offset_s / period_s)
    nearby = range(max(0, guess - 1), min(len(drive), guess + 2))
    images = [image, *(other for other in map(drive.image, nearby) if other is not None)]
    best = min(images, key=lambda other: abs(other.stamp_ns * 1e-9 + offset_s - scan.stamp_ns * 1e-9))
    return replace(frame, image=best), best.stamp_ns != image.stamp_ns


def camera_twist(drive: RecentReader, position: int, cTl: gtsam.Pose3) -> FloatArray | None:
    """(6,) twist of the camera [rad/s, m/s] at a frame, by LiDAR odometry over it and its neighbours.

    None where the motion is unknown.
    """
    around = map(drive.scan, range(max(0, position - 1), min(len(drive), position + 2)))
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
        few = np.unique(np.linspace(0, len(part) - 1, 4).round().astype(np.int64)) if len(part) else part
        positions = [position_of(drive, int(index)) for index in part[few]]
        richest = sorted(positions, key=lambda position: -_vehicle_points(drive.scan(position)))
        whole = (p for p in richest if drive.scan(p) is not None and drive.image(p) is not None)
        chosen += list(itertools.islice(whole, 1))
    return chosen


def _vehicle_points(scan: Scan | None) -> int:
    """Number of vehicle points."""
    return 0 if scan is None else int(np.count_nonzero(scan.classes == int(SemanticClass.VEHICLE)))


def _offset_of(result: CalibrationResult, source: Source) -> float:
    """The drive's own offset where the result has one for each drive [s]."""
    own = {drive.drive: drive.time_offset_s for drive in result.drive_offsets}
    return own.get(source.name, result.time_offset_s)
