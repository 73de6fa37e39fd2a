"""Transforms in YAML: messages of tf, and Autoware's files of a sensor kit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError
from sst_graph.files.checked_values import pose_by_quaternion
from sst_graph.files.yaml_file import number
from sst_graph.imports.document import Document
from sst_graph.imports.rotations import pose_by_rpy

_MOST = 10_000
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")


def is_message(table: Mapping[str, Any]) -> bool:
    """Whether a table is a TransformStamped, a TFMessage, or several of them."""
    if isinstance(table.get("documents"), list):
        return all(isinstance(part, dict) and is_message(part) for part in table["documents"])
    return isinstance(table.get("transforms"), list) or {"transform", "child_frame_id"} <= set(table)


def messages(document: Document) -> Transforms:
    """Transforms of TransformStamped (``header``, ``child_frame_id``, ``transform``) and TFMessage.

    Raises:
        DataError: a message without frames, translation or rotation.
    """
    found = Transforms()
    for part in document.yaml.get("documents", [document.yaml]):
        for message in part["transforms"] if isinstance(part.get("transforms"), list) else [part]:
            _add_message(found, message, str(document.path))
    if not found.frames:
        raise DataError(document.path, "no transform", "at least one")
    return found


def _add_message(found: Transforms, message: Any, place: str) -> None:
    parent = _text(_part(message, "header", place), "frame_id", place)
    child = _text(message, "child_frame_id", place)
    transform = _part(message, "transform", f"{place} ({child:.60})")
    place = f"{place} ({child:.60})"
    translation, rotation = (_part(transform, name, place) for name in ("translation", "rotation"))
    xyz = [number(translation.get(name), f"{place} {name}") for name in "xyz"]
    xyzw = [number(rotation.get(name), f"{place} {name}") for name in "xyzw"]
    found.add_pose(parent, child, pose_by_quaternion(xyz, np.roll(xyzw, 1), f"{place} ({child!r:.40})"))


def is_sensor_kit(table: Mapping[str, Any]) -> bool:
    """Whether a table holds frames with x, y, z, roll, pitch, yaw below the name of their parent."""
    return any(
        isinstance(frame, dict) and set(_POSE) <= set(frame)
        for frames in table.values()
        if isinstance(frames, dict)
        for frame in frames.values()
    )


def sensor_kit(document: Document) -> Transforms:
    """Transforms of Autoware's ``sensor_kit_calibration.yaml`` or ``sensors_calibration.yaml``.

    Raises:
        DataError: a frame without one of its six numbers.
    """
    found, count = Transforms(), 0
    for parent, frames in document.yaml.items():
        for child, frame in frames.items() if isinstance(frames, dict) else ():
            place = f"{document.path} ({child!s:.60})"
            if not isinstance(frame, dict) or not set(_POSE) <= set(frame):
                raise DataError(place, f"{frame!r:.60}", f"a frame with {', '.join(_POSE)}")
            values = [number(frame[name], f"{place} {name}") for name in _POSE]
            found.add_pose(str(parent), str(child), pose_by_rpy(values[:3], values[3:], place))
            count += 1
            if count > _MOST:
                raise DataError(document.path, f"more than {_MOST} frames", "a sensor kit")
    return found


def _part(message: Any, name: str, place: str) -> Mapping[str, Any]:
    part = message.get(name) if isinstance(message, dict) else None
    if not isinstance(part, dict):
        raise DataError(place, f"no {name}", "header, child_frame_id, transform of a TransformStamped")
    return part


def _text(message: Any, name: str, place: str) -> str:
    text = message.get(name) if isinstance(message, dict) else None
    if not isinstance(text, str):
        raise DataError(place, f"{name} = {text!r:.60}", "the name of a frame")
    return text
