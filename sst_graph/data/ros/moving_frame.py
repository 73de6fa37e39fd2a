"""Clouds in a frame that does not move with the vehicle: those of odometry and mapping nodes.

Such nodes publish scans moved to where the drive began (registered clouds). The camera's pose in them changes
from scan to scan, so they show no extrinsic.
"""

from __future__ import annotations

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError

_FIXED = frozenset(
    (
        *("odom", "map", "world", "earth", "global", "local", "init", "enu", "ned", "utm", "local_origin"),
        *("camera_init", "lidar_init", "laser_init", "lio_init", "camera_odom", "lidar_odom", "vio_odom"),
    )
)
"""Names of frames that stay where the drive, or the world, begins: of REP 105, LOAM and its heirs."""
_ENDINGS = ("_frame", "_link")
_TAKE = "the topic of the LiDAR's driver (--cloud-topic)"


def check_moves_along(cloud_frame: str, image_frame: str, transforms: Transforms, place: str) -> str:
    """What is wrong with the frame of the clouds, as far as it is not certain; empty where nothing is.

    Args:
        place: of the clouds, for errors.

    Raises:
        DataError: the frame is one that stays in the world, by its name and by transforms that move.
    """
    moves, fixed = transforms.moves(cloud_frame, image_frame), _is_fixed(cloud_frame)
    if moves and fixed:
        found = f"clouds in the frame {cloud_frame!r}, which moves against the vehicle"
        raise DataError(place, found, f"clouds in the frame of the LiDAR: {_TAKE}")
    if fixed:
        return f"the clouds' frame {cloud_frame!r} is called as one that stays in the world: take {_TAKE}"
    if moves and transforms.connected(cloud_frame, image_frame):
        why = f"by transforms the clouds' frame {cloud_frame!r} moves against the images' {image_frame!r}"
        return f"{why}: take {_TAKE} of a LiDAR that is fixed to the camera"
    return ""


def _is_fixed(frame: str) -> bool:
    """Whether a frame is called as one that stays in the world, in any namespace."""
    name = frame.lower().rpartition("/")[2]
    return any(name.removesuffix(ending) in _FIXED for ending in ("", *_ENDINGS))
