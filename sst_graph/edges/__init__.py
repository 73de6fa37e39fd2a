"""Calibration without labels: where LiDAR edges and gradients of the picture agree best."""
