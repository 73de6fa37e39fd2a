"""Motion of each sensor by itself: LiDAR odometry, visual odometry, standing frames."""
