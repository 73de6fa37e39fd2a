"""Transforms of named frames by the formats' own readers: both directions, on a vehicle, of a rig."""

from __future__ import annotations

import ast
import dataclasses
import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xacro
import yaml
from bags import Messages
from calibrations import (
    BASE_FROM_LIDAR,
    FORWARD,
    OPTICAL_FROM_LINK,
    matrix_of,
    result_of,
    turned,
    vehicle,
)
from numpy.typing import NDArray
from rigs import marginal_of
from rigs import result_of as rig_of
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import URDF

from sst_graph.errors import ConfigError
from sst_graph.export import ExportOptions, export_text
from sst_graph.imports import read_tree
from sst_graph.result import CalibrationResult
from sst_graph.rig import RigResult

Poses = Mapping[tuple[str, str], NDArray[np.float64]]
"""Pose of a child in its parent, by (parent, child)."""

PUBLISHER = ("tf2_ros", "static_transform_publisher")
TREES = ("ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro")


# --- the formats' own readers -----------------------------------------------------------------------------


def by_ros_message(text: str, folder: Path) -> Poses:
    """YAML into tf2_msgs/TFMessage of rosbags, serialized as on a topic, and back."""
    document, make = yaml.safe_load(text), Messages()
    stamped = []
    for one in document.get("transforms", [document]):
        transform = one["transform"]
        stamped.append(
            make.make(
                "geometry_msgs/msg/TransformStamped",
                header=make.header(0, one["header"]["frame_id"]),
                child_frame_id=one["child_frame_id"],
                transform=make.make(
                    "geometry_msgs/msg/Transform",
                    translation=make.make("geometry_msgs/msg/Vector3", **transform["translation"]),
                    rotation=make.make("geometry_msgs/msg/Quaternion", **transform["rotation"]),
                ),
            )
        )
    name = "tf2_msgs/msg/TFMessage"
    message = make.types.deserialize_cdr(
        make.types.serialize_cdr(make.make(name, transforms=stamped), name), name
    )
    found = {}
    for one in message.transforms:
        t, q = one.transform.translation, one.transform.rotation
        found[one.header.frame_id, one.child_frame_id] = matrix_of(
            [t.x, t.y, t.z], Rotation.from_quat([q.x, q.y, q.z, q.w])
        )
    return found


def by_positions(words: list[str]) -> tuple[tuple[str, str], NDArray[np.float64]]:
    """ROS 1's tf2_ros: x y z qx qy qz qw frame_id child_frame_id."""
    *values, parent, child = words
    numbers = [float(value) for value in values]
    assert len(numbers) == 7
    return (parent, child), matrix_of(numbers[:3], Rotation.from_quat(numbers[3:]))


def by_flags(words: list[str]) -> tuple[tuple[str, str], NDArray[np.float64]]:
    """ROS 2's tf2_ros: a flag, then its value."""
    given = {flag: value for k, (flag, value) in enumerate(pairwise(words)) if k % 2 == 0}
    xyz, q = (
        [float(given.pop(f"--{name}")) for name in names] for names in ("xyz", ["qx", "qy", "qz", "qw"])
    )
    edge = given.pop("--frame-id"), given.pop("--child-frame-id")
    assert not given
    return edge, matrix_of(xyz, Rotation.from_quat(q))


def by_roslaunch(text: str, folder: Path) -> Poses:
    nodes = ET.fromstring(text).findall("node")
    assert {(node.get("pkg"), node.get("type")) for node in nodes} == {
        ("tf2_ros", "static_transform_publisher")
    }
    assert len({node.get("name") for node in nodes}) == len(nodes)
    return dict(by_positions(node.get("args", "").split()) for node in nodes)


def by_launch_xml(text: str, folder: Path) -> Poses:
    nodes = ET.fromstring(text).findall("node")
    assert {(node.get("pkg"), node.get("exec")) for node in nodes} == {
        ("tf2_ros", "static_transform_publisher")
    }
    return dict(by_flags(node.get("args", "").split()) for node in nodes)


