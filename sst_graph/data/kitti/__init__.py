"""Readers of KITTI: the odometry layout and the raw drives."""
