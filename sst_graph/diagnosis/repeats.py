"""Sensors that deliver one frame again and again, clouds that hold the points of earlier scans, drives that
hold scans of one another."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from sst_graph.diagnosis.finding import Finding
from sst_graph.diagnosis.units import rounded_share
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of

_LEAST, _LEAST_SHARE = 3, 0.1
"""Equal frames in a row, or frames equal to the one before them and their share of the drive: a doubled one
now and then is left to the robust matching."""
_SHARED = 0.2
"""Of the points of a scan that the scan before has, too, to the last bit: 0 of a moving HDL-64E, up to 0.06
of a standing one, whose ranges come in steps; a half of two scans in one cloud."""
_MOST_ROUNDED = 0.001
"""Step of rounded coordinates, as a share of the median range, above which points of two scans may be equal
by chance: 0.00015 of an HDL-64E; at walking pace 0.003, which are 2 cm, are enough for :data:`_SHARED`."""
_HELD_SHARE = 0.2
"""Of the shorter of the motions before and after it that a scan moves at most, to be the one before it once
more. Without this check such drives are told that their stamps run too slowly, by impossible accelerations. A
vehicle that stops between two scans and goes on is none; a single failed registration is not enough."""
_LEAST_SAMPLE = 20
"""Points by which two scans are compared."""
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
    of_scans, of_images = (
        [k for k in _equal_to_former(digests) if moves(drive, k - 1, 2)]
        for digests, moves in ((scans, _pictures_move), (images, _lidar_moves))
    )
    for what, found, total, check in (
        ("scan", of_scans, len(scans), "the LiDAR's driver and its recording"),
        ("picture", of_images, len(images), "the camera's driver and its recording"),
    ):
        if len(found) >= max(_LEAST, _LEAST_SHARE * total):
            return Finding(
                f"{what}s are repeated (a sensor that is slower than its frames, or a frozen one)",
                f"{len(found)} of {total} equal the one before to the last bit where the other sensor moves",
                f"look at {check}, and leave those frames out",
            )
    return _held_scans(drive) or _earlier_points(drive)


def shared_scans(drives: Sequence[Drive]) -> Finding | None:
    """Drives that hold the same scans to the last bit: what is counted twice makes the sigmas too small."""
    scans = [
        {(scan.digest, scan.sample.tobytes()) for scan in drive.statistics.scans if scan.digest}
        if drive.statistics is not None
        else set()
        for drive in drives
    ]
    for (one, a), (other, b) in combinations(zip(drives, scans, strict=True), 2):
        if a & b:
            return Finding(
                "the same scans are given twice",
                f"{other.name} has {count_of(len(a & b), 'scan')} of {one.name}, too, to the last bit",
                "give each frame once: counted twice it makes the sigmas too small",
            )
    return None


def _held_scans(drive: Drive) -> Finding | None:
    """Scans of one turn again, which differ in single points, by noise or by what was done to them: the LiDAR
    stands still between two scans, and moves before and after."""
    motions = drive.lidar_motions
    lengths = np.array([float(np.linalg.norm(m.aTb.translation())) if m.ok else np.nan for m in motions])
    around = np.minimum(lengths[:-2], lengths[2:])
    held = np.count_nonzero((around > _MOVED_M) & (lengths[1:-1] < _HELD_SHARE * around))
    if held < max(_LEAST, _LEAST_SHARE * len(lengths)):
        return None
    return Finding(
        "scans are repeated (a sensor that is slower than its frames), with other noise",
        f"{held} of {len(lengths)} are where the one before was, though the LiDAR moves before and after",
        "look at the LiDAR's driver and its recording, and leave those frames out",
    )


def _earlier_points(drive: Drive) -> Finding | None:
    """Clouds that hold the points of the scan before, as they were: several scans laid over each other."""
    assert drive.statistics is not None
    if rounded_share(drive) > _MOST_ROUNDED:
        return None
    samples = [scan.sample for scan in drive.statistics.scans]
    shares = [
        len(np.intersect1d(a, b, assume_unique=True)) / len(b)
        for k, (a, b) in enumerate(pairwise(samples))
        if len(b) >= _LEAST_SAMPLE and _pictures_move(drive, k, 2)
    ]
    if len(shares) < _LEAST or float(np.median(shares)) < _SHARED:
        return None
    return Finding(
        "the clouds are several scans laid over each other",
        f"{100.0 * float(np.median(shares)):.0f} % of a scan's points stand in the scan before, too, to the "
        "last bit, though the vehicle moves",
        "give each turn of the scanner as a cloud of its own, with its own stamp",
    )


def _equal_to_former(digests: Sequence[int]) -> list[int]:
    """Positions of frames that are equal to the one before."""
    return [k for k in range(1, len(digests)) if digests[k] == digests[k - 1] != 0]


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
        if digests[i] != digests[begin] or not digests[i]:
            begin = i
        if i - begin + 1 > best[1]:
            best = (begin, i - begin + 1)
    return best


def _pictures_move(drive: Drive, first: int, count: int) -> bool:
    """Whether corners move in most pictures of a run of scans; yes where they are not tracked."""
    assert drive.statistics is not None
    scans = drive.statistics.scans
    begin, end = scans[first].stamp_ns, scans[first + count - 1].stamp_ns
    tracks = [p.tracks for p in drive.image_pairs if begin <= p.tracks.from_ns < end and len(p.tracks)]
    if not tracks:
        return len({image.picture_digest for image in drive.statistics.images}) > 1
    sizes = [float(np.median(np.linalg.norm(t.uv_b - t.uv_a, axis=1))) for t in tracks]
    return bool(np.mean(np.array(sizes) > _MOVED_PX) > 0.3)


def _lidar_moves(drive: Drive, first: int, count: int) -> bool:
    assert drive.statistics is not None
    images = drive.statistics.images
    begin, end = images[first].stamp_ns, images[first + count - 1].stamp_ns
    moves = [
        float(np.linalg.norm(motion.aTb.translation()))
        for motion in drive.lidar_motions
        if motion.ok and begin <= motion.from_ns < end
    ]
    return bool(moves) and bool(np.mean(np.array(moves) > _MOVED_M) > 0.3)
