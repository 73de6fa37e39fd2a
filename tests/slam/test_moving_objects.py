"""Objects that move in a user's scans: their velocities, for terms."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from alignment_streets import OBJECTS
from stored import simulated

from sst_graph import follow_objects
from sst_graph.drive.preparation import ScanFeatures
from sst_graph.errors import DataError
from sst_graph.features.lidar_edges import Boundaries, Edge
from sst_graph.simulator import SimulationConfig
from sst_graph.types import SemanticClass

OBJECT = SemanticClass.OBJECT
HEIGHTS = np.arange(-1.0, 0.6, 0.1)
YAW = gtsam.Rot3.Yaw(0.3)


def box_scan(k: int, centres: list[np.ndarray]) -> tuple[ScanFeatures, gtsam.Pose3]:
    """A scan of boxes of 4.4 by 1.8 m along x, seen from a LiDAR that drives along x: their outermost
    corners."""
    place = np.array([0.5 * k, 0.0])
    wTl, parts, objects = gtsam.Pose3(YAW, np.append(place, 0.0)), [], []
    for number, centre in enumerate(centres):
        corners = centre + np.array([[2.2, 0.9], [2.2, -0.9], [-2.2, -0.9], [-2.2, 0.9]])
        angles = np.arctan2(*(corners - place).T[::-1])
        for x, y in corners[[angles.argmin(), angles.argmax()]]:
            parts += [wTl.transformTo(np.array([x, y, z])) for z in HEIGHTS]
            objects += [number] * len(HEIGHTS)
    lPs, n = np.stack(parts), len(parts)
    edges = np.full(n, Edge.SIDE, np.uint8)
    points = Boundaries(lPs, lPs.copy(), np.ones(n, np.intp), np.zeros(n), edges, np.array(objects, np.intp))
    none = np.zeros((0, 3))
    scan = ScanFeatures(
        k, k * 100_000_000, {OBJECT: points}, none, np.zeros(0, np.uint8), none[:, 0], none, none[:, 0]
    )
    return scan, wTl


def test_velocities_of_what_moves_alone() -> None:
    """One oncoming, one parked."""
    scans, wTls = [], []
    for k in range(12):
        centres = [np.array([40.0 - 0.9 * k, 3.0]), np.array([25.0, -4.0])]
        scan, wTl = box_scan(k, centres)
        scans.append(scan)
        wTls.append(wTl)
    found = follow_objects(scans, wTls, OBJECTS)
    assert len(found.features) == len(found.l_velocities) == 12
    for own, scan in zip(found.l_velocities, found.features, strict=True):
        assert set(own) == {(OBJECT, 0)}
        np.testing.assert_allclose(YAW.rotate(own[OBJECT, 0]), [-9.0, 0.0, 0.0], atol=1e-6)
        assert set(scan.boundaries[OBJECT].objects.tolist()) == {0, 1}


def test_what_moves_in_an_unknown_way_is_left_out() -> None:
    """It is where nothing was before and after, in too few scans to be followed."""
    scans, wTls = [], []
    for k in range(9):
        centres = [np.array([25.0, -4.0])] + [np.array([30.0, 4.0])] * (k in (4, 5))
        scan, wTl = box_scan(k, centres)
        scans.append(scan)
        wTls.append(wTl)
    found = follow_objects(scans, wTls, OBJECTS)
    assert all(own == {} for own in found.l_velocities)
    objects = [set(scan.boundaries[OBJECT].objects.tolist()) for scan in found.features]
    assert objects[0] == {0} and objects[4] == {0} and objects[5] == {0}


def test_one_pose_a_scan() -> None:
    scan, wTl = box_scan(0, [np.array([20.0, 3.0])])
    with pytest.raises(DataError, match="1 pose, expected 2, one a scan"):
        follow_objects([scan, scan], [wTl], OBJECTS)


@pytest.mark.slow
def test_following_features_is_following_their_scans() -> None:
    """As edges.md does frame by frame: the features of a scan alone are whole, and may be given again."""
    street = SimulationConfig(seed=504, frames=12, motion="no_stop", azimuth_limit_deg=50.0)
    drive = simulated(street)
    scans = [drive[k].scan for k in range(8)]
    wTls = [drive.wTl(1e-9 * scan.stamp_ns) for scan in scans]
    alone = [
        follow_objects([scan], [wTl], OBJECTS).features[0] for scan, wTl in zip(scans, wTls, strict=True)
    ]
    by_scans, by_features = follow_objects(scans, wTls, OBJECTS), follow_objects(alone, wTls, OBJECTS)
    assert any(by_scans.l_velocities)
    for own, other in zip(by_scans.l_velocities, by_features.l_velocities, strict=True):
        assert own.keys() == other.keys() and all(np.array_equal(own[name], other[name]) for name in own)
    for a, b in zip(by_scans.features, by_features.features, strict=True):
        np.testing.assert_array_equal(a.boundaries[OBJECT].lPs, b.boundaries[OBJECT].lPs)
