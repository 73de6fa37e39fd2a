"""The tracker's first estimate."""
