"""Files as other programs write them: by hand, and what cannot be read from them."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import gtsam
import numpy as np
import pytest
from calibrations import FORWARD

from sst_graph.errors import ConfigError, DataError
from sst_graph.imports import ImportOptions, import_calibration, read_tree

AHEAD = gtsam.Pose3(gtsam.Rot3(FORWARD), np.array([0.1, -0.2, -0.3]))
"""The camera 30 cm in front of the LiDAR, 20 cm below it and 10 cm to its left, looking ahead."""


def written(folder: Path, text: str, name: str = "file") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def finds(path: Path, options: ImportOptions | None = None) -> str:
    """The format of a file that holds :data:`AHEAD`."""
    found = import_calibration(path, options)
    assert found.cTl.equals(AHEAD, 1e-9)
    return found.format


LAUNCHES = {
    "ros1-launch": [
        # tf2_ros: x y z yaw pitch roll frame child
        '<launch><node pkg="tf2_ros" type="static_transform_publisher" name="a" '
        'args="0.3 0.1 -0.2 0 0 0 velodyne camera_link"/></launch>',
        # tf: the same, and a period [ms]
        '<launch><node pkg="tf" type="static_transform_publisher" name="a" '
        'args="0.3 0.1 -0.2 0 0 0 velodyne camera_link 100"/></launch>',
        '<launch><node pkg="tf" type="static_transform_publisher" name="a" '
        'args="0.3 0.1 -0.2 -0.5 0.5 -0.5 0.5 velodyne camera_optical 100"/></launch>',
        # yaw first: -90 deg about z, then roll -90 deg turn the link into the optical frame
        '<launch><group><node pkg="tf2_ros" type="static_transform_publisher" name="a" args="0.3 0.1 -0.2 '
        '-1.5707963267948966 0 -1.5707963267948966 velodyne camera_optical"/></group></launch>',
    ],
    "ros2-launch-xml": [
        '<launch><node pkg="tf2_ros" exec="static_transform_publisher" args="--x 0.3 --y 0.1 --z -0.2 '
        '--frame-id velodyne --child-frame-id camera_link"/></launch>',
        '<launch><node pkg="tf2_ros" exec="static_transform_publisher" args="--x 0.3 --y 0.1 --z -0.2 '
        "--yaw -1.5707963267948966 --roll -1.5707963267948966 --frame-id velodyne "
        '--child-frame-id camera_optical"/></launch>',
    ],
    "ros2-launch": [
        "import launch_ros\n"
        "def generate_launch_description():\n"
        "    n = launch_ros.actions.Node(package='tf2_ros', executable='static_transform_publisher',\n"
        "        arguments=('0.3', '0.1', '-0.2', '0', '0', '0', 'velodyne', 'camera_link'))\n",
    ],
}


@pytest.mark.parametrize(("form", "text"), [(form, text) for form in LAUNCHES for text in LAUNCHES[form]])
def test_launch_files(form: str, text: str, tmp_path: Path) -> None:
    assert finds(written(tmp_path, text)) == form


def test_what_ros2_topic_echo_prints(tmp_path: Path) -> None:
    text = """transforms:
- header:
    stamp:
      sec: 1700000000
      nanosec: 0
    frame_id: base_link
  child_frame_id: ouster
  transform:
    translation: {x: 0.0, y: 0.0, z: 1.0}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
---
transforms:
- header: {frame_id: base_link}
  child_frame_id: camera_link
  transform:
    translation: {x: 0.3, y: 0.1, z: 0.8}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
---
"""
    assert finds(written(tmp_path, text)) == "ros-tf"


def test_autowares_kit_of_many_sensors(tmp_path: Path) -> None:
    text = """sensor_kit_base_link:
  camera0/camera_link: {x: 1.3, y: 0.1, z: -0.2, roll: 0.0, pitch: 0.0, yaw: 0.0}
  camera1/camera_link: {x: 0.0, y: 0.0, z: 0.0, roll: 0.0, pitch: 0.0, yaw: 1.0}
  velodyne_top_base_link: {x: 1.0, y: 0.0, z: 0.0, roll: 0.0, pitch: 0.0, yaw: 0.0}
  velodyne_left_base_link: {x: 0.0, y: 0.5, z: -0.3, roll: -0.02, pitch: 0.71, yaw: 1.575}
  gnss_link: {x: -0.1, y: 0.0, z: -0.2, roll: 0.0, pitch: 0.0, yaw: 0.0}
