"""Visual odometry: FAST corners, Lucas-Kanade tracks, five points, metric by LiDAR depth.

The expensive part, :func:`image_pairs`, depends on no calibration and is done once; the metric part,
:func:`metric_motions`, is renewed cheaply whenever extrinsic and time offset have moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import FeatureConfig, FeatureTracker, Tracks
from sst_graph.odometry.metric import MetricConfig, metric_motion
from sst_graph.odometry.relative import DirectionMotion, RelativeConfig, relative_pose
from sst_graph.types import CameraImage, RelativeMotion

FloatArray = NDArray[np.float64]

DepthProvider = Callable[[int], FloatArray]
"""For the position of an image: (m, 3) LiDAR points in the camera at that image's instant [m]."""


@dataclass(frozen=True)
class VisualOdometryConfig(Settings):
    """The stages of visual odometry.

    Attributes:
        features: corners and tracks.
        relative: rotation and direction.
        metric: length and covariance.
    """

    features: FeatureConfig = field(default_factory=FeatureConfig)
    relative: RelativeConfig = field(default_factory=RelativeConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)


@dataclass(frozen=True)
class ImagePair:
    """What two consecutive images tell without any calibration between sensors.

    Attributes:
        tracks: corners of the first found again in the second.
        direction: rotation and direction of the camera's motion.
    """

    tracks: Tracks
    direction: DirectionMotion


class VisualOdometry:
    """Camera motion, image by image; keeps the last image, its depth and the last motion."""

    def __init__(self, camera: PinholeCamera, config: VisualOdometryConfig | None = None) -> None:
        self.camera = camera
        self.config = config or VisualOdometryConfig()
        self._tracker = FeatureTracker(self.config.features)
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
        pair = ImagePair(tracks, relative_pose(tracks, self.camera, self.config.relative))
        motion = metric_motion(tracks, pair.direction, depth, self.camera, self.config.metric)
        self._last = _predicted(motion, self._last)
        return self._last


def image_pairs(
    images: Iterable[CameraImage], camera: PinholeCamera, config: VisualOdometryConfig | None = None
) -> list[ImagePair]:
    """Tracks and directions between consecutive images: one fewer than images.

    Raises:
        DataError: stamps that do not rise, or images of different sizes.
    """
    config = config or VisualOdometryConfig()
    tracker = FeatureTracker(config.features)
    found = (tracker.add(image) for image in images)
    return [
        ImagePair(tracks, relative_pose(tracks, camera, config.relative))
        for tracks in found
        if tracks is not None
    ]


def metric_motions(
    pairs: Sequence[ImagePair],
    camera: PinholeCamera,
    depth_provider: DepthProvider,
    config: VisualOdometryConfig | None = None,
) -> list[RelativeMotion]:
    """Metric motion of each pair with the depth that the present calibration gives its first image."""
    config = config or VisualOdometryConfig()
    motions: list[RelativeMotion] = []
    for position, pair in enumerate(pairs):
        depth = depth_provider(position)
        motion = metric_motion(pair.tracks, pair.direction, depth, camera, config.metric)
        motions.append(_predicted(motion, motions[-1] if motions else None))
    return motions


def visual_odometry(
    images: Iterable[CameraImage],
    camera: PinholeCamera,
    depth_provider: DepthProvider,
    config: VisualOdometryConfig | None = None,
) -> list[RelativeMotion]:
    """Camera motions between consecutive images, :func:`image_pairs` and :func:`metric_motions` in one."""
    return metric_motions(image_pairs(images, camera, config), camera, depth_provider, config)


def _predicted(motion: RelativeMotion, last: RelativeMotion | None) -> RelativeMotion:
    """The motion itself, or, where it failed, its rotation with the last motion's velocity."""
    if motion.ok or last is None:
        return motion
    translation = last.aTb.translation() * (motion.seconds / last.seconds)
    return replace(motion, aTb=gtsam.Pose3(motion.aTb.rotation(), translation))
