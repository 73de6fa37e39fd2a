"""What is kept of a drive: features, motion, and what its raw frames show."""
