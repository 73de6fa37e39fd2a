"""Which objects of a user's scans move, and how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.drive.preparation import ScanFeatures
from sst_graph.errors import DataError, count_of
from sst_graph.factors.arguments import checked_gtsam, checked_type
from sst_graph.features.lidar_edges import with_points
from sst_graph.objects.dynamic_objects import DynamicObjectTest
from sst_graph.objects.occupancy import ObjectName
from sst_graph.objects.tracks import ObjectTracker
from sst_graph.slam.align import VEHICLES, expect_classes, scan_features_of
from sst_graph.types import FloatArray, Scan, SemanticClass


@dataclass(frozen=True)
class FollowedScans:
    """Scans for :class:`~sst_graph.slam.alignment_term.AlignmentTerm`, position by position.

    Attributes:
        features: of the scans, without objects that move in an unknown way.
        l_velocities: (3,) over ground of the objects that move, in the scan's LiDAR frame [m/s].
    """

    features: tuple[ScanFeatures, ...]
    l_velocities: tuple[Mapping[ObjectName, FloatArray], ...]


def follow_objects(
    scans: Sequence[Scan | ScanFeatures],
    wTls: Sequence[gtsam.Pose3],
    classes: Sequence[SemanticClass] = VEHICLES,
) -> FollowedScans:
    """Objects of consecutive scans, followed by their place in the world.

    Online, the latest dozen of scans will do: an object's velocity at a scan comes from the three scans
    before it and after it.

    Args:
        scans: in the order of time.
        wTls: pose of the LiDAR at each; good to some centimetres from one scan to the next.
        classes: of the terms.

    Raises:
        DataError: not one pose for each scan; no scan, or one that has a flaw.
        FactorError: no scans, no poses, no classes.
    """
    for name, given in (("scans", scans), ("wTls", wTls)):
        checked_type(f"{name} of follow_objects", given, (list, tuple), "a list, one for each scan")
    expect_classes("classes of follow_objects", classes)
    for wTl in wTls:
        checked_gtsam("wTls of follow_objects", wTl, gtsam.Pose3)
    if len(scans) != len(wTls):
        raise DataError("follow_objects", count_of(len(wTls), "pose"), f"{len(scans)}, one a scan")
    tracker, test = ObjectTracker(), DynamicObjectTest()
    features = [scan_features_of(scan, classes) for scan in scans]
    for number, (each, wTl) in enumerate(zip(features, wTls, strict=True)):
        test.insert(number, each, tracker.add(each.boundaries, wTl), wTl)
    test.test_all()
    kept, velocities = [], []
    for number, each in enumerate(features):
        moving = test.dynamic_objects(number)
        known = {name: one.velocity.l_velocity for name, one in moving.items() if one.velocity is not None}
        velocities.append(known)
        kept.append(_without(each, moving.keys() - known.keys()))
    return FollowedScans(tuple(kept), tuple(velocities))


def _without(scan: ScanFeatures, names: set[ObjectName]) -> ScanFeatures:
    """The scan without some objects."""
    boundaries = {
        c: points.take(np.flatnonzero(~np.isin(points.objects, [n for of, n in names if of == c])))
        for c, points in scan.boundaries.items()
    }
    return replace(scan, boundaries=with_points(boundaries))
