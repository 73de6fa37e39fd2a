"""Static transform publishers of launch files: ROS 1 and ROS 2 in XML, ROS 2 in Python."""

from __future__ import annotations

import ast
from collections.abc import Sequence

import gtsam
import numpy as np

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError, count_of
from sst_graph.files.checked_values import pose_by_quaternion
from sst_graph.files.yaml_file import number
from sst_graph.imports.document import Document
from sst_graph.imports.rotations import pose_by_rpy

PUBLISHER = "static_transform_publisher"
_FLAGS = ("x", "y", "z", "qx", "qy", "qz", "qw", "roll", "pitch", "yaw", "frame-id", "child-frame-id")


def xml_publishers(document: Document) -> Transforms:
    """The transforms that a launch file in XML publishes.

    Raises:
        DataError: none, or arguments that a publisher does not take.
    """
    found = Transforms()
    for node in document.xml.iter("node"):
        if PUBLISHER in (node.get("type"), node.get("exec")):
            words = node.get("args", "").split()
            if node.get("pkg") == "tf" and len(words) in (9, 10):
                words = words[:-1]  # the last is a period
            _add(found, words, f"{document.path} (node {node.get('name', '')!r:.60})")
    return _some(found, document)


def python_publishers(document: Document) -> Transforms:
    """The transforms that a launch file in Python publishes; the file is read and not run.

    Raises:
        DataError: no publisher, or one whose arguments are no texts or no numbers.
    """
    found = Transforms()
    for call in ast.walk(document.python):
        if isinstance(call, ast.Call) and getattr(call.func, "id", getattr(call.func, "attr", "")) == "Node":
            given = {keyword.arg: keyword.value for keyword in call.keywords}
            if _constant(given.get("executable")) == PUBLISHER:
                place = f"{document.path}:{call.lineno}"
                _add(found, _texts(given.get("arguments"), place), place)
    return _some(found, document)


def _texts(node: ast.expr | None, place: str) -> list[str]:
    words = [_constant(item) for item in node.elts] if isinstance(node, ast.List | ast.Tuple) else [None]
    texts = [word for word in words if word is not None]
    if len(texts) < len(words):
        raise DataError(place, f"a {PUBLISHER} whose arguments are no plain list", "a list of texts")
    return texts


def _constant(node: ast.expr | None) -> str | None:
    value = node.value if isinstance(node, ast.Constant) else None
    return value if isinstance(value, str) else None


def _add(found: Transforms, words: Sequence[str], place: str) -> None:
    if any(word in ("--frame-id", "--child-frame-id") for word in words):
        parent, child, pose = _by_flags(words, place)
    else:
        parent, child, pose = _by_position(words, place)
    found.add_pose(parent, child, pose)


def _by_flags(words: Sequence[str], place: str) -> tuple[str, str, gtsam.Pose3]:
    """--x --y --z, and --qx --qy --qz --qw or --roll --pitch --yaw; what is not given is 0."""
    given = dict(zip(words[::2], words[1::2], strict=False))
    unknown = [flag for flag in given if flag.removeprefix("--") not in _FLAGS or not flag.startswith("--")]
    missing = [flag for flag in ("--frame-id", "--child-frame-id") if flag not in given]
    if unknown or missing or len(words) % 2:
        found = f"{unknown[0]!r:.60}" if unknown else "a flag without its value or its frame"
        raise DataError(place, found, f"the flags of {PUBLISHER}, each with a value")
    by_quaternion = any(f"--q{axis}" in given for axis in "xyzw")
    if by_quaternion and any(f"--{angle}" in given for angle in ("roll", "pitch", "yaw")):
        raise DataError(place, "a quaternion and angles", "one of them")

    def values(names: str) -> list[float]:
        default = {"qw": "1"} if by_quaternion else {}
        return [number(given.get(f"--{name}", default.get(name, "0")), place) for name in names.split()]

    parent, child, xyz = given["--frame-id"], given["--child-frame-id"], values("x y z")
    if by_quaternion:
        return parent, child, pose_by_quaternion(xyz, values("qw qx qy qz"), f"{place} ({child!r:.40})")
    return parent, child, pose_by_rpy(xyz, values("roll pitch yaw"), place)


def _by_position(words: Sequence[str], place: str) -> tuple[str, str, gtsam.Pose3]:
    """x y z qx qy qz qw parent child, or x y z yaw pitch roll parent child."""
    if len(words) not in (8, 9):
        expected = "x y z qx qy qz qw parent child, x y z yaw pitch roll parent child, or flags"
        raise DataError(place, count_of(len(words), "argument"), expected)
    *values, parent, child = words
    numbers = [number(word, place) for word in values]
    xyz, rotation = numbers[:3], numbers[3:]
    if len(rotation) == 4:
        return parent, child, pose_by_quaternion(xyz, np.roll(rotation, 1), f"{place} ({child!r:.40})")
    return parent, child, pose_by_rpy(xyz, rotation[::-1], place)


def _some(found: Transforms, document: Document) -> Transforms:
    if not found.frames:
        raise DataError(document.path, f"no {PUBLISHER}", f"a node that is a {PUBLISHER}")
    return found
