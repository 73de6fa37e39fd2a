"""Frames without labels in the tracker: LiDAR edges against gradients of the pictures."""
