"""Objects through the scans of a drive: tracks, which ones are dynamic, and their velocity."""
