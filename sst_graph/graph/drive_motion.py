"""How the LiDAR of a drive moves, and the objects that it sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam

from sst_graph.drive.preparation import Drive
from sst_graph.drive.twists import GrowingTwists, SensorTwists, TwistSample, TwistSamples
from sst_graph.objects.dynamic_objects import DynamicObject, find_dynamic_objects
from sst_graph.objects.tracks import ObjectId, scan_poses, tracks_of_scans
from sst_graph.types import SemanticClass

DynamicObjects = dict[tuple[SemanticClass, int], DynamicObject]
"""The dynamic objects of one scan, by class and number within the scan."""


@dataclass(frozen=True)
class DriveMotion:
    """How the LiDAR of a drive moves, and the objects that it sees; scans are known by their position.

    Attributes:
        twists: of the LiDAR, smoothed, exactly zero at standstill; None for a single scan.
        poses: of the scans in the world; None, or missing at the end, where they are not known.
        objects: track of each object; None where objects have no mask bias of their own.
        dynamic: the dynamic objects of the scans that have any.
    """

    twists: SensorTwists | None
    poses: Sequence[gtsam.Pose3 | None] = ()
    objects: Mapping[ObjectId, int] | None = None
    dynamic: Mapping[int, DynamicObjects] = field(default_factory=dict)

    @classmethod
    def of(cls, drive: Drive, objects: Mapping[ObjectId, int] | None = None) -> DriveMotion:
        """The motion of a whole drive, its objects tested for motion where their tracks are given."""
        motion = cls(GrowingTwists().of(drive.lidar_motions), scan_poses(drive))
        return (
            motion if objects is None else motion.with_objects(objects, find_dynamic_objects(drive, objects))
        )

    def with_objects(
        self, objects: Mapping[ObjectId, int], dynamic: Mapping[ObjectId, DynamicObject]
    ) -> DriveMotion:
        """The motion with these tracks of objects and these dynamic ones."""
        by_scan: dict[int, DynamicObjects] = {}
        for (scan, c, n), one in dynamic.items():
            by_scan.setdefault(scan, {})[c, n] = one
        return replace(self, objects=objects, dynamic=by_scan)

    def part(self, scans: Sequence[int]) -> DriveMotion:
        """The motion at some scans of the drive (:meth:`Drive.part`), which are renumbered from 0."""
        place = {position: k for k, position in enumerate(scans)}
        return replace(
            self,
            poses=[self.pose(k) for k in scans],
            objects=None if self.objects is None else tracks_of_scans(self.objects, scans),
            dynamic={place[scan]: own for scan, own in self.dynamic.items() if scan in place},
        )

    def dynamic_objects(self, scan: int) -> DynamicObjects:
        """The dynamic objects of a scan."""
        return self.dynamic.get(scan, {})

    def pose(self, scan: int) -> gtsam.Pose3 | None:
        """Pose of a scan in the world; None where it is not known."""
        return self.poses[scan] if scan < len(self.poses) else None

    def at(self, stamp_ns: int) -> TwistSample | None:
        """The LiDAR's twist at a stamp of its clock, or None without odometry."""
        return None if self.twists is None else self.twists.at(stamp_ns)

    def at_all(self, stamps_ns: Sequence[int]) -> TwistSamples | None:
        """The LiDAR's twists at stamps of its clock, or None without odometry."""
        return None if self.twists is None else self.twists.at_all(stamps_ns)


def motions_of(
    drives: Sequence[Drive], objects: Sequence[Mapping[ObjectId, int]] | None = None
) -> list[DriveMotion]:
    """The motion of each drive.

    Args:
        objects: tracks of the objects of each drive, where these have mask biases of their own.
    """
    tracks = [None] * len(drives) if objects is None else objects
    return [DriveMotion.of(drive, own) for drive, own in zip(drives, tracks, strict=True)]
