"""Fixed joints of URDF, and of xacro files as far as their macros' defaults determine them.

Nothing of xacro is run. A joint that the defaults do not determine, or that may not be there, is left out.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import ChainMap
from collections.abc import Iterator, Mapping
from pathlib import Path

import gtsam

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError
from sst_graph.files.yaml_file import number
from sst_graph.imports.document import Document
from sst_graph.imports.rotations import pose_by_rpy

_REFERENCE = re.compile(r"\$\{\s*(\w+)\s*\}|\$\(arg (\w+)\)")
_DEFAULT = re.compile(r"(?<!\S)(\w{1,100}):?=('[^']*'|\S+)")

_Table = dict[str, str | None]
"""Values by name, ``arg NAME`` for an argument of the file; None for one that is not determined."""


def is_xacro(root: ET.Element) -> bool:
    """Whether a ``robot`` has elements of xacro."""
    return any(_xacro_name(element) for element in root.iter())


def joints(document: Document) -> Transforms:
    """The fixed joints of a URDF or xacro file: pose of the child link in the parent link.

    A joint of a xacro file is left out where the defaults of parameters, properties and arguments do not
    determine it: with another expression, with an element of xacro, in a condition, and in a macro that is
    called with arguments, with a block, or in a condition.

    Raises:
        DataError: a fixed joint of a URDF without parent, child, or numbers.
    """
    root, found = document.xml, Transforms()
    with_xacro = is_xacro(root)
    places = _determined(root) if with_xacro else ((joint, {}) for joint in root.iter("joint"))
    for joint, known in places:
        if joint.get("type") != "fixed":
            continue
        values = {
            f"{element.tag}.{key}": _resolved(value, known)
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


def _determined(root: ET.Element) -> Iterator[tuple[ET.Element, Mapping[str, str | None]]]:
    """The joints that are there whatever a condition says, and the values that are known where they stand."""
    outside: _Table = {}
    joints: list[tuple[ET.Element, str, _Table]] = []
    varied: set[str] = set()  # macros that are not always called as their defaults have it
    waiting: list[tuple[ET.Element, str, _Table, bool]] = [(root, "", outside, True)]
    while waiting:
        element, macro, own, always = waiting.pop()
        kind = _xacro_name(element)
        if kind == "macro":
            macro, own = element.get("name", ""), _parameters(element.get("params", ""))
        elif kind == "arg":
            _take(outside, f"arg {element.get('name')}", element.get("default") if always else None)
        elif kind == "property":
            wider = element.get("scope") is not None
            value = element.get("value", element.get("default"))
            _take(outside if wider else own, element.get("name", ""), value if always and not wider else None)
            always = False
        elif kind:
            arguments = dict(element.attrib)
            called = arguments.pop("macro", "") if kind == "call" else kind
            if not always or arguments or len(element):
                varied.add(called)
            always = False
        elif element.tag == "joint" and always and not any(map(_xacro_name, element)):
            joints.append((element, macro, own))
        waiting += [(child, macro, own, always) for child in element[::-1]]
    for joint, macro, own in joints:
        if macro not in varied:
            yield joint, ChainMap(own, outside)


def _parameters(params: str) -> _Table:
    """Defaults of a macro's parameters; None without one, and where the place of the call determines it."""
    found: _Table = {word.lstrip("*"): None for word in _DEFAULT.sub(" ", params).split()}
    for name, value in _DEFAULT.findall(params):
        found[name] = None if value.startswith("^") else value.strip("'")
    return found


def _take(values: _Table, name: str, value: str | None) -> None:
    """Take a value; one of several that differ is not determined."""
    values[name] = value if values.get(name, value) == value else None


def _resolved(text: str, known: Mapping[str, str | None]) -> str:
    def value(match: re.Match[str]) -> str:
        found = known.get(match[1] or f"arg {match[2]}")
        return match[0] if found is None else found

    return _REFERENCE.sub(value, text)


def _xacro_name(element: ET.Element) -> str:
    """``macro`` of ``{http://www.ros.org/wiki/xacro}macro``; empty for other elements."""
    space, _, name = str(element.tag).rpartition("}")
    return name if space.endswith("xacro") else ""
