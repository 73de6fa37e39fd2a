"""Calibration frame by frame."""

from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.tracker.tracker import Tracker

__all__ = ["TrackUpdate", "Tracker", "TrackerConfig"]
