"""A calibration as text for other programs; each says which way its transform goes and the offset's sign."""

from __future__ import annotations

from collections.abc import Callable

from sst_graph.errors import ConfigError
from sst_graph.export import chains, records, robots
from sst_graph.export.frames import Rig, rig_of
from sst_graph.export.options import ExportOptions
from sst_graph.factors.arguments import checked_type, described
from sst_graph.result import CalibrationResult
from sst_graph.rig import RigResult

FORMATS: dict[str, Callable[[Rig], str]] = {
    "kitti": records.kitti,
    "ros-tf": robots.ros_tf,
    "ros1-launch": robots.ros1_launch,
    "ros2-launch": robots.ros2_launch,
    "ros2-launch-xml": robots.ros2_launch_xml,
    "urdf": robots.urdf,
    "xacro": robots.xacro,
    "autoware": robots.autoware,
    "kalibr": chains.kalibr,
    "openvins": chains.openvins,
    "mins": chains.mins,
    "opencv": records.opencv,
    "nuscenes": records.nuscenes,
    "gtsam": records.gtsam_marginal,
}
"""Writers by the name of the format."""

_EITHER_WAY = ("ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro")
_WITH_LINKS = (*_EITHER_WAY, "autoware")
_CHAINS = ("kalibr", "openvins", "mins")
_IN_A_VEHICLE = (*_WITH_LINKS, *_CHAINS, "nuscenes")
_WITH_OPTICAL_FRAMES = (*_WITH_LINKS, *_CHAINS, "opencv")


def export_text(
    result: CalibrationResult | RigResult, target: str, options: ExportOptions | None = None
) -> str:
    """The calibration of a camera, or of each camera of a rig, in a format of :data:`FORMATS`.

    Raises:
        ConfigError: an unknown format, or options that do not fit it or the result.
        EstimationError: a result whose covariance has no inverse (gtsam only).
        FactorError: no result, or no options.
    """
    expected = "a CalibrationResult or a RigResult"
    checked_type("result", result, (CalibrationResult, RigResult), expected)
    if not (isinstance(target, str) and target in FORMATS):
        raise ConfigError(f"export format: found {described(target)}, expected one of {', '.join(FORMATS)}")
    options = ExportOptions() if options is None else options
    checked_type("options", options, ExportOptions, "an ExportOptions, or None")
    lidar_frame = None if options.lidar_frame == ExportOptions().lidar_frame else options.lidar_frame
    for name, value, formats in (
        ("--camera-frame", options.camera_frame, _WITH_OPTICAL_FRAMES),
        ("--camera-link", options.camera_link, _WITH_LINKS),
        ("--lidar-frame", lidar_frame, (*_WITH_OPTICAL_FRAMES, "nuscenes")),
        ("--calib", options.kitti, ("kitti",)),
        ("--child", options.child, _EITHER_WAY),
        ("--parent", options.parent, _IN_A_VEHICLE),
        ("--tree", options.tree, _IN_A_VEHICLE),
    ):
        if value is not None and target not in formats:
            raise ConfigError(f"{name} goes with --to {', '.join(formats)}, found --to {target}")
    return FORMATS[target](_rig(result, options))


def replaced_joints(
    result: CalibrationResult | RigResult, target: str, options: ExportOptions | None = None
) -> list[str]:
    """Joints of the vehicle's tree, but for those of the cameras, that the exported text replaces.

    Args:
        result, target, options: as of :func:`export_text`, which takes them.

    Returns:
        A sentence for each, with what it cuts off.
    """
    options = ExportOptions() if options is None else options
    return _rig(result, options).replacements() if target in _EITHER_WAY else []


def _rig(result: CalibrationResult | RigResult, options: ExportOptions) -> Rig:
    if isinstance(result, RigResult):
        return rig_of(result.cameras, options, several=True)
    return rig_of({result.camera_name: result}, options, several=False)
