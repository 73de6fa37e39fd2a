"""Objects through the scans of a drive: tracks, whether they stay, and their velocity."""
