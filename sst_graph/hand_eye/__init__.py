"""Calibration from motion alone: LiDAR odometry against visual odometry."""
