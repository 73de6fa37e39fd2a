"""Objects tracked from scan to scan; dynamic ones."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.errors import EstimationError
from sst_graph.factors import PinholeCamera
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.graph.outer_loop import KERNELS_PX, JointConfig, JointProblem, solve_joint
from sst_graph.graph.state import State
from sst_graph.objects.dynamic_objects import dynamic_object_weights, find_dynamic_objects
from sst_graph.objects.tracks import ObjectTracker, object_tracks, scan_poses
from sst_graph.objects.velocity import ObjectVelocities
from sst_graph.types import RelativeMotion, SemanticClass

VEHICLE, POLE = SemanticClass.VEHICLE, SemanticClass.POLE
PERIOD_NS = 100_000_000
SCANS = 12
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(0.02), np.array([0.7, 0.0, 0.0]))
"""The LiDAR's own motion between scans."""


def boundaries(*centres: np.ndarray) -> Boundaries:
    """Twelve points around each centre (in the LiDAR frame), object k the k-th."""
    around = np.vstack([0.5 * np.eye(3), -0.5 * np.eye(3), 0.25 * np.eye(3), -0.25 * np.eye(3)])
    lPs = np.concatenate([centre + around for centre in centres])
    n = len(lPs)
    numbers = np.repeat(np.arange(len(centres)), 12)
    return Boundaries(lPs, lPs.copy(), np.ones(n, np.intp), np.zeros(n), np.zeros(n, np.uint8), numbers)


def drive(*paths: Callable[[float], np.ndarray]) -> Drive:
    """Scans of a LiDAR that drives a curve past vehicles whose world places are given over time [s].

    The wandering one has a body around its visible side.
    """
    body = np.stack(np.meshgrid(*[np.arange(-1.2, 1.3, 0.1)] * 2, [-0.5, 0.0, 0.5]), -1).reshape(-1, 3)
    scans, wTl = [], gtsam.Pose3()
    nothing, small = np.zeros(0), np.zeros((0, 3), np.float32)
    for k in range(SCANS):
        places = [wTl.transformTo(path(0.1 * k)) for path in paths]
        found = {VEHICLE: boundaries(*places)}
        inside = np.zeros((0, 3))
        if wandering in paths:
            inside = (body + np.array([15.0, -6.0, 0.0]) - wTl.translation()) @ wTl.rotation().matrix()
        labels = np.full(len(inside), VEHICLE, np.uint8)
        scans.append(ScanFeatures(k, k * PERIOD_NS, found, inside, labels, nothing, small, small[:, 0]))
        wTl = wTl.compose(STEP)
    motions = [
        RelativeMotion(k * PERIOD_NS, (k + 1) * PERIOD_NS, STEP, np.eye(6) * 1e-6) for k in range(SCANS - 1)
    ]
    camera = PinholeCamera(700.0, 700.0, 320.0, 100.0, 640, 200)
    return Drive("made by hand", camera, tuple(scans), (), tuple(motions), ())


def parked(seconds: float) -> np.ndarray:
    return np.array([12.0, 5.0, 0.0])


def wandering(seconds: float) -> np.ndarray:
    """A parked vehicle whose visible side changes: a metre along it, to and fro."""
    return np.array([15.0 + 0.5 * np.sin(11.0 * seconds), -6.0 + 0.3 * np.cos(17.0 * seconds), 0.0])


SLOW_MPS = 1.1


def slow(seconds: float) -> np.ndarray:
    """At 60 m, where half a metre still counts as found again."""
    return np.array([60.0 + SLOW_MPS * seconds, 8.0, 0.0])


def moving(seconds: float) -> np.ndarray:
    return np.array([20.0, 0.0, 0.0]) + seconds * np.array([6.0, -2.0, 0.0])


def oncoming(seconds: float) -> np.ndarray:
    return np.array([60.0 - 30.0 * seconds, 5.0, 0.0])


def test_one_track_for_each_object() -> None:
    made = drive(parked, wandering, moving)
    tracks = object_tracks(made)
    assert len(tracks) == 3 * SCANS
    numbers = [{tracks[k, VEHICLE, n] for k in range(SCANS)} for n in range(3)]
    assert all(len(found) == 1 for found in numbers) and len(set.union(*numbers)) == 3


