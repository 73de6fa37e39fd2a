"""A calibration as text for other programs; each says which frame is the parent and the offset's sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.kitti.calib import KittiCalibration
from sst_graph.errors import ConfigError
from sst_graph.export.marginal import marginal_of_result
from sst_graph.result import CalibrationResult

FloatArray = NDArray[np.float64]

LINK_FROM_OPTICAL = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])), np.zeros(3)
)
"""Camera link (x forward, y left, z up) from the optical frame (x right, y down, z forward): REP 103."""


@dataclass(frozen=True)
class ExportOptions:
    """Names and files that the formats need beside the result.

    Attributes:
        camera_frame: name of the camera's optical frame.
        lidar_frame: name of the LiDAR's frame.
        kitti: calib.txt whose P lines say where the camera stands beside camera 0; None takes the
            camera itself for camera 0.
    """

    camera_frame: str = "camera_optical_frame"
    lidar_frame: str = "lidar"
    kitti: KittiCalibration | None = None

    def __post_init__(self) -> None:
        for name in (self.camera_frame, self.lidar_frame):
            if not name or any(c.isspace() or c in "<>&\"'#:" for c in name) or "--" in name:
                raise ConfigError(f"frame name {name!r}: expected letters, digits, '_', '/', '-'")


def export_text(result: CalibrationResult, target: str, options: ExportOptions | None = None) -> str:
    """The calibration in a format of :data:`FORMATS`.

    Raises:
        ConfigError: an unknown format, or options that do not fit it.
        EstimationError: a result whose covariance has no inverse (gtsam only).
    """
    if target not in FORMATS:
        raise ConfigError(f"export format {target!r}: expected one of {', '.join(FORMATS)}")
    return FORMATS[target](result, options or ExportOptions())


def kitti(result: CalibrationResult, options: ExportOptions) -> str:
    """KITTI odometry ``calib.txt``: P lines, and Tr: the LiDAR in the rectified camera **0**.

    uv1 ~ PN [Tr; 0 0 0 1] lP1, so that for camera N Tr = [I | K^-1 PN[:, 3]]^-1 T_camera_lidar. The
    format has no comments and no time offset.
    """
    if options.kitti is not None:
        projections = dict(options.kitti.projections)
        c0Tl = options.kitti.cTc0(result.camera_name).inverse() * result.T_camera_lidar
    else:
        camera = result.camera_name.removeprefix("image_").lstrip("0") or "0"
        own = int(camera) if camera.isdecimal() else 0
        P = np.hstack([result.camera.matrix, np.zeros((3, 1))])
        projections = {number: P for number in sorted({0, own})}
        c0Tl = result.T_camera_lidar
    lines = [f"P{number}: {_row(matrix)}" for number, matrix in sorted(projections.items())]
    return "\n".join([*lines, f"Tr: {_row(c0Tl.matrix()[:3])}"]) + "\n"


def ros_tf(result: CalibrationResult, options: ExportOptions) -> str:
    """geometry_msgs/TransformStamped in YAML, and the command that publishes it."""
    x, y, z = _numbers(result.T_camera_lidar.translation())
    qx, qy, qz, qw = _numbers(quaternion_xyzw(result.T_camera_lidar.rotation()))
    parent, child = options.camera_frame, options.lidar_frame
    return f"""{_comment(result, parent, child)}# ros2 run tf2_ros static_transform_publisher \
--x {x} --y {y} --z {z} --qx {qx} --qy {qy} --qz {qz} --qw {qw} \
--frame-id {parent} --child-frame-id {child}
header:
  frame_id: {parent}
child_frame_id: {child}
transform:
  translation: {{x: {x}, y: {y}, z: {z}}}
  rotation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}
"""


def urdf(result: CalibrationResult, options: ExportOptions) -> str:
    """A fixed joint; rpy about the fixed axes x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    parent, child = options.camera_frame, options.lidar_frame
    xyz = " ".join(_numbers(result.T_camera_lidar.translation()))
    rpy = " ".join(_numbers(fixed_axis_rpy(result.T_camera_lidar.rotation())))
    comment = "\n".join("  " + line.removeprefix("# ") for line in _comment_lines(result, parent, child))
    return f"""<?xml version="1.0"?>
<!--
{comment}
-->
<robot name="lidar_camera">
  <link name="{parent}"/>
  <link name="{child}"/>
  <joint name="{parent.replace("/", "_")}_to_{child.replace("/", "_")}" type="fixed">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
  </joint>
</robot>
"""


def kalibr(result: CalibrationResult, options: ExportOptions) -> str:
    """Kalibr's camchain with the LiDAR in the IMU's place; t_imu = t_cam + timeshift_cam_imu."""
    camera = result.camera
    rows = "\n".join(
        f"  - [{', '.join(_numbers(row))}]" for row in np.asarray(result.T_camera_lidar.matrix())
    )
    intrinsics = ", ".join(_numbers([camera.fx, camera.fy, camera.cx, camera.cy]))
    return f"""{_comment(result, options.camera_frame, options.lidar_frame)}\
# The LiDAR stands in the IMU's place: T_cam_imu = T_camera_lidar,
# t_imu = t_cam + timeshift_cam_imu with t_imu = t_lidar: timeshift_cam_imu = +time_offset_s.
# The images are rectified: no distortion.
cam0:
  camera_model: pinhole
  intrinsics: [{intrinsics}]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [{camera.width}, {camera.height}]
  rostopic: /{result.camera_name}
  T_cam_imu:
{rows}
  timeshift_cam_imu: {_number(result.time_offset_s)}
"""


