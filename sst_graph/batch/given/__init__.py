"""A calibration that is given, and a drive that it is to fit."""