def by_launch_python(text: str, folder: Path) -> Poses:
    """The nodes that ``generate_launch_description`` returns, by the syntax tree."""
    module = ast.parse(text)
    compile(module, "calibration.launch.py", "exec")
    imported = {
        alias.name for node in module.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert imported == {"LaunchDescription", "Node"}
    (function,) = [node for node in module.body if isinstance(node, ast.FunctionDef)]
    assert function.name == "generate_launch_description" and isinstance(function.body[-1], ast.Return)
    nodes = [
        {keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords}
        for call in ast.walk(function)
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Node"
    ]
    assert all((node["package"], node["executable"]) == PUBLISHER for node in nodes)
    return dict(by_flags(node["arguments"]) for node in nodes)


def by_urdf(text: str, folder: Path) -> Poses:
    robot = URDF.from_xml_string(text.encode())
    assert {link.name for link in robot.links} == {n for one in robot.joints for n in (one.parent, one.child)}
    robot.get_root()  # one root: a tree
    found = {}
    for joint in robot.joints:
        assert joint.type == "fixed"
        # scipy's lower-case xyz: fixed axes
        rotation = Rotation.from_euler("xyz", joint.origin.rpy)
        found[joint.parent, joint.child] = matrix_of(joint.origin.xyz, rotation)
    return found


def by_xacro(text: str, folder: Path) -> Poses:
    """A robot that has the parents, includes the file and calls its macro."""
    (folder / "calibration.xacro").write_text(text)
    params = ET.fromstring(text)[0].get("params", "")
    names = dict(pair.split(":=") for pair in params.split())
    children = [value for name, value in names.items() if name.startswith("child")]
    parents = [value for name, value in names.items() if value not in children]
    robot = folder / "robot.xacro"
    robot.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        + "".join(f'<link name="{name}"/>' for name in parents)
        + f'<xacro:include filename="{folder / "calibration.xacro"}"/><xacro:lidar_camera/></robot>'
    )
    return by_urdf(xacro.process_file(str(robot)).toxml(), folder)


READERS = {
    "ros-tf": by_ros_message,
    "ros1-launch": by_roslaunch,
    "ros2-launch": by_launch_python,
    "ros2-launch-xml": by_launch_xml,
    "urdf": by_urdf,
    "xacro": by_xacro,
}


# --- one camera -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", TREES)
@pytest.mark.parametrize("seed", [0, 1, 2, 4, 7])
def test_lidar_in_the_camera(target: str, seed: int, tmp_path: Path) -> None:
    result = turned(seed)
    text = export_text(result, target, ExportOptions("cam_optical", None, "front/lidar"))
    ((edge, T),) = READERS[target](text, tmp_path).items()
    assert edge == ("cam_optical", "front/lidar")
    np.testing.assert_allclose(T, result.T_camera_lidar.matrix(), atol=1e-9)


@pytest.mark.parametrize("target", TREES)
@pytest.mark.parametrize("given", [{"parent": "lidar"}, {"child": "camera_optical_frame"}])
def test_camera_in_the_lidar(target: str, given: dict[str, str], tmp_path: Path) -> None:
    result = turned(3)
    ((edge, T),) = READERS[target](export_text(result, target, ExportOptions(**given)), tmp_path).items()
    assert edge == ("lidar", "camera_optical_frame")
    np.testing.assert_allclose(np.linalg.inv(T), result.T_camera_lidar.matrix(), atol=1e-9)


@pytest.mark.parametrize("target", TREES)
def test_the_link_brings_the_optical_frame_below_it(target: str, tmp_path: Path) -> None:
    result = turned(3)
    found = READERS[target](export_text(result, target, ExportOptions(child="camera_link")), tmp_path)
    assert list(found) == [("lidar", "camera_link"), ("camera_link", "camera_optical_frame")]
    lTlink, linkTc = found.values()
    np.testing.assert_allclose(np.linalg.inv(lTlink @ linkTc), result.T_camera_lidar.matrix(), atol=1e-9)
    np.testing.assert_allclose(linkTc[:3, :3].T, OPTICAL_FROM_LINK, atol=1e-12)


