"""Estimators: calibration of whole drives."""

from sst_graph.estimators.batch import calibrate, calibrate_prepared
from sst_graph.estimators.config import CalibrationConfig

__all__ = ["CalibrationConfig", "calibrate", "calibrate_prepared"]
