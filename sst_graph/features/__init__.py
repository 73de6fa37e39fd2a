"""What is measured in one scan or one image: LiDAR edges, scan lines, mask contours, image edges."""