def test_the_link_by_hand() -> None:
    # the camera 30 cm in front of the LiDAR, 20 cm below it and 10 cm to its left, looking ahead
    text = export_text(
        result_of(FORWARD, [0.1, -0.2, -0.3]), "ros-tf", ExportOptions(parent="lidar", child="camera_link")
    )
    first = yaml.safe_load(text)["transforms"][0]["transform"]
    assert first["translation"] == pytest.approx({"x": 0.3, "y": 0.1, "z": -0.2}, abs=1e-12)
    assert first["rotation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, abs=1e-12)


# --- on a vehicle -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", TREES)
def test_the_camera_under_base_link(target: str, tmp_path: Path) -> None:
    result = turned(4)
    text = export_text(result, target, ExportOptions(tree=read_tree(vehicle(tmp_path))))
    ((edge, T),) = READERS[target](text, tmp_path).items()
    assert edge == ("base_link", "camera_optical_frame")
    np.testing.assert_allclose(T @ result.T_camera_lidar.matrix(), BASE_FROM_LIDAR, atol=1e-9)


@pytest.mark.parametrize("target", TREES)
def test_every_format_of_transforms_serves_as_the_vehicle(target: str, tmp_path: Path) -> None:
    """base_link to camera 0 to LiDAR in that format; a second camera is put on it."""
    suffix = ".py" if target == "ros2-launch" else ".any"
    mount = tmp_path / f"mount{suffix}"
    mount.write_text(export_text(turned(4), target, ExportOptions("base_link")))
    second = turned(3)
    options = ExportOptions(tree=read_tree(mount))
    ((edge, T),) = by_urdf(export_text(second, "urdf", options), tmp_path).items()
    assert edge == ("base_link", "camera_optical_frame")
    found = T @ second.T_camera_lidar.matrix()
    np.testing.assert_allclose(found, turned(4).T_camera_lidar.matrix(), atol=1e-9)


def test_the_trees_own_link_is_kept(tmp_path: Path) -> None:
    """A driver that publishes the optical frame 5 cm to the left of the link, as stereo cameras do."""
    tree = tmp_path / "camera.yaml"
    tree.write_text(
        "transforms:\n"
        "- {header: {frame_id: camera_link}, child_frame_id: camera_optical_frame, transform: "
        "{translation: {x: 0, y: 0.05, z: 0}, rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}}}\n"
        "- {header: {frame_id: base_link}, child_frame_id: lidar, transform: "
        "{translation: {x: 0, y: 0, z: 2}, rotation: {x: 0, y: 0, z: 0, w: 1}}}\n"
    )
    options = ExportOptions(child="camera_link", tree=read_tree(tree))
    text = export_text(result_of(FORWARD, [0.0, 0.0, 0.0]), "ros-tf", options)
    message = yaml.safe_load(text)
    assert (message["header"]["frame_id"], message["child_frame_id"]) == ("base_link", "camera_link")
    found = message["transform"]["translation"]
    assert found == pytest.approx({"x": 0.0, "y": -0.05, "z": 2.0}, abs=1e-12)


def test_the_place_of_an_older_transform_is_named(tmp_path: Path) -> None:
    options = ExportOptions(child="camera_link", tree=read_tree(vehicle(tmp_path)))
    text = export_text(turned(0), "urdf", options)
    assert "instead of the tree's pose of camera_link in roof" in text
    assert "parent base_link, child camera_link (camera, link: x forward, y left, z up):" in text


def test_autoware_in_a_kit_of_the_vehicle(tmp_path: Path) -> None:
    options = ExportOptions(parent="roof", tree=read_tree(vehicle(tmp_path)))
    kit = yaml.safe_load(export_text(result_of(FORWARD, [0.1, -0.2, -0.3]), "autoware", options))["roof"]
    assert [kit["lidar"][key] for key in ("x", "y", "z")] == [0.2, 0.0, 0.1]
    pose = [kit["camera0/camera_link"][key] for key in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert pose == pytest.approx([0.5, 0.1, -0.1, 0.0, 0.0, 0.0], abs=1e-12)


def test_autoware_in_a_tree_without_a_parent(tmp_path: Path) -> None:
    """The kit's frame is Autoware's own where the tree has it, else the root above the LiDAR."""
    of_root = export_text(turned(3), "autoware", ExportOptions(tree=read_tree(vehicle(tmp_path))))
    lidar = yaml.safe_load(of_root)["base_link"]["lidar"]
    assert [lidar[key] for key in ("x", "y", "z")] == pytest.approx(list(BASE_FROM_LIDAR[:3, 3]))
    named = ExportOptions(parent="base_link", tree=read_tree(vehicle(tmp_path)))
    assert export_text(turned(3), "autoware", named) == of_root
    pose = "{translation: {x: 0, y: 0, z: 2}, rotation: {x: 0, y: 0, z: 0, w: 1}}"
    above = tmp_path / "above.yaml"
    for parent, child in (("sensor_kit_base_link", "lidar"), ("lidar", "imu_link")):
        above.write_text(f"header: {{frame_id: {parent}}}\nchild_frame_id: {child}\ntransform: {pose}\n")
        options = ExportOptions(tree=read_tree(above))
        if child == "lidar":
            kit = yaml.safe_load(export_text(turned(3), "autoware", options))["sensor_kit_base_link"]
            assert kit["lidar"]["z"] == 2.0
        else:
            with pytest.raises(ConfigError, match="neither a frame 'sensor_kit_base_link' nor one above"):
                export_text(turned(3), "autoware", options)


def test_the_imu_of_the_vehicle(tmp_path: Path) -> None:
    """MINS: camera and LiDAR both in the IMU; Kalibr: the IMU in the camera."""
    result, options = turned(3), ExportOptions(parent="imu_link", tree=read_tree(vehicle(tmp_path)))
    chain = yaml.safe_load(export_text(result, "mins", options).removeprefix("%YAML:1.0\n"))
    iTc, iTl = np.array(chain["cam0"]["T_imu_cam"]), np.array(chain["lidar0"]["T_imu_lidar"])
    np.testing.assert_allclose(np.linalg.inv(iTc) @ iTl, result.T_camera_lidar.matrix(), atol=1e-12)
    assert iTl[:3, 3] == pytest.approx([1.0, 0.2, 1.2])
    cTi = np.array(yaml.safe_load(export_text(result, "kalibr", options))["cam0"]["T_cam_imu"])
    np.testing.assert_allclose(cTi, np.linalg.inv(iTc), atol=1e-12)


def test_nuscenes_in_the_ego_frame(tmp_path: Path) -> None:
    options = ExportOptions(lidar_frame="lidar", tree=read_tree(vehicle(tmp_path)))
    records = json.loads(export_text(turned(3), "nuscenes", options))
    lidar, camera = (matrix_of(one["translation"], _wxyz(one["rotation"])) for one in records)
    np.testing.assert_allclose(lidar, BASE_FROM_LIDAR, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(camera) @ lidar, turned(3).T_camera_lidar.matrix(), atol=1e-12)


def _wxyz(q: list[float]) -> Rotation:
    return Rotation.from_quat([*q[1:], q[0]])


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        ("urdf", {"parent": "base_link"}, "by --tree FILE"),
        (
            "urdf",
            {"parent": "lidar", "child": "elsewhere"},
            "'lidar' to 'elsewhere': expected camera",
        ),
        (
            "urdf",
            {"parent": "camera_link", "child": "camera_optical_frame"},
            "expected camera_optical_",
        ),
        ("nuscenes", {"parent": "ego"}, r"'ego' \(the ego frame\): expected a pose of 'lidar'"),
        ("autoware", {"parent": "kit"}, r"'kit' \(the kit\): expected a pose of 'lidar'"),
    ],
)
def test_frames_that_nothing_is_known_of(target: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        export_text(turned(0), target, ExportOptions(**options))


def test_a_vehicle_without_the_frames(tmp_path: Path) -> None:
    tree = read_tree(vehicle(tmp_path))
    with pytest.raises(ConfigError, match="found no frame 'velodyne' among base_link, roof"):
        export_text(turned(0), "urdf", ExportOptions(lidar_frame="velodyne", tree=tree))
    with pytest.raises(ConfigError, match="no chain of transforms from 'mast' to 'lidar'"):
        export_text(turned(0), "urdf", ExportOptions(parent="mast", tree=tree))
    with pytest.raises(ConfigError, match="expected the IMU's frame by --parent"):
        export_text(turned(0), "kalibr", ExportOptions(tree=tree))


# --- several cameras --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig() -> RigResult:
    return rig_of(marginal_of(3))


@pytest.mark.parametrize("target", TREES)
def test_every_camera_of_a_rig(target: str, rig: RigResult, tmp_path: Path) -> None:
    found = READERS[target](export_text(rig, target), tmp_path)
    assert list(found) == [("lidar", f"cam{k}_optical_frame") for k in range(3)]
    for T, result in zip(found.values(), rig.cameras.values(), strict=True):
        np.testing.assert_allclose(np.linalg.inv(T), result.T_camera_lidar.matrix(), atol=1e-9)
    text = export_text(rig, target)
    for k, result in enumerate(rig.cameras.values()):
        sentence = f"time offset of cam{k}_optical_frame: t_lidar = t_camera_stamp + time_offset_s"
        assert f"{sentence}, time_offset_s = {result.time_offset_s!r}" in text


@pytest.mark.parametrize("target", TREES)
def test_links_of_a_rig_on_a_vehicle(target: str, rig: RigResult, tmp_path: Path) -> None:
    options = ExportOptions(
        camera_frame="c{number}_eye",
        camera_link="{camera}/link",
        child="{camera}/link",
        tree=read_tree(vehicle(tmp_path)),
    )
    found = READERS[target](export_text(rig, target, options), tmp_path)
    for k, result in enumerate(rig.cameras.values()):
        T = found["base_link", f"cam{k}/link"] @ found[f"cam{k}/link", f"c{k}_eye"]
        np.testing.assert_allclose(T @ result.T_camera_lidar.matrix(), BASE_FROM_LIDAR, atol=1e-9)


def test_the_chain_of_a_rig(rig: RigResult) -> None:
    chain = yaml.safe_load(export_text(rig, "kalibr"))
    before = np.eye(4)
    for k, result in enumerate(rig.cameras.values()):
        entry, cTl = chain[f"cam{k}"], result.T_camera_lidar.matrix()
        np.testing.assert_allclose(entry["T_cam_imu"], cTl, atol=1e-12)
        assert entry["timeshift_cam_imu"] == result.time_offset_s and entry["rostopic"] == f"/cam{k}"
        if k:
            np.testing.assert_allclose(np.array(entry["T_cn_cnm1"]) @ before, cTl, atol=1e-12)
        before = cTl
    assert "T_cn_cnm1" not in chain["cam0"]


def test_a_rig_where_the_format_holds_one_camera(rig: RigResult) -> None:
    for target in ("kitti", "gtsam"):
        with pytest.raises(ConfigError, match="expected the folder of one of its cameras"):
            export_text(rig, target)
    with pytest.raises(ConfigError, match="below several cameras, expected one parent"):
        export_text(rig, "urdf", ExportOptions(child="lidar"))
    with pytest.raises(ConfigError, match=r"expected \{camera\} in it"):
        export_text(rig, "urdf", ExportOptions(camera_frame="eye"))


def test_a_result_of_any_name(tmp_path: Path) -> None:
    """Topics as names of cameras."""
    result: CalibrationResult = dataclasses.replace(turned(3), camera_name="/front left/image: raw")
    for target in (*TREES, "autoware", "kalibr", "openvins", "mins", "opencv", "nuscenes", "kitti"):
        frame = None if target in ("nuscenes", "kitti") else "{camera}_optical_frame"
        text = export_text(result, target, ExportOptions(camera_frame=frame))
        if target in READERS:
            ((edge, _),) = READERS[target](text, tmp_path).items()
            assert edge == ("front_left_image_raw_optical_frame", "lidar")
        elif target in ("kalibr", "autoware"):
            yaml.safe_load(text)


def test_optical_frame_and_link_have_two_names() -> None:
    with pytest.raises(ConfigError, match="for the optical frame and the link, expected two names"):
        ExportOptions("camera", "camera")
