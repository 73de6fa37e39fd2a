"""Sensors that deliver one frame again and again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.preparation import Drive

_LEAST = 3
"""Equal frames in a row: a doubled one now and then is left to the robust matching."""
_MOVED_PX, _MOVED_M = 1.0, 0.05
"""What the other sensor sees move from frame to frame: recorded without noise, equal frames of a standing
vehicle are right."""


def repeats(drive: Drive) -> Finding | None:
    """Scans or pictures that stay the same to the last bit while the other sensor sees motion."""
    if drive.statistics is None:
        return None
    scans = [scan.digest for scan in drive.statistics.scans]
    first, count = _longest(scans)
    if count >= _LEAST and _pictures_move(drive, first, count):
        frame = drive.statistics.scans[first].index
        return _finding("scan", frame, count, "the pictures move", "the LiDAR's driver and its recording")
    images = [image.picture_digest for image in drive.statistics.images]
    first, count = _longest(images)
    if count >= _LEAST and _lidar_moves(drive, first, count):
        frame = drive.statistics.images[first].index
        return _finding("picture", frame, count, "the LiDAR moves", "the camera's driver and its recording")
    return None


def _finding(what: str, frame: int, count: int, other: str, check: str) -> Finding:
    return Finding(
        f"one {what} is repeated (a frozen sensor)",
        f"{count} in a row from frame {frame} are equal to the last bit while {other}",
        f"look at {check}, and leave those frames out",
    )


def _longest(digests: Sequence[int]) -> tuple[int, int]:
    """Where the longest run of equal digests begins, and its length."""
    best, begin = (0, 1), 0
    for i in range(1, len(digests)):
        if digests[i] != digests[begin]:
            begin = i
        if i - begin + 1 > best[1]:
            best = (begin, i - begin + 1)
    return best


def _pictures_move(drive: Drive, first: int, count: int) -> bool:
    """Whether corners move in most pictures of a run of scans; yes where they are not tracked."""
    begin, end = drive.scan_stamps_ns[first], drive.scan_stamps_ns[first + count - 1]
    tracks = [p.tracks for p in drive.image_pairs if begin <= p.tracks.from_ns < end and len(p.tracks)]
    if not tracks:
        assert drive.statistics is not None
        return len({image.picture_digest for image in drive.statistics.images}) > 1
    sizes = [float(np.median(np.linalg.norm(t.uv_b - t.uv_a, axis=1))) for t in tracks]
    return bool(np.mean(np.array(sizes) > _MOVED_PX) > 0.3)


def _lidar_moves(drive: Drive, first: int, count: int) -> bool:
    stamps = drive.image_stamps_ns
    begin, end = stamps[first], stamps[first + count - 1]
    moves = [
        float(np.linalg.norm(motion.aTb.translation()))
        for motion in drive.lidar_motions
        if motion.ok and begin <= motion.from_ns < end
    ]
    return bool(moves) and bool(np.mean(np.array(moves) > _MOVED_M) > 0.3)
