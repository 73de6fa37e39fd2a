"""Prepared drives: features, motion, and statistics of the raw frames."""
