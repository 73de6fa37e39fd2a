"""Cameras on an IMU: Kalibr's camchain, OpenVINS, MINS. The LiDAR stands in the IMU's place, or beside it.

Kalibr: ``T_cam_imu``, the pose of the IMU in the camera; OpenVINS, MINS: ``T_imu_cam``, that of the camera.
All three: t_imu = t_cam + shift, named ``timeshift_cam_imu`` (Kalibr, OpenVINS) or ``timeoffset`` (MINS).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError
from sst_graph.files.checked_values import checked_pose, checked_time_offset_s
from sst_graph.files.yaml_file import number, numbers
from sst_graph.imports.document import Document
from sst_graph.imports.frames import Found, ImportOptions

Table = Mapping[str, Any]


def cameras_of(table: Table) -> dict[str, Table]:
    """The tables of a chain's cameras by name."""
    return {
        str(name): entry
        for name, entry in table.items()
        if isinstance(entry, dict) and ("T_cam_imu" in entry or "T_imu_cam" in entry)
    }


def dialects(table: Table) -> set[str]:
    """Programs whose keys a table has: kalibr, openvins, mins."""
    cameras = cameras_of(table).values()
    found = {"kalibr"} if any("T_cam_imu" in camera for camera in cameras) else set()
    if any("T_imu_cam" in camera for camera in cameras):
        shifted = any("timeshift_cam_imu" in camera for camera in cameras)
        of_mins = any("timeoffset" in camera for camera in cameras) or _lidar(table) is not None
        found |= {"mins"} if of_mins else set()
        found |= {"openvins"} if shifted or not of_mins else set()
    return found


def read_chain(document: Document, options: ImportOptions) -> Found:
    """cTl and time offset [s] of a camera of a chain, and what was taken for what.

    Raises:
        DataError: several cameras and none named, no pose, or no pose of the LiDAR in the IMU's place.
        ConfigError: frames are named that change nothing.
    """
    table = document.yaml
    name, entry = _chosen(cameras_of(table), options, document)
    place = f"{document.path}: {name}"
    if "T_cam_imu" in entry:
        cTi, said = _pose(entry, "T_cam_imu", place), f"T_cam_imu of {name}"
    else:
        cTi, said = _pose(entry, "T_imu_cam", place).inverse(), f"T_imu_cam of {name}"
    shift = _seconds(entry, "timeshift_cam_imu", place)
    shift = _seconds(entry, "timeoffset", place) if shift is None else shift
    lidar = _lidar(table)
    if lidar is not None:
        lidar_name, lidar_entry = lidar
        options.check_effect((), f"{document.path} has the pose of {lidar_name} in the IMU")
        at = f"{document.path}: {lidar_name}"
        of_lidar = _seconds(lidar_entry, "timeoffset", at) or 0.0
        shift = None if shift is None else shift - of_lidar
        cTl = cTi * _pose(lidar_entry, "T_imu_lidar", at)
        return Found(cTl, shift, f"{said}, T_imu_lidar of {lidar_name}")
    if options.parent is None:
        options.check_effect((), "without --parent the LiDAR is in the IMU's place")
        return Found(cTi, shift, f"{said}: the LiDAR in the IMU's place")
    return Found(cTi * _in_tree(options, document), shift, f"{said}: {options.parent} in the IMU's place")


def _in_tree(options: ImportOptions, document: Document) -> gtsam.Pose3:
    """The LiDAR in the frame that stands in the IMU's place."""
    parent, lidar = str(options.parent), options.lidar_frame or "lidar"
    if options.tree is None:
        raise DataError(document.path, f"no pose of {lidar!r} in {parent!r}", "--tree FILE that holds it")
    pose, why = options.tree.pose(parent, lidar)
    if pose is None:
        raise DataError(document.path, why, f"a pose of {lidar!r} in {parent!r} in --tree")
    return pose


def _chosen(cameras: Mapping[str, Table], options: ImportOptions, document: Document) -> tuple[str, Table]:
    if len(cameras) == 1:
        return next(iter(cameras.items()))
    topics = {name: _topic(camera) for name, camera in cameras.items()}
    wanted = None if options.camera is None else options.camera.strip("/")
    for name, topic in topics.items():
        if wanted is not None and wanted in (name, topic):
            return name, cameras[name]
    listed = ", ".join(f"{name} ({topic})" if topic else name for name, topic in topics.items())
    raise DataError(document.path, f"the cameras {listed}", "one of them by --camera NAME")


def _topic(camera: Table) -> str:
    return str(camera.get("rostopic", camera.get("topic", ""))).strip("/")


def _lidar(table: Table) -> tuple[str, Table] | None:
    """The first LiDAR of MINS that has a pose."""
    for name, entry in table.items():
        if re.fullmatch(r"lidar\d+", str(name)) and isinstance(entry, dict) and "T_imu_lidar" in entry:
            return str(name), entry
    return None


def _pose(entry: Table, key: str, place: str) -> gtsam.Pose3:
    if key not in entry:
        raise DataError(place, f"no {key}", f"{key}, 4 rows of 4 numbers")
    return checked_pose(np.array(numbers(entry[key], f"{place}: {key}", 16)).reshape(4, 4), f"{place}: {key}")


def _seconds(entry: Table, key: str, place: str) -> float | None:
    if key not in entry:
        return None
    return checked_time_offset_s(number(entry[key], f"{place}: {key}"), f"{place}: {key}")