"""
    path = written(tmp_path, text)
    with pytest.raises(DataError, match="velodyne_top_base_link, velodyne_left_base_link, expected"):
        import_calibration(path)
    lidar = {"lidar_frame": "velodyne_top_base_link"}
    with pytest.raises(DataError, match="camera0/camera_link, camera1/camera_link, expected one camera"):
        import_calibration(path, ImportOptions(**lidar))
    assert finds(path, ImportOptions(camera_link="camera0/camera_link", **lidar)) == "autoware"
    assert finds(path, ImportOptions(camera="camera0", **lidar)) == "autoware"


def test_a_camera_whose_frame_does_not_say_which_way_it_looks(tmp_path: Path) -> None:
    text = LAUNCHES["ros2-launch-xml"][0].replace("camera_link", "cam0")
    path = written(tmp_path, text)
    with pytest.raises(DataError, match=r"--camera-frame NAME \(optical: z forward\) or --camera-link"):
        import_calibration(path)
    assert finds(path, ImportOptions(camera_link="cam0")) == "ros2-launch-xml"
    with pytest.raises(DataError, match="no frame 'cam1' among velodyne, cam0"):
        import_calibration(path, ImportOptions(camera_link="cam1"))
    with pytest.raises(ConfigError, match="found both"):
        ImportOptions(camera_frame="a", camera_link="b")


def test_opencv_by_rvec_and_tvec(tmp_path: Path) -> None:
    # the turn of FORWARD: 120 deg about (1, -1, 1)
    third = float(2.0 * np.pi / 3.0 / np.sqrt(3.0))
    text = f"%YAML:1.0\n---\nrvec: [{third!r}, {-third!r}, {third!r}]\ntvec: [0.1, -0.2, -0.3]\n"
    assert finds(written(tmp_path, text)) == "opencv"
    assert import_calibration(tmp_path / "file").time_offset_s is None


def test_two_lidars_of_mins_and_their_clocks(tmp_path: Path) -> None:
    """t_imu = t_cam + 0.05 = t_lidar + 0.02: t_lidar = t_cam + 0.03."""
    rows = [[1, 0, 0, 0.3], [0, 1, 0, 0.1], [0, 0, 1, -0.2], [0, 0, 0, 1]]
    eye = np.eye(4).tolist()
    optical = AHEAD.inverse().matrix().tolist()
    text = (
        f"cam0:\n  timeoffset: 0.05\n  T_imu_cam: {optical}\n"
        f"lidar0:\n  timeoffset: 0.02\n  T_imu_lidar: {eye}\n"
        f"lidar1:\n  timeoffset: 0.0\n  T_imu_lidar: {rows}\n"
    )
    path = written(tmp_path, text)
    assert finds(path) == "mins"
    assert import_calibration(path).time_offset_s == pytest.approx(0.03)


def test_a_xacro_file_that_needs_xacro(tmp_path: Path) -> None:
    text = """<robot xmlns:xacro="http://ros.org/wiki/xacro">
  <xacro:property name="height" value="0.2"/>
  <joint name="a" type="fixed"><parent link="lidar"/><child link="camera_link"/>
    <origin xyz="0.3 0.1 -${height}"/></joint>
  <joint name="b" type="fixed"><parent link="x"/><child link="y"/><origin xyz="${2 * height} 0 0"/></joint>
