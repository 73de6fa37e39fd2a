"""Objects as JSON and bytes, and back."""

from __future__ import annotations

import dataclasses
import json
import resource
import zlib
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.assumption_tests import ParameterTest
from sst_graph.drive.preparation import image_features
from sst_graph.factors.robust import RobustKernel
from sst_graph.files.object_store import Block, Blocks, PackedArray, lay_out, restored, stored
from sst_graph.files.typed_values import wrong_fields
from sst_graph.odometry import LidarOdometry
from sst_graph.odometry.smoothing import MotionSmoother
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.storage.checkpoint import checkpoint_classes
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import CameraImage, RelativeMotion, SemanticClass

VEHICLE = SemanticClass.VEHICLE
CLASSES = checkpoint_classes()

KERNEL = "sst_graph.factors.robust:RobustKernel"


def _again(value: object) -> Any:
    node, data = stored(value)
    return restored(json.loads(json.dumps(node, allow_nan=False)), data, CLASSES)


def test_what_is_laid_out_is_laid_out_as_what_is_read_back() -> None:
    """Views, transposes and sets, in containers and objects: the same strides and order, the same values."""
    root = np.random.default_rng(2).normal(size=(4, 5, 6))
    swapped, column = np.swapaxes(root, 1, 2), root[:, :, 0]
    motion = RelativeMotion(0, 1, gtsam.Pose3(), np.asfortranarray(root[0, :, :5]))
    value = {"list": [swapped, column], "pair": (swapped, root[1].T), "motion": motion, "set": {64, 0, 8}}
    before = [array.copy() for array in (swapped, column, root[1].T, motion.covariance)]
    lay_out(value)
    found = _again(value)
    parts = [
        (one["list"][0], one["list"][1], one["pair"][1], one["motion"].covariance) for one in (value, found)
    ]
    for live, read, old in zip(*parts, before, strict=True):
        assert live.strides == read.strides and np.array_equal(live, old) and np.array_equal(read, old)
    assert value["list"][0] is value["pair"][0] and not np.shares_memory(value["list"][0], root)  # type: ignore[index]
    assert list(value["set"]) == list(found["set"])
    assert motion.covariance.flags.f_contiguous


def _motion(k: int) -> RelativeMotion:
    return RelativeMotion(k, k + 1, gtsam.Pose3(), np.random.default_rng(k).normal(size=(6, 6)))


def _whole(blocks: Blocks, value: object) -> tuple[list[Any], bytes, Any, list[Block]]:
    """Records of blocks, all bytes, and the node of a value, as a file has them."""
    node, data, used = blocks.stored(value)
    records, places = [], len(data)
    for block in used:
        records.append([block.number, places, len(block.data), json.loads(block.text)])
        places += len(block.data)
    return records, data + b"".join(block.data for block in used), node, used


def test_what_never_changes_is_stored_once() -> None:
    blocks, motions = Blocks(CLASSES), [_motion(k) for k in range(3)]
    records, data, node, first = _whole(blocks, {"all": motions, "again": (motions[1],)})
    found = restored(node, data, CLASSES, records)
    assert len(first) == 3 and found["all"][1] is found["again"][0]
    for live, read in zip(motions, found["all"], strict=True):
        assert read == live and read.covariance.flags.writeable
    # The next time only what is new, in the same order of numbers; what is gone is forgotten.
    motions = [*motions[1:], _motion(7)]
    records, data, node, second = _whole(blocks, motions)
    assert second[:2] == first[1:] and second[0] is first[1] and second[2].number == 3
    assert restored(node, data, CLASSES, records) == motions
    assert id(motions[0]) in blocks and id(first[0].value) not in blocks


def test_forged_blocks_are_refused() -> None:
    records, data, node, _ = _whole(Blocks(CLASSES), [_motion(1), _motion(2)])
    for forged in (
        records[:1],
        records[::-1][:1],
        [records[0], records[0]],
        [[True, *records[0][1:]], records[1]],
        [[0, len(data), 8, records[0][3]], records[1]],
        [[0, 0, 8, records[0][3]], records[1]],
        [[0, 0, 0, ["block", 0]], records[1]],
        [[0, 0, 0, ["block", [1]]], records[1]],
        [[0]],
        [7],
        7,
        None,
    ):
        with pytest.raises(ValueError):
            restored(node, data, CLASSES, forged)  # type: ignore[arg-type]


def test_packed_arrays_come_back_and_count() -> None:
    mask = np.zeros((300, 400), np.uint8)
    node, data = stored(PackedArray.of(mask))
    assert len(data) < 1000 and np.array_equal(restored(node, data, CLASSES), mask)
    # What it says to unpack to is checked before memory is taken, and all of them together are.
    node[2] = [2**20, 2**10]
    with pytest.raises(ValueError, match="arrays of more than"):
        restored(node, data, CLASSES)


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


def test_a_rotation() -> None:
    R = gtsam.Rot3.Ypr(0.1, 0.2, 0.3)
    assert _again([R])[0].equals(R, 1e-15)
    for wrong in (np.ones((3, 3)), np.eye(4), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)):
        node, data = stored(R), b""
        node, data = stored([wrong])
        node = ["rotation", node[1][0], 0]
        with pytest.raises(ValueError, match="rotation"):
            restored(node, memoryview(data), checkpoint_classes())


def test_objects_of_the_package() -> None:
    point = Point.unbiased(gtsam.Pose3(), 0.1, (VEHICLE,))
    found = _again({"a": point, "config": TrackerConfig(window=17), "kernel": RobustKernel("huber", 2.0)})
    assert found["config"] == TrackerConfig(window=17) and found["kernel"] == RobustKernel("huber", 2.0)
    assert isinstance(found["a"], Point) and found["a"].time_offset_s == 0.1
    assert isinstance(_again(MotionSmoother(3)), MotionSmoother)


