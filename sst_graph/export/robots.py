"""Transforms between named frames in the formats of ROS: messages, launch files, URDF, xacro, Autoware.

All write the pose of the child in the parent. Angles are about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from collections.abc import Sequence

from sst_graph.errors import ConfigError
from sst_graph.export.frames import LINK_AXES, Rig, StaticTransform, filled
from sst_graph.export.options import CAMERA
from sst_graph.export.text import hashed, heading, numbers, row, xml_comment, yaml_text
from sst_graph.imports.rotations import fixed_axis_rpy, quaternion_xyzw

_QUATERNION = "rotations: quaternions x y z w"
_ANGLES = "rpy: about the fixed axes x, y, z [rad], R = Rz(yaw) Ry(pitch) Rx(roll)"
_KIT = "sensor_kit_base_link"


def ros_tf(rig: Rig) -> str:
    """geometry_msgs/TransformStamped in YAML, several of them in a tf2_msgs/TFMessage; and the commands."""
    transforms = rig.transforms()
    commands = [f"ros2 run tf2_ros static_transform_publisher {' '.join(_flags(one))}" for one in transforms]
    # The flags begin with two hyphens, which a comment of YAML may hold.
    head = hashed([*rig.words(transforms), *commands])
    if len(transforms) == 1:
        return head + _message(transforms[0])
    items = (_message(one).replace("\n", "\n    ").rstrip() for one in transforms)
    return head + "transforms:\n" + "".join(f"  - {item}\n" for item in items)


def ros1_launch(rig: Rig) -> str:
    """A launch file of ROS 1: tf2_ros' publisher takes x y z qx qy qz qw parent child."""
    transforms = rig.transforms()
    nodes = (
        f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{_node(one)}"\n'
        f'        args="{row(one.pose.translation())} {row(quaternion_xyzw(one.pose.rotation()))} '
        f'{one.parent} {one.child}"/>\n'
        for one in transforms
    )
    words = [*rig.words(transforms), "args: x y z qx qy qz qw parent child"]
    return f'<?xml version="1.0"?>\n{xml_comment(words)}<launch>\n{"".join(nodes)}</launch>\n'


def ros2_launch_xml(rig: Rig) -> str:
    """A launch file of ROS 2 in XML."""
    transforms = rig.transforms()
    nodes = (
        f'  <node pkg="tf2_ros" exec="static_transform_publisher" name="{_node(one)}"\n'
        f'        args="{" ".join(_flags(one))}"/>\n'
        for one in transforms
    )
    words = [*rig.words(transforms), _QUATERNION]
    return f'<?xml version="1.0"?>\n{xml_comment(words)}<launch>\n{"".join(nodes)}</launch>\n'


def ros2_launch(rig: Rig) -> str:
    """A launch file of ROS 2 in Python."""
    transforms = rig.transforms()
    nodes = []
    for one in transforms:
        flags = _flags(one)
        pairs = zip(flags[::2], flags[1::2], strict=True)
        lines = "".join(f'                    "{flag}", "{value}",\n' for flag, value in pairs)
        nodes.append(
            "            Node(\n"
            '                package="tf2_ros",\n'
            '                executable="static_transform_publisher",\n'
            f'                name="{_node(one)}",\n'
            f"                arguments=[\n{lines}                ],\n"
            "            ),\n"
        )
    return (
        f"{hashed([*rig.words(transforms), _QUATERNION])}"
        "from launch import LaunchDescription\n"
        "from launch_ros.actions import Node\n"
        "\n\n"
        "def generate_launch_description():\n"
        "    return LaunchDescription(\n"
        f"        [\n{''.join(nodes)}        ]\n"
        "    )\n"
    )


def urdf(rig: Rig) -> str:
    """A robot of fixed joints."""
    transforms = rig.transforms()
    names = list(dict.fromkeys(frame for one in transforms for frame in (one.parent, one.child)))
    links = "".join(f'  <link name="{name}"/>\n' for name in names)
    joints = "".join(_joint(one, one.parent, one.child, "  ") for one in transforms)
    return (
        f'<?xml version="1.0"?>\n{xml_comment([*rig.words(transforms), _ANGLES])}'
        f'<robot name="lidar_camera">\n{links}{joints}</robot>\n'
    )


def xacro(rig: Rig) -> str:
    """A macro that adds each child and its fixed joint to a robot that has the parent.

    The names of the frames are its parameters: ``parent`` and ``child`` of the first transform, then
    ``parent_1`` and ``child_1``, and so on.
    """
    transforms = rig.transforms()
    parameters: dict[str, str] = {}
    body = ""
    for k, one in enumerate(transforms):
        references = []
        for role, frame in (("parent", one.parent), ("child", one.child)):
            known = next((name for name, value in parameters.items() if value == frame), None)
            name = known or (f"{role}_{k}" if k else role)
            parameters.setdefault(name, frame)
            references.append(f"${{{name}}}")
        body += f'    <link name="{references[1]}"/>\n' + _joint(one, references[0], references[1], "    ")
    given = " ".join(f"{name}:={value}" for name, value in parameters.items())
    usage = [
        "to be included by a robot: <xacro:include filename='...'/>, then <xacro:lidar_camera/> after the",
        "links of the parents; it adds the children",
    ]
    return (
        f'<?xml version="1.0"?>\n{xml_comment([*rig.words(transforms), _ANGLES, *usage])}'
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
        f'  <xacro:macro name="lidar_camera" params="{given}">\n{body}  </xacro:macro>\n</robot>\n'
    )


