"""Whether the calibration has changed, and which one to use."""
