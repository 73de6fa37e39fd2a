"""KITTI raw's calibration files as tables (those in YAML: :mod:`sst_graph.files.yaml_file`)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.files.checked_values import put_line
from sst_graph.files.reading import FileKind, read_text

KITTI_RAW_CALIB = FileKind("a KITTI raw calibration", 1024 * 1024)
_LINE = re.compile(r"(?:[KDRTS]|[RSP]_rect)_\d\d|R|T", re.ASCII)


def parse_kitti_raw(text: str, place: str | Path = "calibration") -> dict[str, NDArray[np.float64]]:
    """Numbers of cameras and poses, by key, of ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt`` or
    ``calib_imu_to_velo.txt``; other lines (``calib_time``) are left out.

    Raises:
        DataError: a value of theirs is no finite number, or two lines of one key differ.
    """
    lines: dict[str, NDArray[np.float64]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, words = line.partition(":")
        if not colon or not _LINE.fullmatch(name.strip()):
            continue
        try:
            values = np.array([float(word) for word in words.split()])
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all():
            raise DataError(
                f"{place}:{number}", f"{words.strip()!r:.60}", f"finite numbers for {name.strip()}"
            )
        put_line(lines, name.strip(), values, f"{place}:{number}")
    return lines


def read_kitti_raw(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """As :func:`parse_kitti_raw`, of a file.

    Raises:
        DataError: an unreadable file, or one with a value that is no finite number.
    """
    return parse_kitti_raw(read_text(path, KITTI_RAW_CALIB), path)
