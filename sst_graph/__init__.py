"""Target-less LiDAR-camera calibration, in space and time, as a GTSAM factor graph."""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # as typing has it, whose import takes milliseconds of every command's start
if TYPE_CHECKING:
    from typing import Any

    from sst_graph.batch import CalibrationConfig, calibrate
    from sst_graph.data import open_source
    from sst_graph.export import CalibrationMarginal
    from sst_graph.factors import PinholeCamera
    from sst_graph.inspect.inspection import inspect_result
    from sst_graph.result import CalibrationResult, read_result
    from sst_graph.rig import KnownPose, KnownRig, RigResult, calibrate_rig, read_rig
    from sst_graph.slam.align import CameraCalibration, FrameMatching, ScanMotion, align_frame
    from sst_graph.slam.alignment_keys import AlignmentKeys, Trajectory
    from sst_graph.slam.alignment_term import AlignmentTerm, TermConfig
    from sst_graph.slam.config import RematchConfig
    from sst_graph.slam.covariance import calibration_covariance
    from sst_graph.slam.incremental_terms import IncrementalTerms
    from sst_graph.slam.moving_objects import follow_objects
    from sst_graph.slam.solving import solve_with_terms
    from sst_graph.slam.term_warnings import WarningKind
    from sst_graph.tracker import Tracker, TrackerConfig, TrackUpdate
    from sst_graph.types import Calibration, CameraImage, Frame, Scan, SemanticClass, Source

__all__ = [
    "AlignmentKeys",
    "AlignmentTerm",
    "Calibration",
    "CalibrationConfig",
    "CalibrationMarginal",
    "CalibrationResult",
    "CameraCalibration",
    "CameraImage",
    "Frame",
    "FrameMatching",
    "IncrementalTerms",
    "KnownPose",
    "KnownRig",
    "PinholeCamera",
    "RematchConfig",
    "RigResult",
    "Scan",
    "ScanMotion",
    "SemanticClass",
    "Source",
    "TermConfig",
    "TrackUpdate",
    "Tracker",
    "TrackerConfig",
    "Trajectory",
    "WarningKind",
    "align_frame",
    "calibrate",
    "calibrate_rig",
    "calibration_covariance",
    "follow_objects",
    "inspect_result",
    "open_source",
    "read_result",
    "read_rig",
    "solve_with_terms",
]

_HOMES = {
    "AlignmentKeys": "sst_graph.slam.alignment_keys",
    "AlignmentTerm": "sst_graph.slam.alignment_term",
    "Calibration": "sst_graph.types",
    "CalibrationConfig": "sst_graph.batch",
    "CalibrationMarginal": "sst_graph.export",
    "CalibrationResult": "sst_graph.result",
    "CameraCalibration": "sst_graph.slam.align",
    "CameraImage": "sst_graph.types",
    "Frame": "sst_graph.types",
    "FrameMatching": "sst_graph.slam.align",
    "IncrementalTerms": "sst_graph.slam.incremental_terms",
    "KnownPose": "sst_graph.rig",
    "KnownRig": "sst_graph.rig",
    "PinholeCamera": "sst_graph.factors",
    "RematchConfig": "sst_graph.slam.config",
    "RigResult": "sst_graph.rig",
    "Scan": "sst_graph.types",
    "ScanMotion": "sst_graph.slam.align",
    "SemanticClass": "sst_graph.types",
    "Source": "sst_graph.types",
    "TermConfig": "sst_graph.slam.alignment_term",
    "TrackUpdate": "sst_graph.tracker",
    "Tracker": "sst_graph.tracker",
    "TrackerConfig": "sst_graph.tracker",
    "Trajectory": "sst_graph.slam.alignment_keys",
    "WarningKind": "sst_graph.slam.term_warnings",
    "align_frame": "sst_graph.slam.align",
    "calibrate": "sst_graph.batch",
    "calibrate_rig": "sst_graph.rig",
    "calibration_covariance": "sst_graph.slam.covariance",
    "follow_objects": "sst_graph.slam.moving_objects",
    "inspect_result": "sst_graph.inspect.inspection",
    "open_source": "sst_graph.data",
    "read_result": "sst_graph.result",
    "read_rig": "sst_graph.rig",
    "solve_with_terms": "sst_graph.slam.solving",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: the command's ``--help`` must not wait for OpenCV."""
    if name == "__version__":
        return _version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def _version() -> str:
    """Version of the installed distribution; a checkout on the path has none."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sst-graph")
    except PackageNotFoundError:
        return "(not installed)"


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
