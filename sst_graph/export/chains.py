"""Formats of cameras on an IMU: Kalibr's camchain, OpenVINS, MINS.

All have t_imu = t_cam + shift. With t_imu on the LiDAR's clock the shift is +time_offset_s. Where no frame of
the vehicle is named, the LiDAR stands in the IMU's place.
"""

from __future__ import annotations

import gtsam

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.errors import ConfigError
from sst_graph.export.frames import OPTICAL_AXES, Rig
from sst_graph.export.text import hashed, heading, number, numbers, yaml_rows, yaml_text
from sst_graph.result import CalibrationResult


def kalibr(rig: Rig) -> str:
    """Kalibr's camchain: T_cam_imu, the pose of the IMU in the camera; of a rig also T_cn_cnm1."""
    imu, lTi = _imu(rig)
    text = hashed([*_words(rig, imu), "T_cam_imu: p_camera = T_cam_imu * p_imu"])
    if len(rig.cameras) > 1:
        text += hashed(["T_cn_cnm1: pose of the camera before in this one"])
    before: gtsam.Pose3 | None = None
    for k, result in enumerate(rig.cameras.values()):
        cTl = result.T_camera_lidar
        text += f"cam{k}:\n{_intrinsics(result, 'rostopic', pinhole=True)}"
        text += f"  T_cam_imu:\n{yaml_rows((cTl * lTi).matrix(), 2)}\n"
        if before is not None:
            text += f"  T_cn_cnm1:\n{yaml_rows((cTl * before.inverse()).matrix(), 2)}\n"
        text += f"  timeshift_cam_imu: {number(result.time_offset_s)}\n"
        before = cTl
    return text


def openvins(rig: Rig) -> str:
    """OpenVINS' kalibr_imucam_chain.yaml: T_imu_cam, the pose of the camera in the IMU."""
    imu, lTi = _imu(rig)
    lines = [*_words(rig, imu), "T_imu_cam: p_imu = T_imu_cam * p_camera"]
    if len(rig.cameras) > 1:
        lines.append("OpenVINS takes the time shift of cam0 for all cameras")
    text = f"%YAML:1.0\n{hashed(lines)}"
    for k, result in enumerate(rig.cameras.values()):
        iTc = (result.T_camera_lidar * lTi).inverse()
        text += f"cam{k}:\n  T_imu_cam:\n{yaml_rows(iTc.matrix(), 4)}\n"
        text += _intrinsics(result, "rostopic", pinhole=True)
        text += f"  timeshift_cam_imu: {number(result.time_offset_s)}\n"
    return text


def mins(rig: Rig) -> str:
    """Tables of MINS' config_camera.yaml and config_lidar.yaml: T_imu_cam, T_imu_lidar, timeoffset."""
    imu, lTi = _imu(rig)
    lines = [
        *_words(rig, imu),
        "T_imu_cam: p_imu = T_imu_cam * p_camera; T_imu_lidar: p_imu = T_imu_lidar * p_lidar",
        "timeoffset: t_imu = t_sensor + timeoffset, with the IMU on the LiDAR's clock",
        "camN belong into config_camera.yaml, lidar0 into config_lidar.yaml",
    ]
    text = f"%YAML:1.0\n{hashed(lines)}"
    for k, result in enumerate(rig.cameras.values()):
        iTc = (result.T_camera_lidar * lTi).inverse()
        text += f"cam{k}:\n  timeoffset: {number(result.time_offset_s)}\n"
        text += f"  T_imu_cam:\n{yaml_rows(iTc.matrix(), 4)}\n{_intrinsics(result, 'topic', pinhole=False)}"
    text += f"lidar0:\n  timeoffset: 0.0\n  T_imu_lidar:\n{yaml_rows(lTi.inverse().matrix(), 4)}\n"
    return text + f'  topic: "/{rig.options.lidar_frame.lstrip("/")}"\n'


def _imu(rig: Rig) -> tuple[str, gtsam.Pose3]:
    """Name of the frame in the IMU's place, and its pose in the LiDAR."""
    options = rig.options
    if options.tree is not None and options.parent is None:
        raise ConfigError(
            "--tree with a chain of cameras on an IMU: expected the IMU's frame by --parent NAME"
        )
    return options.parent or options.lidar_frame, rig.lidar_in(options.parent, "the IMU").inverse()


def _words(rig: Rig, imu: str) -> list[str]:
    lidar = rig.options.lidar_frame
    lines = ["LiDAR-camera calibration by sst-graph"]
    for k, (name, result) in enumerate(rig.cameras.items()):
        lines += [
            f"cam{k}: camera {rig.frames[name].optical} (optical frame: {OPTICAL_AXES}), LiDAR {lidar}",
            *heading(result, f"cam{k}"),
        ]
    at = "the LiDAR stands in the IMU's place" if imu == lidar else f"{imu} stands in the IMU's place"
    return [
        *lines,
        f"{at}: t_imu = t_cam + shift, with t_imu on the LiDAR's clock: shift = +time_offset_s",
        *_of_lenses(rig),
    ]


def _of_lenses(rig: Rig) -> list[str]:
    distorted = any(EstimatedCamera.of(result).distorts for result in rig.cameras.values())
    return [] if distorted else ["the images are rectified: no distortion"]


def _intrinsics(result: CalibrationResult, topic: str, pinhole: bool) -> str:
    camera = EstimatedCamera.of(result)
    # The pinhole of rectified pictures does not belong to the topic of those that the lens took.
    images = (result.image_topic or "/" + result.camera_name.lstrip("/")) + "_rectified" * bool(result.lens)
    distortion = ", ".join(numbers([camera.k1, camera.k2, 0.0, 0.0]))
    values = ", ".join(numbers([camera.fx, camera.fy, camera.cx, camera.cy]))
    return (
        ("  camera_model: pinhole\n" if pinhole else "")
        + f"  intrinsics: [{values}]\n"
        + "  distortion_model: radtan\n"
        + f"  distortion_coeffs: [{distortion}]\n"
        + f"  resolution: [{camera.width}, {camera.height}]\n"
        + f"  {topic}: {yaml_text(images)}\n"
    )
