"""Visual odometry: FAST corners, Lucas-Kanade tracks, five points, metric by LiDAR depth.

The expensive part, :func:`image_pairs`, depends on no calibration and is done once; the metric part,
:func:`metric_motions`, is cheap and repeated whenever extrinsic and time offset have moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import FeatureTracker, Tracks
from sst_graph.odometry.metric import metric_motion
from sst_graph.odometry.relative import DirectionMotion, relative_pose
from sst_graph.types import CameraImage, RelativeMotion

FloatArray = NDArray[np.float64]

DepthProvider = Callable[[int], FloatArray]
"""For the position of an image: (m, 3) LiDAR points in the camera at that image's instant [m]."""


@dataclass(frozen=True)
class ImagePair:
    """What two consecutive images determine without any calibration between the sensors.

    Attributes:
        tracks: corners of the first found again in the second.
        direction: rotation and direction of the camera's motion.
    """

    tracks: Tracks
    direction: DirectionMotion


class VisualOdometry:
    """Camera motion, image by image; keeps the last image, its depth and the last motion."""

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = camera
        self._tracker = FeatureTracker()
        self._depth = np.zeros((0, 3))
        self._last: RelativeMotion | None = None

    def add(self, image: CameraImage, depth_points_c: FloatArray) -> RelativeMotion | None:
        """Motion from the image before to this one; None for the first.

        Args:
            image: next image.
            depth_points_c: (m, 3) LiDAR points in the camera at this image's instant [m];
                they give the length of the *next* motion.

        Raises:
            DataError: the image is not later than the one before, or of another size.
        """
        tracks = self._tracker.add(image)
        depth, self._depth = self._depth, depth_points_c
        if tracks is None:
            return None
        pair = ImagePair(tracks, relative_pose(tracks, self.camera))
        motion = metric_motion(tracks, pair.direction, depth, self.camera)
        self._last = _predicted(motion, self._last)
        return self._last


def image_pairs(images: Iterable[CameraImage], camera: PinholeCamera) -> list[ImagePair]:
    """Tracks and directions between consecutive images: one fewer than images.

    Raises:
        DataError: stamps that do not rise, or images of different sizes.
    """
    tracker = FeatureTracker()
    found = (tracker.add(image) for image in images)
    return [ImagePair(tracks, relative_pose(tracks, camera)) for tracks in found if tracks is not None]


def metric_motions(
    pairs: Sequence[ImagePair],
    camera: PinholeCamera,
    depth_provider: DepthProvider,
) -> list[RelativeMotion]:
    """Metric motion of each pair with the depth that the present calibration gives its first image."""
    motions: list[RelativeMotion] = []
    for position, pair in enumerate(pairs):
        depth = depth_provider(position)
        motion = metric_motion(pair.tracks, pair.direction, depth, camera)
        motions.append(_predicted(motion, motions[-1] if motions else None))
    return motions


def visual_odometry(
    images: Iterable[CameraImage],
    camera: PinholeCamera,
    depth_provider: DepthProvider,
) -> list[RelativeMotion]:
    """Camera motions between consecutive images, :func:`image_pairs` and :func:`metric_motions` in one."""
    return metric_motions(image_pairs(images, camera), camera, depth_provider)


def _predicted(motion: RelativeMotion, last: RelativeMotion | None) -> RelativeMotion:
    """The motion itself, or, where it failed, its rotation with the last motion's velocity."""
    if motion.ok or last is None:
        return motion
    translation = last.aTb.translation() * (motion.seconds / last.seconds)
    return replace(motion, aTb=gtsam.Pose3(motion.aTb.rotation(), translation))
