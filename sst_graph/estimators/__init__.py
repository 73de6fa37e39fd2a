"""Estimators: calibration of whole drives, and frame by frame."""

from sst_graph.estimators.batch import calibrate, calibrate_prepared, prepare_drives
from sst_graph.estimators.config import CalibrationConfig
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.track_update import TrackUpdate
from sst_graph.estimators.tracker_config import TrackerConfig

__all__ = [
    "CalibrationConfig",
    "TrackUpdate",
    "Tracker",
    "TrackerConfig",
    "calibrate",
    "calibrate_prepared",
    "prepare_drives",
]
