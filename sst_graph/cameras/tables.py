"""Files of cameras as tables: YAML (Kalibr, ROS, OpenCV's FileStorage) and KITTI raw's text."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, MissingDependencyError
from sst_graph.files.reading import FileKind, read_text

CAMERA_YAML = FileKind("a camera's YAML file", 1024 * 1024)
KITTI_RAW_CALIB = FileKind("a calibration file of KITTI raw", 1024 * 1024)


def read_camera_yaml(path: str | Path) -> Mapping[str, Any]:
    """Table in a YAML file; OpenCV's header and matrix tags are understood.

    Raises:
        DataError: an unreadable file, no YAML, or no table.
        MissingDependencyError: PyYAML is not installed.
    """
    return parse_camera_yaml(read_text(path, CAMERA_YAML), path)


def parse_camera_yaml(text: str, place: str | Path) -> Mapping[str, Any]:
    """Table in a YAML text; errors as :func:`read_camera_yaml`."""
    try:
        import yaml
    except ImportError as error:
        raise MissingDependencyError(
            "YAML files need PyYAML, which is not installed: pip install 'sst-graph[yaml]'"
        ) from error

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Plain values, and OpenCV's matrices as tables."""

    def matrix(loader: Any, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    # OpenCV writes "%YAML:1.0", which is no directive of YAML.
    lines = [line for line in text.splitlines() if not line.startswith("%YAML:")]
    try:
        table = yaml.load("\n".join(lines), Loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise DataError(place, f"no YAML ({str(error).splitlines()[0]:.120})", CAMERA_YAML.name) from None
    if not isinstance(table, Mapping):
        raise DataError(place, f"a YAML {type(table).__name__}", "a table of keys and values")
    return table


def parse_kitti_raw(text: str) -> dict[str, NDArray[np.float64]]:
    """Numbers by key of ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt`` or ``calib_imu_to_velo.txt``;
    lines with other than numbers (``calib_time``) are left out."""
    table = {}
    for line in text.splitlines():
        key, colon, values = line.partition(":")
        try:
            numbers = np.array([float(word) for word in values.split()])
        except ValueError:
            continue
        if colon and len(numbers):
            table[key.strip()] = numbers
    return table


def read_kitti_raw(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """As :func:`parse_kitti_raw`, of a file.

    Raises:
        DataError: an unreadable file.
    """
    return parse_kitti_raw(read_text(path, KITTI_RAW_CALIB))
