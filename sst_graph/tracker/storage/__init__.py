"""A tracker on disk and back."""
