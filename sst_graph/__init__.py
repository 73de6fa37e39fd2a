"""Target-less LiDAR-camera calibration, in space and time, as a GTSAM factor graph."""
