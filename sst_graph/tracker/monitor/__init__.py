"""Change detection, confirmation, and adoption of the calibration."""
