"""Clouds that do not tell by which laser each point was measured, or from where."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from sst_graph.data.lidar_pose import lidar_pose_text
from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.features.lidar_origin import lidar_origin, own_clearness
from sst_graph.sampling import evenly_spread

_MOST = 0.5
"""Share of the scans above which it is said: a scan now and then is cut short."""


def unknown_lasers(drives: Sequence[Drive]) -> Finding | None:
    """Scans without laser numbers, which were then recovered from elevations. That may be right."""
    known = [scan.lasers for d in drives if d.statistics is not None for scan in d.statistics.scans]
    missing = known.count(False)
    if missing <= _MOST * len(known):
        return None
    return Finding(
        "which laser measured a point is not known and was recovered from elevations; upper edges of objects "
        "may be off by up to half the distance of two rings, beyond the sigmas",
        f"{missing} of {count_of(len(known), 'scan')} have no field 'ring', and their points come neither "
        "ring after ring nor firing after firing, or its numbers do not belong to the points",
        "give the clouds with the field 'ring', or as the LiDAR's driver stores them",
    )


_SCANS, _LEAST_POINTS = 3, 2000
"""Scans in which the origin is looked for, and points that each must have."""
_CLEAR = 3.4
"""Rings that stand out so clearly from the cloud's own origin are those of a LiDAR that is there: 3.7 to 4.8
on real scans, 3.0 without rings."""
_SAME_M = np.array([1.0, 0.3, 0.3])
"""Scans agree about the origin within this, forward at any speed; the best origins of scans without rings lie
anywhere."""
_AWAY_M = 0.5
"""Nearer to the cloud's x axis it is the scanner's own optical centre, or motion within a sweep: points moved
to its end were seen from behind, by metres at speed."""


def other_axes(drives: Sequence[Drive]) -> Finding | None:
    """Clouds in axes that are not those of their LiDAR, such as the vehicle's: seen from another place, the
    same in all scans, their rings stand out."""
    drive = max(drives, key=lambda one: len(one.scans))
    known = () if drive.statistics is None else drive.statistics.scans
    clouds = [scan.some_points for scan in known if len(scan.some_points) >= _LEAST_POINTS]
    chosen = [cloud.astype(np.float64) for cloud in evenly_spread(clouds, _SCANS)]
    if len(chosen) < _SCANS or max(map(own_clearness, chosen)) > _CLEAR:
        return None
    found = [lidar_origin(cloud) for cloud in chosen]
    places, middle = np.array([pose.translation() for pose in found]), _median_pose(found)
    away = middle.translation()
    if (np.abs(places - away) > _SAME_M).any() or np.linalg.norm(away[1:]) < _AWAY_M:
        return None
    pose = lidar_pose_text(middle)
    place = ", ".join(pose.split(",")[:3])
    return Finding(
        "the clouds are not in the axes of the LiDAR but in others, such as the vehicle's",
        f"seen from {place} m in them the LiDAR's rings stand out, not from their origin",
        f"say where the LiDAR is in them, as --lidar-pose={pose} (better from tf or a drawing); where a pose "
        "was given, that one is wrong: leave it out, or take the product of both",
    )


def _median_pose(poses: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
    roll, pitch, yaw = np.median([pose.rotation().rpy() for pose in poses], axis=0)
    return gtsam.Pose3(
        gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.median([pose.translation() for pose in poses], axis=0)
    )
