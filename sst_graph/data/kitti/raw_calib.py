"""Calibration of a KITTI raw recording: ``calib_cam_to_cam.txt`` and ``calib_velo_to_cam.txt``.

Rectified pictures (``_sync``) follow uv1 ~ P_rect_0N R_rect_00 [R T]_velo lP1 (KITTI devkit), so that
cTl = [I | K^-1 P_rect_0N[:, 3]] R_rect_00 [R T]_velo with K = P_rect_0N[:, :3]. Pictures as recorded
(``_extract``) follow K_0N with the distortion D_0N, and cTl = [R_0N T_0N] [R T]_velo; rectifying them
(:mod:`sst_graph.data.rectified`) keeps cTl.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import BrownConradyCamera, CameraModel
from sst_graph.cameras.readers import camera_from_kitti_raw
from sst_graph.data.kitti.calib import KittiCalibration, numbers_by_name, pose_from
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.files.reading import FileKind, read_text
from sst_graph.types import FloatArray

KITTI_RAW_CALIB = FileKind("a KITTI raw calibration", 1024 * 1024)
_LINE = re.compile(r"(?:[KDRTS]|[RSP]_rect)_\d\d|R|T", re.ASCII)


def parse_kitti_raw(text: str, place: str | Path = "calibration") -> dict[str, NDArray[np.float64]]:
    """Numbers of cameras and poses, by key, of ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt`` or
    ``calib_imu_to_velo.txt``; other lines (``calib_time``) are left out.

    Raises:
        DataError: a value of theirs is no finite number, or two lines of one key differ.
    """
    return numbers_by_name(text, _LINE, place)


def read_kitti_raw(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """As :func:`parse_kitti_raw`, of a file.

    Raises:
        DataError: an unreadable file, or one with a value that is no finite number.
    """
    return parse_kitti_raw(read_text(path, KITTI_RAW_CALIB), path)


CAM_TO_CAM, VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"


@dataclass(frozen=True)
class RawCalibration:
    """Calibration of one day of recording.

    Attributes:
        folder: with the two files, named in errors.
        cameras: lines of ``calib_cam_to_cam.txt`` by name, "P_rect_02": (n,).
        c0Tl: pose of the LiDAR in camera 0, not rectified.
    """

    folder: Path
    cameras: Mapping[str, FloatArray]
    c0Tl: gtsam.Pose3

    def size(self, camera: int, rectified: bool) -> tuple[int, int]:
        """Width and height [px] of the pictures of a camera.

        Raises:
            DataError: no such line.
        """
        name = f"S_rect_{camera:02d}" if rectified else f"S_{camera:02d}"
        width, height = self._line(name, 2)
        return round(width), round(height)

    def rectified(self, camera: int, width: int, height: int) -> tuple[CameraModel, gtsam.Pose3]:
        """The pinhole of a camera's rectified pictures of width x height [px], and cTl.

        Raises:
            DataError: a line is missing, or holds no such matrix.
        """
        P = self._line(f"P_rect_{camera:02d}", 12).reshape(3, 4)
        R = self._line("R_rect_00", 9).reshape(3, 3)
        place = f"{self.folder / CAM_TO_CAM} (R_rect_00)"
        c0Tl = pose_from(np.column_stack([R, np.zeros(3)]), place) * self.c0Tl
        named = f"image_{camera}"
        odometry = KittiCalibration(self.folder / CAM_TO_CAM, {camera: P}, c0Tl)
        return BrownConradyCamera(odometry.camera(named, width, height)), odometry.cTl(named)

    def as_recorded(self, camera: int) -> tuple[CameraModel, gtsam.Pose3]:
        """The camera, with its distortion, of pictures as recorded, and cTl.

        Raises:
            DataError: a line is missing or holds no such matrix.
        """
        path = self.folder / CAM_TO_CAM
        model = camera_from_kitti_raw(self.cameras, camera, rectified=False, place=path)
        R = self._line(f"R_{camera:02d}", 9).reshape(3, 3)
        t = self._line(f"T_{camera:02d}", 3)
        cTc0 = pose_from(np.column_stack([R, t]), f"{path} (R_{camera:02d}, T_{camera:02d})")
        return model, cTc0 * self.c0Tl

    def _line(self, name: str, count: int) -> FloatArray:
        path = self.folder / CAM_TO_CAM
        if name not in self.cameras:
            raise DataError(path, f"no line {name}", f"{name}: {count_of(count, 'number')}")
        values = self.cameras[name]
        if len(values) != count:
            raise DataError(path, f"{count_of(len(values), 'value')} for {name}", f"{count}")
        return values


def read_raw_calibration(folder: Path) -> RawCalibration:
    """Read the two files of a folder.

    Raises:
        DataError: a file is missing, a value is no finite number, or no rigid transform.
    """
    cameras = read_kitti_raw(folder / CAM_TO_CAM)
    path = folder / VELO_TO_CAM
    lidar = read_kitti_raw(path)
    for name, count in (("R", 9), ("T", 3)):
        if len(lidar.get(name, ())) != count:
            raise DataError(path, f"{count_of(len(lidar.get(name, ())), 'value')} for {name}", f"{count}")
    matrix = np.column_stack([lidar["R"].reshape(3, 3), lidar["T"]])
    return RawCalibration(folder, cameras, pose_from(matrix, f"{path} (R, T)"))


def raw_camera_number(camera: str) -> int:
    """Number of a camera named image_2 or image_02.

    Raises:
        ConfigError: another name.
    """
    match = re.fullmatch(r"image_0?(\d)", camera, re.ASCII)
    if match is None:
        raise ConfigError(f"camera {camera!r}: expected image_0N, as in image_02")
    return int(match.group(1))