def test_a_finding_holds_its_assumption_by_name() -> None:
    finding = ParameterTest(ASSUMPTIONS["k1"], 0.1, 0.02, True)
    found = _again(finding)
    assert found.assumption is ASSUMPTIONS["k1"] and found.sentence == finding.sentence
    assert (found.value, found.sigma, found.contradicted) == (0.1, 0.02, True)
    node, data = stored(finding)
    text = json.dumps(node).replace('"k1"', '"k9"')
    with pytest.raises(ValueError, match="k9"):
        restored(json.loads(text), data, CLASSES)


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
        ["object", "sst_graph.types:SemanticClass", ["dict", [], 1], 0],
        ["object", KERNEL, ["dict", [["kind", "huber"], ["scale", "wide"]], 1], 0],
        ["object", KERNEL, ["dict", [["kind", "huber"], ["scale", -1.0]], 1], 0],
        ["object", KERNEL, ["list", [], 1], 0],
        ["object", f"{KERNEL}.__init__", ["dict", [], 1], 0],
        ["object", "sst_graph.odometry.smoothing:MotionSmoother", ["dict", [["__class__", 1]], 1], 0],
        ["object", "sst_graph.odometry.smoothing:MotionSmoother", ["dict", [["smoothed", 1]], 1], 0],
        ["enum", "sst_graph.odometry.smoothing:MotionSmoother", 1],
        ["enum", "sst_graph.tracker.tracker:Tracker", 1],
        ["enum", "sst_graph.types:SemanticClass", True],
        ["_object", KERNEL, ["dict", [], 1], 0],
        ["__init__", [], 0],
        ["value", 3],
        ["object", KERNEL, ["dict", [["scale", 1.0]], 1], 0],
        ["enum", "sst_graph.types:SemanticClass", 999],
        ["array", "<f8", [3], "C", False, [0, 24], 0],
        ["array", "<f8", [2], "C", False, [0, 8], 0],
        ["array", "|O", [1], "C", False, [0, 8], 0],
        ["array", "|u1", [8], "C", True, [0, 8], 0],
        ["array", "|u1", [10**13], "C", True, [0, 8], 0],
        ["array", "<f8", [10**13], "C", False, [0, 8], 0],
        ["array", "|u1", [2**62, 2**62], "C", False, [0, 0], 0],
        ["array", "|u1", [-1], "C", False, [0, 8], 0],
        ["array", "|u1", [8.0], "C", False, [0, 8], 0],
        ["array", "|S8", [1], "C", False, [0, 8], 0],
        ["array", "<f8", [1], "C", False, [0, 8]],
        ["array", "<f8", [1], "C", False, [0.0, 8], 0],
        ["tuple", [["array", "<f8", [1], "C", False, [0, 8], 0], ["list", [], 0]], 1],
        ["pose", ["array", "<f8", [1], "C", False, [0, 8], 0], 1],
        ["tree", ["list", [1.0], 0], 1],
        ["deque", [1, 2, 3], 2, 0],
        ["deque", [], -1, 0],
        ["set", [["list", [], 0]], 1],
        ["float", "1.0"],
        ["float", 1],
        ["list", [["same", 0]], "0"],
        {"a": 1},
        ["same", 3],
        ["anything", []],
        ["init__", []],
        [],
        [["list"], 0],
    ],
)
def test_what_is_no_stored_value_is_refused(node: Any) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        restored(node, bytes(8), CLASSES)


def test_what_unpacks_to_more_than_it_says_takes_no_memory() -> None:
    bomb = zlib.compress(bytes(300_000_000), 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for size in (1000, 2**40):
        with pytest.raises(ValueError, match="bytes"):
            restored(["array", "|u1", [size], "C", True, [0, len(bomb)], 0], bomb, CLASSES)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def test_many_arrays_of_the_same_bytes_are_counted_each() -> None:
    block = bytes(1 << 20)
    nodes = [["array", "|u1", [1 << 30], "C", True, [0, 1 << 20], number] for number in range(2)]
    with pytest.raises(ValueError, match="arrays of more than 536870912 bytes"):
        restored(["list", nodes, 600], block, CLASSES)


def test_only_listed_classes_are_written() -> None:
    with pytest.raises(TypeError, match="RobustKernel, expected"):
        stored(RobustKernel("huber", 2.0), {})


def test_deep_nodes_are_refused() -> None:
    node: Any = 1
    for number in range(5000):
        node = ["list", [node], number]
    with pytest.raises(ValueError, match="RecursionError"):
        restored(node, b"", CLASSES)


@dataclass
class _Fields:
    number: float
    count: int
    names: tuple[str, ...]
    table: dict[SemanticClass, NDArray[np.float64]]
    either: int | None
    kind: Literal["a", "b"]


GOOD = _Fields(1.0, 2, ("a",), {VEHICLE: np.zeros(3)}, None, "a")


def test_declared_types_are_checked_in_the_items_too() -> None:
    assert wrong_fields(GOOD) == []
    assert wrong_fields(dataclasses.replace(GOOD, number=3, count=np.int64(4), either=5)) == []
    wrong = {
        "number": ["1.0", True, None],
        "count": [1.5, True, "1"],
        "names": [["a"], ("a", 1), "a"],
        "table": [{VEHICLE: np.zeros(3, int)}, {1: np.zeros(3)}, {VEHICLE: [0.0]}, []],
        "either": [1.5, "a"],
        "kind": ["c", 1],
    }
    for name, values in wrong.items():
        for value in values:
            changed: Any = {name: value}
            assert wrong_fields(dataclasses.replace(GOOD, **changed)) == [name]
