"""Fixed joints of URDF, and of xacro files as far as their macros' defaults determine them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import gtsam

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError
from sst_graph.files.yaml_file import number
from sst_graph.imports.document import Document
from sst_graph.imports.rotations import pose_by_rpy

_REFERENCE = re.compile(r"\$\{\s*(\w+)\s*\}|\$\(arg (\w+)\)")
_DEFAULT = re.compile(r"\b(\w{1,100}):=('[^']*'|\S+)")


def is_xacro(root: ET.Element) -> bool:
    """Whether a ``robot`` has elements of xacro."""
    return any(_xacro_name(element) for element in root.iter())


def joints(document: Document) -> Transforms:
    """The fixed joints of a URDF or xacro file: pose of the child link in the parent link.

    A joint of a xacro file whose values the defaults of parameters, properties and arguments do not determine
    is left out.

    Raises:
        DataError: a fixed joint of a URDF without parent, child, or numbers.
    """
    root, found = document.xml, Transforms()
    with_xacro = is_xacro(root)
    defaults = _defaults(root) if with_xacro else {}
    for joint in root.iter("joint"):
        if joint.get("type") != "fixed":
            continue
        values = {
            f"{element.tag}.{key}": _resolved(value, defaults)
            for element in joint
            for key, value in element.attrib.items()
        }
        if with_xacro and any("$" in value for value in values.values()):
            continue
        place = f"{document.path} (joint {joint.get('name', '')!r:.60})"
        if "parent.link" not in values or "child.link" not in values:
            raise DataError(place, "no parent or no child", "<parent link=.../> and <child link=.../>")
        found.add_pose(values["parent.link"], values["child.link"], _origin(values, place))
    if not found.frames:
        hint = "joints that stand by themselves (xacro FILE > robot.urdf)" if with_xacro else "fixed joints"
        raise DataError(document.path, "no fixed joint", hint)
    return found


def _origin(values: Mapping[str, str], place: str | Path) -> gtsam.Pose3:
    xyz, rpy = (_three(values.get(f"origin.{key}", "0 0 0"), f"{place} {key}") for key in ("xyz", "rpy"))
    return pose_by_rpy(xyz, rpy, str(place))


def _three(text: str, place: str) -> list[float]:
    words = text.split()
    if len(words) != 3:
        raise DataError(place, f"{text!r:.60}", "three numbers")
    return [number(word, place) for word in words]


def _defaults(root: ET.Element) -> dict[str, str]:
    """Values of parameters, properties and arguments by name."""
    found: dict[str, str] = {}
    for element in root.iter():
        kind = _xacro_name(element)
        if kind == "macro":
            pairs = _DEFAULT.findall(element.get("params", ""))
            found.update({name: value.strip("'") for name, value in pairs})
        elif kind in ("property", "arg"):
            value = element.get("value", element.get("default"))
            if value is not None:
                found[element.get("name", "")] = value
    return found


def _resolved(text: str, defaults: Mapping[str, str]) -> str:
    return _REFERENCE.sub(lambda match: defaults.get(match[1] or match[2], match[0]), text)


def _xacro_name(element: ET.Element) -> str:
    """``macro`` of ``{http://www.ros.org/wiki/xacro}macro``; empty for other elements."""
    space, _, name = str(element.tag).rpartition("}")
    return name if space.endswith("xacro") else ""