</robot>"""
    assert finds(written(tmp_path, text)) == "xacro"
    with pytest.raises(DataError, match=r"no fixed joint.*xacro FILE > robot\.urdf"):
        import_calibration(written(tmp_path, text.replace("-${height}", "${-height}")))


def joint_of(child: str, origin: str, parent: str = "base") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{child}" type="fixed">{ends}{origin}</joint>'


def macro_of(child: str, params: str, origin: str) -> str:
    return f'<xacro:macro name="{child}" params="{params}">{joint_of(child, origin)}</xacro:macro>'


def robot_of(*parts: str) -> str:
    return f'<robot xmlns:xacro="http://ros.org/wiki/xacro">{"".join(parts)}</robot>'


AT_X = '<origin xyz="${x} 0 0"/>'


def test_each_macro_of_xacro_has_its_own_defaults(tmp_path: Path) -> None:
    text = robot_of(
        macro_of("lidar", "x:=1.5 y:=1", AT_X),
        macro_of("eye", "x:=0.2", AT_X),
        macro_of("mast", "y:=4", AT_X),
        macro_of("open", "x", AT_X),
        macro_of("outer", "x:=^|5", AT_X),
        "<xacro:lidar/><xacro:eye/><xacro:mast/>",
        '<xacro:property name="x" value="3"/><xacro:arg name="y" default="6"/>',
        joint_of("roof", '<origin xyz="$(arg y) 0 0"/>'),
        joint_of("wing", '<origin xyz="${y} 0 0"/>'),
    )
    tree = read_tree(written(tmp_path, text))
    expected = {"lidar": 1.5, "eye": 0.2, "mast": 3.0, "roof": 6.0}
    assert set(tree.frames) == {"base", *expected}
    for frame, x in expected.items():
        found = tree.pose("base", frame)[0]
        assert found is not None and found.x() == x


LIDAR = macro_of("lidar", "x:=1.5 *block", AT_X)


@pytest.mark.parametrize(
    "parts",
    [
        (LIDAR, '<xacro:lidar x="2"/>'),
        (LIDAR, '<xacro:lidar/><xacro:lidar x="2"/>'),
        (LIDAR, '<xacro:lidar><origin xyz="1 2 3"/></xacro:lidar>'),
        (LIDAR, '<xacro:call macro="lidar" x="2"/>'),
        (macro_of("lidar", "macro:=1", '<origin xyz="${macro} 0 0"/>'), '<xacro:lidar macro="2"/>'),
        (LIDAR, '<xacro:if value="$(arg with)"><xacro:lidar/></xacro:if>'),
        (macro_of("lidar", "*block", '<xacro:insert_block name="block"/>'),),
        (joint_of("lidar", '<xacro:insert_block name="origin"/>'),),
        (f'<xacro:if value="false">{joint_of("lidar", "")}</xacro:if>',),
        (f'<xacro:unless value="true"><group>{joint_of("lidar", "")}</group></xacro:unless>',),
        (f'<xacro:property name="part">{joint_of("lidar", "")}</xacro:property>',),
        (
            '<xacro:property name="x" value="1"/><xacro:property name="x" value="2"/>',
            joint_of("lidar", AT_X),
        ),
        (
            '<xacro:if value="$(arg tall)"><xacro:property name="x" value="1"/></xacro:if>',
            joint_of("lidar", AT_X),
        ),
        (
            '<xacro:macro name="m"><xacro:property name="x" value="1" scope="global"/></xacro:macro>',
            joint_of("lidar", AT_X),
        ),
    ],
)
def test_joints_that_the_defaults_of_xacro_do_not_determine_are_left_out(
    parts: tuple[str, ...], tmp_path: Path
) -> None:
    tree = read_tree(written(tmp_path, robot_of(joint_of("eye", ""), *parts)))
    assert set(tree.frames) == {"base", "eye"}


def test_a_macro_that_is_called_without_arguments_is_read(tmp_path: Path) -> None:
    for calls in ("", "<xacro:lidar/>", '<xacro:call macro="lidar"/>'):
        tree = read_tree(written(tmp_path, robot_of(macro_of("lidar", "x:=1.5", AT_X), calls)))
        assert set(tree.frames) == {"base", "lidar"}


BAD = {
    "": "no known format",
    "no calibration": "no known format",
    "a: 1": "no known format, expected one of calibration, kitti, ros-tf",
    "<html/>": "no known format",
    "<robot": "no XML",
    '<!DOCTYPE x [<!ENTITY a "b">]><robot>&a;</robot>': "a document type",
    "<robot/>": "no fixed joint",
    "<launch/>": "no static_transform_publisher",
    "{}": "no known format",
    "[1]": "no known format",
    "[[[": "no JSON",
    '[{"translation": [0, 0, 0], "rotation": [1, 0, 0, 0]}]': "0 records of a camera",
    "from launch import (": "no Python",
    "P2: 700 0 600 0 0 700 180 0 0 0 1 0": "no line Tr",
    "cam0: {T_cam_imu: 1, T_imu_cam: 2}": "those of kalibr and of openvins",
    "cam0: {T_cam_imu: [1, 2]}": "2 numbers, expected 16",
    "cam0: {T_cam_imu: [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}": "a rotation matrix",
    "rvec: [1, 2]\ntvec: [1, 2, 3]": "2 numbers, expected 3",
    "rvec: [1, 2, 300]\ntvec: [1, 2, 3]": "an angle in radians",
    "transforms: [1]": "no header",
    "transforms: []": "no transform",
    "kit: {lidar: {x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}, b: 1}": "a frame with x, y, z",
    "x: 1\n---\ny: 2\n": "no known format",
}


def test_a_yaml_file_that_is_damaged_says_where(tmp_path: Path) -> None:
    for text, message in (
        ("cam0: {T_cam_imu: [1", "no YAML.*line 1"),
        ("", "an empty file"),
        ("a", "YAML str"),
    ):
        with pytest.raises(DataError, match=message):
            import_calibration(written(tmp_path, text, "camchain.yaml"))


def test_a_rig_is_the_calibration_of_no_single_camera(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"a rig of several cameras, expected the calibration\.json of one"):
        import_calibration(written(tmp_path, '{"format": "sst-graph/rig", "version": 1}'))


@pytest.mark.parametrize("text", BAD)
def test_what_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=BAD[text]) as caught:
        import_calibration(written(tmp_path, text))
    assert "\n" not in str(caught.value) and "file" in str(caught.value)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("0 0 0 0 0 0 velodyne", "7 arguments"),
        ("0 0 0 0 0 0 nan velodyne camera_link", "a finite number"),
        ("0 0 0 0 0 0 2 velodyne camera_link", "a quaternion of length 2"),
        ("1e4 0 0 0 0 0 1 velodyne camera_link", "a translation of"),
        ("--frame-id a --child-frame-id b --nonsense 1", "'--nonsense'"),
        ("--frame-id a --child-frame-id", "without its value"),
        ("--frame-id a --child-frame-id b --qx 1 --roll 2", "a quaternion and angles"),
    ],
)
def test_arguments_that_no_publisher_takes(args: str, message: str, tmp_path: Path) -> None:
    text = f'<launch><node pkg="tf2_ros" exec="static_transform_publisher" name="n" args="{args}"/></launch>'
    with pytest.raises(DataError, match=rf"node 'n'.*{message}"):
        import_calibration(written(tmp_path, text))


def test_a_format_by_name(tmp_path: Path) -> None:
    eye = np.eye(4).tolist()
    both = written(tmp_path, f"cam0: {{T_cam_imu: {eye}, T_imu_cam: {eye}}}")
    assert import_calibration(both, form="kalibr").format == "kalibr"
    with pytest.raises(DataError, match="found a file of the format kalibr, expected the format opencv"):
        import_calibration(both, form="opencv")
    with pytest.raises(DataError, match="expected one of the format urdf"):
        import_calibration(written(tmp_path, "<html/>"), form="urdf")
    with pytest.raises(ConfigError, match="expected one of calibration, kitti"):
        import_calibration(both, form="autocad")


def test_a_vehicle_that_is_none(tmp_path: Path) -> None:
    path = written(tmp_path, "P2: 700 0 600 0 0 700 180 0 0 0 1 0")
    with pytest.raises(
        DataError, match="a file of the format kitti, expected a tree of transforms: one of ros-tf"
    ):
        read_tree(path)
    path = written(tmp_path, '{"format": "sst-graph/rig", "version": 1}')
    with pytest.raises(
        DataError, match="found a rig of several cameras, expected a tree of transforms: one of"
    ):
        read_tree(path)
    with pytest.raises(DataError, match=r"a rig of several cameras, expected the calibration\.json of one"):
        import_calibration(path)


def test_a_loop_of_frames_ends(tmp_path: Path) -> None:
    joint = '<joint name="j" type="fixed"><parent link="{}"/><child link="{}"/></joint>'
    text = f"<robot>{joint.format('lidar', 'a')}{joint.format('a', 'lidar')}</robot>"
    tree = read_tree(written(tmp_path, text))
    assert tree.root("lidar") in ("a", "lidar")


@pytest.mark.parametrize(
    "text", ["\n" * 100_000, " " * 100_000, f'<robot><a params="{"a" * 1_000_000}"/></robot>', "${" * 500_000]
)
def test_no_text_takes_long(text: str, tmp_path: Path) -> None:
    """Lines and words without end, on which a search that starts anew at each of them takes minutes."""
    if text.startswith("<"):
        text = text.replace("<a", '<x:macro xmlns:x="http://www.ros.org/wiki/xacro"')
    began = time.process_time()
    with pytest.raises(DataError):
        import_calibration(written(tmp_path, text))
    assert time.process_time() - began < 2.0


def test_what_ros_users_install_reads_yaml() -> None:
    with (Path(__file__).resolve().parents[2] / "pyproject.toml").open("rb") as stream:
        extras = tomllib.load(stream)["project"]["optional-dependencies"]
    for name in ("yaml", "ros"):
        assert any(each.startswith("PyYAML") for each in extras[name]), name
