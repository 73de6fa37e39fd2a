"""Objects as JSON and bytes, and back."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial import cKDTree

from factors.robust import RobustKernel
from sst_graph.estimators.gaussian import Point
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.odometry import LidarOdometry
from sst_graph.odometry.smoothing import MotionSmoother
from sst_graph.problem.drive import image_features
from sst_graph.storage import restored, stored
from sst_graph.types import CameraImage, SemanticClass

VEHICLE = SemanticClass.VEHICLE


def _again(value: object) -> Any:
    node, data = stored(value)
    return restored(json.loads(json.dumps(node)), data)


def test_plain_values_and_containers() -> None:
    value = {
        (VEHICLE, 2): [1, 2.5, None, True, "a", float("inf")],
        "set": {3, 1, 2},
        3: (frozenset({(VEHICLE, 1)}), deque([1, 2, 3], maxlen=3)),
        "scalar": np.float32(1.5),
    }
    found = _again(value)
    assert found == value and found[3][1].maxlen == 3
    assert next(iter(found))[0] is VEHICLE and found["scalar"].dtype == np.float32
    assert np.isnan(_again(float("nan")))


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(12, dtype=np.int64).reshape(3, 4)),
        np.arange(24, dtype=np.float32).reshape(2, 3, 4)[:, ::2],
        np.zeros((0, 3)),
        np.full((400, 300), 7, np.uint8),
        np.array([True, False]),
    ],
)
def test_arrays_to_the_bit(array: np.ndarray[Any, Any]) -> None:
    found = _again(array)
    assert found.dtype == array.dtype and np.array_equal(found, array) and found.flags.writeable
    assert not array.flags.f_contiguous or found.flags.f_contiguous


def test_what_is_one_thing_stays_one() -> None:
    array, pose = np.ones(3), gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    circle: list[Any] = [array, {"again": array}, pose, (pose,)]
    circle.append(circle)
    found = _again(circle)
    assert found[0] is found[1]["again"] and found[2] is found[3][0] and found[4] is found
    assert found[2].equals(pose, 1e-15)


def test_objects_of_the_package() -> None:
    point = Point.unbiased(gtsam.Pose3(), 0.1, (VEHICLE,))
    found = _again({"a": point, "config": TrackerConfig(window=17), "kernel": RobustKernel("huber", 2.0)})
    assert found["config"] == TrackerConfig(window=17) and found["kernel"] == RobustKernel("huber", 2.0)
    assert isinstance(found["a"], Point) and found["a"].offset_s == 0.1
    assert isinstance(_again(MotionSmoother(3)), MotionSmoother)


def test_trees_and_images_are_made_anew() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert np.array_equal(
        _again(cKDTree(points)).query(points[:5], 3)[1], cKDTree(points).query(points[:5], 3)[1]
    )
    mask, picture = np.zeros((60, 80), np.uint8), np.full((60, 80, 3), 70, np.uint8)
    mask[20:40, 30:60] = VEHICLE
    picture[19:35, 31:60] = 180
    for pixels in (np.zeros((0, 0, 3), np.uint8), picture):
        image = image_features(4, CameraImage(7, mask, pixels), (VEHICLE, SemanticClass.PERSON))
        found = _again(image)
        assert (found.index, found.stamp_ns, [*found.contours]) == (4, 7, [VEHICLE])
        for name in ("distance", "unknown"):
            assert np.array_equal(*(getattr(part.contours[VEHICLE], name) for part in (found, image)))
    assert image.contours[VEHICLE].unknown.any() and len(stored(image)[1]) < picture.size
    assert isinstance(_again(LidarOdometry()), LidarOdometry)


@dataclass
class _Stranger:
    value: int


@pytest.mark.parametrize("value", [_Stranger(1), print, np.array([None]), 1j, [object()]])
def test_strangers_are_not_stored(value: object) -> None:
    with pytest.raises(TypeError, match="expected"):
        stored(value)


@pytest.mark.parametrize(
    "node",
    [
        ["object", "os:system", {}, 0],
        ["object", "sst_graph.files:atomic_write_bytes", ["dict", [], 1], 0],
        ["object", "sst_graph.files:Path", ["dict", [], 1], 0],
        ["object", "sst_graph.nothing:Nothing", ["dict", [], 1], 0],
        ["object", "sst_graph.cli.__main__:main", ["dict", [], 1], 0],
        ["object", "factors.robust:RobustKernel", ["dict", [["scale", 1.0]], 1], 0],
        ["enum", "sst_graph.types:SemanticClass", 999],
        ["array", "<f8", [3], "C", False, [0, 24], 0],
        ["array", "<f8", [2], "C", False, [0, 8], 0],
        ["array", "|O", [1], "C", False, [0, 8], 0],
        ["array", "|u1", [8], "C", True, [0, 8], 0],
        ["same", 3],
        ["anything", []],
        ["init__", []],
        [],
        [["list"], 0],
    ],
)
def test_what_is_no_stored_value_is_refused(node: Any) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        restored(node, bytes(8))
