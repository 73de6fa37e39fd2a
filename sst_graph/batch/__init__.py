"""Calibration of whole drives."""

from sst_graph.batch.calibrate import calibrate, calibrate_prepared, prepare_drives
from sst_graph.batch.config import CalibrationConfig

__all__ = ["CalibrationConfig", "calibrate", "calibrate_prepared", "prepare_drives"]
