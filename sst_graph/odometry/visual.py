"""Visual odometry: FAST corners, Lucas-Kanade tracks, five points, metric by LiDAR depth.

The expensive part, :func:`next_pair`, depends on no calibration and is done once; the metric part,
:func:`metric_motions`, is cheap and repeated whenever extrinsic and time offset have moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam

from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import FeatureTracker, Tracks
from sst_graph.odometry.metric import metric_motion
from sst_graph.odometry.relative import DirectionMotion, relative_pose
from sst_graph.types import CameraImage, FloatArray, RelativeMotion

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


def next_pair(
    tracker: FeatureTracker, image: CameraImage, camera: PinholeCamera, interval_s: float
) -> ImagePair | None:
    """The last tracked image and this one; None for the first, and where it follows sooner than interval_s.

    Raises:
        DataError: the image is not later than the one before, or of another size.
    """
    if tracker.seconds_to(image) < interval_s:
        return None
    tracks = tracker.add(image)
    return None if tracks is None else ImagePair(tracks, relative_pose(tracks, camera))


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


def _predicted(motion: RelativeMotion, last: RelativeMotion | None) -> RelativeMotion:
    """The motion itself, or, where it failed, its rotation with the last motion's velocity."""
    if motion.ok or last is None:
        return motion
    translation = last.aTb.translation() * (motion.seconds / last.seconds)
    return replace(motion, aTb=gtsam.Pose3(motion.aTb.rotation(), translation))