def test_a_dynamic_object_is_found_and_parked_vehicles_are_not() -> None:
    made = drive(parked, wandering, moving)
    found = find_dynamic_objects(made, object_tracks(made))
    assert set(found) == {(k, VEHICLE, 2) for k in range(SCANS)}
    assert min(one.speed_mps for one in found.values()) > np.hypot(6.0, 2.0) - 1e-6
    velocity = found[6, VEHICLE, 2].velocity
    assert velocity is not None and found[6, VEHICLE, 2].unknown_mps == velocity.sigma_mps < 0.2
    turned = gtsam.Rot3.Yaw(-6 * 0.02).rotate(np.array([6.0, -2.0, 0.0]))
    np.testing.assert_allclose(velocity.l_velocity, turned, atol=0.1)  # its outline turns with the LiDAR


def test_a_dynamic_object_is_found_without_a_track() -> None:
    """Its points are not where they were, nor where they will be."""
    made = drive(parked, moving)
    tracks = object_tracks(made)
    assert {n for _, _, n in find_dynamic_objects(made, {key: tracks[key] for key in list(tracks)[:3]})} == {
        1
    }
    assert {n for _, _, n in find_dynamic_objects(made, {})} == {1}


def test_a_slow_vehicle_is_found_by_its_track_alone() -> None:
    """Its place is still occupied 0.3 s later; twelve centres in a line show its motion, and so does its near
    end."""
    made = drive(slow)
    tracks = object_tracks(made)
    found = find_dynamic_objects(made, tracks)
    assert [one.speed_mps for one in found.values()] == pytest.approx([SLOW_MPS] * SCANS, rel=0.02)
    velocities = ObjectVelocities()
    for k, (scan, wTl) in enumerate(zip(made.scans, scan_poses(made), strict=True)):
        velocities.insert(k, scan, {(VEHICLE, 0): tracks[k, VEHICLE, 0]}, wTl)
    velocities.update_all()
    assert all(velocities.speeds(k) for k in range(SCANS))
    assert not find_dynamic_objects(made, {})


def test_a_tracker_forgets_and_keeps_classes_apart() -> None:
    tracker, here = ObjectTracker(memory=2), np.array([10.0, 0.0, 0.0])
    first = tracker.add({VEHICLE: boundaries(here), POLE: boundaries(here)}, gtsam.Pose3())
    assert sorted(first.values()) == [0, 1]
    for _ in range(2):
        tracker.add({}, gtsam.Pose3())
    assert tracker.live == {} and tracker.last_seen == {}
    again = tracker.add({VEHICLE: boundaries(here)}, gtsam.Pose3())
    assert list(again.values()) == [2]
    # One track is not given to two objects of a scan.
    both = tracker.add({VEHICLE: boundaries(here, here + 0.5)}, gtsam.Pose3())
    assert len(set(both.values())) == 2 and 2 in both.values()


def test_too_few_matches_for_vehicles_that_all_move_say_so() -> None:
    """An oncoming one passes by faster than a track can follow."""
    for path, cause in (
        (oncoming, "100 % of the outlines are those of vehicles that move"),
        (parked, "near a"),
    ):
        problem = JointProblem.of([drive(path)], JointConfig())
        with pytest.raises(EstimationError, match=cause):
            solve_joint(problem, State(STEP, (0.0,)), KERNELS_PX)


def test_the_weight_of_a_dynamic_object_falls_with_its_speed() -> None:
    """3 mm within the pair's interval halve it; a parked object keeps all of it, a fast one nothing."""
    speeds = np.linspace(0.0, 2.0, 201)
    shares = dynamic_object_weights(speeds, np.full(201, 0.012), 0.003)
    # sqrt(12^2 + 5^2) ms = 13 ms.
    assert shares[0] == 1.0
    assert dynamic_object_weights(np.array([0.003 / 0.013]), np.array([0.012]), 0.003) == pytest.approx(0.5)
    assert (np.diff(shares) <= 0.0).all() and shares[-1] == 0.0
    # The one jump, where an object is left out, is small beside the whole.
    assert np.abs(np.diff(shares)).max() < 0.11


def test_a_fast_object_is_left_out_even_where_scan_and_image_meet() -> None:
    """How its outline follows the time offset is not known."""
    weights = dynamic_object_weights(np.array([8.0, 0.0]), np.array([0.0, 0.05]), 0.003)
    assert weights.tolist() == [0.0, 1.0]
