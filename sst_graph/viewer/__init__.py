"""Drives, results and the tracker in the viewer rerun (the extra ``rerun``): docs/how-to/viewer.md."""

from sst_graph.viewer.frame_view import FrameView, FrameViews, MatchView
from sst_graph.viewer.recording import Recording, rerun
from sst_graph.viewer.tracker_view import TrackerView

__all__ = ["FrameView", "FrameViews", "MatchView", "Recording", "TrackerView", "rerun"]