def autoware(result: CalibrationResult, options: ExportOptions) -> str:
    """Autoware's sensor_kit_calibration.yaml, with the LiDAR as origin of the sensor kit.

    Autoware places the camera *link* (x forward); its optical frame follows from it.
    """
    lTlink = result.T_camera_lidar.inverse() * LINK_FROM_OPTICAL.inverse()
    x, y, z = _numbers(lTlink.translation())
    roll, pitch, yaw = _numbers(fixed_axis_rpy(lTlink.rotation()))
    kit = "sensor_kit_base_link"
    notes = f"""# Below: the camera link (x forward, y left, z up) in the frame {options.lidar_frame},
# at which {kit} is placed; where your LiDAR has another pose in the kit, put that pose in front.
# roll, pitch, yaw about the fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
"""
    return f"""{_comment(result, options.camera_frame, options.lidar_frame)}{notes}\
{kit}:
  {options.lidar_frame}:
    x: 0.0
    y: 0.0
    z: 0.0
    roll: 0.0
    pitch: 0.0
    yaw: 0.0
  camera0/camera_link:
    x: {x}
    y: {y}
    z: {z}
    roll: {roll}
    pitch: {pitch}
    yaw: {yaw}
"""


def opencv(result: CalibrationResult, options: ExportOptions) -> str:
    """OpenCV FileStorage (YAML): rvec, tvec as projectPoints takes them for points of the LiDAR."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for line in _comment_lines(result, options.camera_frame, options.lidar_frame):
        storage.writeComment(line.removeprefix("# "))
    T = result.T_camera_lidar
    storage.write("image_width", result.camera.width)
    storage.write("image_height", result.camera.height)
    storage.write("camera_matrix", result.camera.matrix)
    storage.write("distortion_coefficients", np.zeros((1, 5)))
    storage.write("rvec", np.asarray(gtsam.Rot3.Logmap(T.rotation())).reshape(3, 1))
    storage.write("tvec", np.asarray(T.translation()).reshape(3, 1))
    storage.write("T_camera_lidar", np.ascontiguousarray(T.matrix()))
    storage.write("time_offset_s", result.time_offset_s)
    storage.write("covariance", np.ascontiguousarray(result.covariance))
    return str(storage.releaseAndGetString())


def gtsam_marginal(result: CalibrationResult, options: ExportOptions) -> str:
    """The marginal on (E, D) as JSON; see :mod:`sst_graph.export.marginal`."""
    return marginal_of_result(result).to_json()


FORMATS: dict[str, Callable[[CalibrationResult, ExportOptions], str]] = {
    "kitti": kitti,
    "ros-tf": ros_tf,
    "urdf": urdf,
    "kalibr": kalibr,
    "autoware": autoware,
    "opencv": opencv,
    "gtsam": gtsam_marginal,
}
"""Names of the formats."""


def quaternion_xyzw(rotation: gtsam.Rot3) -> FloatArray:
    """(4,) unit quaternion x y z w with w >= 0."""
    q: Any = rotation.toQuaternion()
    xyzw = np.array([q.x(), q.y(), q.z(), q.w()])
    return xyzw if xyzw[3] >= 0.0 else -xyzw


def fixed_axis_rpy(rotation: gtsam.Rot3) -> FloatArray:
    """(3,) roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll), exact at a pitch of 90 deg too.

    A LiDAR (x forward) in an optical frame (z forward) stands at just that pitch; roll is therefore
    taken from what is left of R when yaw is undone.
    """
    R = np.asarray(rotation.matrix())
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def _comment_lines(result: CalibrationResult, parent: str, child: str) -> list[str]:
    """What every file says of itself; no line holds two hyphens in a row (XML)."""
    sigmas = result.sigmas()
    rx, ry, rz = sigmas.rotation_deg
    x, y, z = sigmas.translation_cm
    lines = [
        "# LiDAR-camera calibration by sst-graph",
        f"# parent {parent} (camera, optical: x right, y down, z forward), child {child} (LiDAR):",
        "# p_camera = T_camera_lidar * p_lidar, the pose of the LiDAR in the camera",
        "# time offset: t_lidar = t_camera_stamp + time_offset_s, "
        f"time_offset_s = {_number(result.time_offset_s)}",
        f"# one sigma, about and along the LiDAR's axes: rotation {rx:.3g} {ry:.3g} {rz:.3g} deg, "
        f"translation {x:.3g} {y:.3g} {z:.3g} cm, offset {sigmas.time_offset_ms:.3g} ms",
    ]
    if result.status != "ok":
        lines.append(f"# STATUS {result.status}: these numbers are not to be trusted")
    own = [f"{drive.drive.replace('-', '_')} {drive.time_offset_s:+.6f} s" for drive in result.drive_offsets]
    return [*lines, f"# offsets by drive: {', '.join(own)}"] if own else lines


def _comment(result: CalibrationResult, parent: str, child: str) -> str:
    return "\n".join(_comment_lines(result, parent, child)) + "\n"


def _number(value: float) -> str:
    """Shortest text that reads back as the same number; with a point, or YAML 1.1 takes 1e-05 for text."""
    mantissa, e, exponent = repr(float(value) + 0.0).partition("e")
    return (mantissa if "." in mantissa else mantissa + ".0") + e + exponent


def _numbers(values: object) -> list[str]:
    return [_number(value) for value in np.asarray(values, dtype=np.float64).reshape(-1)]


def _row(matrix: FloatArray) -> str:
    return " ".join(_numbers(matrix))
