"""SST-Calib as printed, SemAlign, and the nearest-pixel matching they share."""