def autoware(rig: Rig) -> str:
    """Autoware's sensor_kit_calibration.yaml: LiDAR and camera links in the kit's frame.

    Autoware places the camera *link* (x forward); its optical frame follows from it. Without a tree the LiDAR
    is at the kit's origin.

    Raises:
        ConfigError: the tree has no frame that can be the kit's.
    """
    options = rig.options
    kit = options.parent or _kit(rig)
    kitTl = rig.lidar_in(kit if options.tree is not None or options.parent is not None else None, "the kit")
    lines = ["LiDAR-camera calibration by sst-graph"]
    poses = [(options.lidar_frame, kitTl)]
    usual = options.camera_link or (
        "camera{number}/camera_link" if options.camera_frame is None else f"{CAMERA}/camera_link"
    )
    for number, (name, result) in enumerate(rig.cameras.items()):
        link = filled(usual, name, number)
        lines += [
            f"parent {kit} (sensor kit), child {link} (camera, link: {LINK_AXES}):",
            f"p_parent = T * p_child; its optical frame is {rig.frames[name].optical}",
            *heading(result, link),
        ]
        poses.append((link, kitTl * (rig.link_from_optical(name) * result.T_camera_lidar).inverse()))
    lines += [
        f"parent {kit}, child {options.lidar_frame} (LiDAR): the frame that the points are in"
        + ("" if options.tree is not None else ", put at the kit's origin"),
        "roll, pitch, yaw: about the fixed axes x, y, z [rad], R = Rz(yaw) Ry(pitch) Rx(roll)",
    ]
    text = f"{hashed(lines)}{yaml_text(kit)}:\n"
    for frame, pose in poses:
        values = [*numbers(pose.translation()), *numbers(fixed_axis_rpy(pose.rotation()))]
        fields = zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)
        text += f"  {yaml_text(frame)}:\n" + "".join(f"    {key}: {value}\n" for key, value in fields)
    return text


def _kit(rig: Rig) -> str:
    """Autoware's own name for the kit's frame; of a tree without it, the root above the LiDAR."""
    tree, lidar = rig.options.tree, rig.options.lidar_frame
    if tree is None or _KIT in tree.frames:
        return _KIT
    rig.check_tree()
    root = tree.root(lidar)
    if root == lidar:
        raise ConfigError(
            f"--tree: found neither a frame {_KIT!r} nor one above {lidar!r}, expected the kit's, by --parent"
        )
    return root


def _message(one: StaticTransform) -> str:
    """A TransformStamped as YAML."""
    x, y, z = numbers(one.pose.translation())
    qx, qy, qz, qw = numbers(quaternion_xyzw(one.pose.rotation()))
    return (
        f"header:\n  frame_id: {yaml_text(one.parent)}\nchild_frame_id: {yaml_text(one.child)}\n"
        f"transform:\n  translation: {{x: {x}, y: {y}, z: {z}}}\n"
        f"  rotation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}\n"
    )


def _flags(one: StaticTransform) -> list[str]:
    """Arguments of ROS 2's static_transform_publisher."""
    values = [*numbers(one.pose.translation()), *numbers(quaternion_xyzw(one.pose.rotation()))]
    names: Sequence[str] = ("x", "y", "z", "qx", "qy", "qz", "qw", "frame-id", "child-frame-id")
    pairs = zip(names, [*values, one.parent, one.child], strict=True)
    return [word for name, value in pairs for word in (f"--{name}", value)]


def _joint(one: StaticTransform, parent: str, child: str, indent: str) -> str:
    """A fixed joint; parent and child are the names, or xacro's references to them."""
    lines = (
        f'<joint name="{parent.replace("/", "_")}_to_{child.replace("/", "_")}" type="fixed">',
        f'  <parent link="{parent}"/>',
        f'  <child link="{child}"/>',
        f'  <origin xyz="{row(one.pose.translation())}" rpy="{row(fixed_axis_rpy(one.pose.rotation()))}"/>',
        "</joint>",
    )
    return "".join(f"{indent}{line}\n" for line in lines)


def _node(one: StaticTransform) -> str:
    """Name of a node, of letters, digits and _."""
    plain = "".join(c if c.isalnum() else "_" for c in f"{one.parent}_to_{one.child}")
    return f"static_tf_{plain.strip('_')}"
