"""Poses between cameras from the files of other programs: Kalibr's camchain, KITTI's calib.txt."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import DataError
from sst_graph.files.checked_values import checked_pose
from sst_graph.files.yaml_file import numbers, read_yaml
from sst_graph.rig.known import ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M, KnownPose

_LINK = "T_cn_cnm1"


def read_known_poses(
    path: Path,
    cameras: Sequence[str],
    rotation_sigma_deg: float = ROTATION_SIGMA_DEG,
    translation_sigma_m: float = TRANSLATION_SIGMA_M,
) -> tuple[KnownPose, ...]:
    """The poses between neighbouring cameras by a file.

    A ``calib.txt`` of KITTI's (its P lines), or a camera chain in YAML as Kalibr writes it: a table for each
    camera with ``T_cn_cnm1``, the pose of the camera before it in this one. Its cameras are found by the name
    of their table, or by their ``rostopic`` or its namespace (``cam0`` of ``/cam0/image_raw``).

    Args:
        cameras: names of the rig's cameras.
        rotation_sigma_deg, translation_sigma_m: deviation of each link; those of several add up.

    Raises:
        DataError: a file that holds no such poses, or not those of every camera.
        MissingDependencyError: a YAML file, and PyYAML is not installed.
    """
    if path.suffix == ".txt":
        calibration = read_calibration(path)
        chain = [(name, 1, calibration.cTc0(name)) for name in cameras]
    else:
        chain = _of_chain(read_yaml(path), cameras, path)
    found = []
    for (reference, first, bT0), (camera, last, cT0) in pairwise(chain):
        root = math.sqrt(max(1, last - first))
        found.append(
            KnownPose(
                camera,
                reference,
                cT0 * bT0.inverse(),
                root * rotation_sigma_deg,
                root * translation_sigma_m,
            )
        )
    return tuple(found)


def _of_chain(
    table: Mapping[str, Any], cameras: Sequence[str], path: Path
) -> list[tuple[str, int, gtsam.Pose3]]:
    """The rig's cameras in the order of a chain: name, place in it, pose of the chain's first camera."""
    entries = [(key, value) for key, value in table.items() if isinstance(value, dict)]
    if all(re.fullmatch(r"cam\d{1,9}", str(key)) for key, _ in entries):
        entries.sort(key=lambda entry: int(str(entry[0])[3:]))
    names = {str(key): str(value.get("rostopic", "")) for key, value in entries}
    found: list[tuple[str, int, gtsam.Pose3]] = []
    cT0 = gtsam.Pose3()
    for place, (key, entry) in enumerate(entries):
        if place:
            cT0 = _link(entry, f"{path}: {key}") * cT0
        found += [(camera, place, cT0) for camera in cameras if _is(camera, str(key), names[str(key)])]
    missing = [camera for camera in cameras if camera not in [name for name, _, _ in found]]
    if missing or not entries:
        listed = ", ".join(f"{key} ({topic})" if topic else key for key, topic in names.items())
        named = missing[0] if missing else "any camera"
        raise DataError(path, f"the cameras {listed or 'none'}", f"one of the name or rostopic {named}")
    if len(found) > len(cameras):
        twice = next(name for name, _, _ in found if sum(name == other for other, _, _ in found) > 1)
        raise DataError(path, f"{twice} twice", "each camera once")
    return found


def _is(camera: str, key: str, topic: str) -> bool:
    """Whether a camera is that of a table: by its name, its topic, or the topic's namespace."""
    plain, whole = camera.strip("/"), topic.strip("/")
    return camera == key or (bool(plain) and f"{whole}/".startswith(f"{plain}/"))


def _link(entry: Mapping[str, Any], place: str) -> gtsam.Pose3:
    if _LINK not in entry:
        raise DataError(place, f"no {_LINK}", f"{_LINK}, the pose of the camera before it in this one")
    values = numbers(entry[_LINK], f"{place}: {_LINK}", 16)
    return checked_pose(np.array(values).reshape(4, 4), f"{place}: {_LINK}")
