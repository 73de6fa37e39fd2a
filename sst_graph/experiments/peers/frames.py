"""What the peers are given: scans moved to the instants of their images, with the true time offset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.frame_parts import number_at, scan_at
from sst_graph.drive.preparation import Drive
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.lidar_beams import arrange_beams
from sst_graph.points import transformed_points
from sst_graph.sampling import evenly_spread
from sst_graph.types import (
    CameraImage,
    FloatArray,
    RelativeMotion,
    Scan,
    SemanticClass,
    Source,
    intensities_of,
)

FARTHEST_M, NEAREST_M = 80.0, 2.0
"""Points outside are left out [m]."""


@dataclass(frozen=True, eq=False)
class PeerFrame:
    """One image and the points of one scan, all at the image's instant.

    Attributes:
        camera: of the image.
        lPs: (n, 3) points in the LiDAR frame [m].
        jumps: (n,) of :func:`range_jumps` [m].
        intensities: (n,) strength of the returns, 0 to 1, or None where the data tell none.
        classes: (n,) of :class:`SemanticClass`.
        grey: (h, w) uint8 grey picture.
        mask: (h, w) uint8 of :class:`SemanticClass`.
        instances: (h, w) instance numbers within a class (0: none), or None.
    """

    camera: PinholeCamera
    lPs: FloatArray
    jumps: FloatArray
    intensities: FloatArray | None
    classes: NDArray[np.uint8]
    grey: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None

    def pixels(self, cTl: gtsam.Pose3, lPs: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Indices (m,) of points (n, 3) that fall on the image, and their pixels (m, 2) [px]."""
        cPs = transformed_points(cTl, lPs)
        ahead = np.flatnonzero(self.camera.in_front(cPs))
        uvs = self.camera.project(cPs[ahead])
        inside = self.camera.in_image(uvs)
        return ahead[inside], uvs[inside]


@dataclass(frozen=True, eq=False)
class PeerProblem:
    """What a peer may look at.

    Attributes:
        frames: images with points.
        drive: the whole drive, for those that use its motion.
        time_offset_s: the true one [s].
        range_deg, range_m: half widths of the starts' errors, for those that must be told [deg], [m].
        samples: poses of each random search.
        seed: of all that is sampled.
    """

    frames: Sequence[PeerFrame]
    drive: Drive
    time_offset_s: float
    range_deg: float = 0.0
    range_m: float = 0.0
    samples: int = 1000
    seed: int = 0


Peer = Callable[[PeerProblem, gtsam.Pose3], gtsam.Pose3]
"""Refines a start; raises an EstimationError where it cannot."""


def moved_by(cTl: gtsam.Pose3, step: Sequence[float] | FloatArray) -> gtsam.Pose3:
    """The extrinsic moved in its tangent space by (6,) [rad, m]."""
    return cTl.retract(np.asarray(step, dtype=np.float64))


def peer_frames(
    source: Source, drive: Drive, time_offset_s: float, count: int, pictures: Source | None = None
) -> list[PeerFrame]:
    """At most ``count`` frames, evenly over those images whose instant the LiDAR's motion covers.

    An image of stamp t shows LiDAR time t + ``time_offset_s``; the scan nearest to it is moved
    there by the LiDAR's odometry.

    Args:
        pictures: the same drive with its instances, where ``source`` leaves them out.

    Raises:
        DataError: no image has a picture and a scan.
    """
    stamps = np.array(drive.scan_stamps_ns)
    shown = [(image, image.stamp_ns + round(1e9 * time_offset_s)) for image in drive.images]
    half_ns = round(0.5e9 * drive.scan_period_s)
    covered = [one for one in shown if stamps[0] - half_ns <= one[1] <= stamps[-1] + half_ns]
    positions = {number_at(source, k): k for k in range(len(source))}
    frames = []
    for image, instant_ns in evenly_spread(covered, count):
        nearest = drive.scans[int(np.abs(stamps - instant_ns).argmin())]
        scan = scan_at(source, positions[nearest.index])
        # Read as a frame: apart, an image may come without its instances.
        picture = (pictures or source)[positions[image.index]].image
        assert scan is not None and picture is not None
        if picture.has_picture:
            twist = _twist_at(drive.lidar_motions, instant_ns)
            frames.append(_frame(drive.camera, scan, picture, instant_ns, twist))
    if not frames:
        raise DataError(source.name, "no image with a picture and a scan", "some")
    return frames


def _twist_at(motions: Sequence[RelativeMotion], instant_ns: int) -> FloatArray:
    """(6,) mean twist of the LiDAR over the interval around an instant [rad/s, m/s]."""
    if not motions:
        return np.zeros(6)
    gaps = [max(motion.from_ns - instant_ns, instant_ns - motion.to_ns, 0) for motion in motions]
    return motions[int(np.argmin(gaps))].mean_twist


def _frame(
    camera: PinholeCamera, scan: Scan, image: CameraImage, instant_ns: int, twist: FloatArray
) -> PeerFrame:
    points = scan.points.astype(np.float64)
    seconds = np.full(len(points), (instant_ns - scan.stamp_ns) * 1e-9)
    if scan.offsets_s is not None:
        seconds = seconds - scan.offsets_s
    # To first order: an interval is at most a turn of the scanner.
    moved = points - seconds[:, None] * (np.cross(twist[:3], points) + twist[3:])
    distance = np.linalg.norm(points, axis=1)
    used = (distance > NEAREST_M) & (distance < FARTHEST_M)
    intensities = intensities_of(scan)
    if intensities is not None and np.ptp(intensities) > 0.0:
        largest = float(np.max(intensities))
        scaled = intensities[used].astype(np.float64) / largest
    else:
        scaled = None
    return PeerFrame(
        camera,
        moved[used],
        range_jumps(points, scan.rings)[used],
        scaled,
        scan.classes[used],
        np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY)),
        np.where(image.mask == SemanticClass.IGNORE, SemanticClass.OTHER, image.mask).astype(np.uint8),
        image.instances,
    )


def range_jumps(points: FloatArray, rings: NDArray[np.integer] | None) -> FloatArray:
    """(n,) by how much a neighbour on the scan line is farther than the point, beyond a slope; 0 or more [m].

    A slope is where the other neighbour is as much nearer: a wall at a shallow angle has no jump.
    """
    beams = arrange_beams(points, rings)
    distance = np.linalg.norm(points, axis=1)[beams.order]
    ring, azimuth = beams.ring[beams.order], beams.azimuth[beams.order]
    # Neighbours: of the same ring, and no more than three steps away.
    joined = (np.diff(ring) == 0) & (np.diff(azimuth) < 3.0 * beams.step)
    ahead = np.append(np.where(joined, np.diff(distance), 0.0), 0.0)
    behind = np.append(0.0, np.where(joined, -np.diff(distance), 0.0))
    beyond = np.maximum(ahead - np.maximum(-behind, 0.0), behind - np.maximum(-ahead, 0.0))
    jumps = np.zeros(len(points))
    jumps[beams.order] = np.maximum(beyond, 0.0)
    return jumps
