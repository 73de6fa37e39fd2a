"""The tracker as it runs: its estimate, its status and the matches of each frame."""

from __future__ import annotations

from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.tracker.tracker import Tracker
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.types import Frame
from sst_graph.viewer.frame_view import FrameViews
from sst_graph.viewer.recording import Recording


class TrackerView:
    """Logs what a tracker does with each frame; the tracker is not changed by it."""

    def __init__(self, tracker: Tracker, recording: Recording) -> None:
        self._tracker, self._recording = tracker, recording
        # A matcher of its own, for the tracker's keeps the state of its latest frames.
        self._matcher = WindowMatcher(tracker.inputs.window, tracker.setup.config.estimating)
        self._views = FrameViews(self._matcher)

    def add(self, frame: Frame) -> TrackUpdate:
        """Add a frame to the tracker, and log it; the tracker's update."""
        tracker = self._tracker
        before = tracker.inputs.window.place
        update = tracker.add(frame)
        self._matcher.graph = tracker.matcher.graph
        for view in self._views.taken(frame, before, tracker.estimate.point):
            self._recording.frame(view)
        self._recording.update(update)
        return update

    def finish(self, last: TrackUpdate) -> None:
        """Log what waits, and the last estimate."""
        for view in self._views.rest(self._tracker.estimate.point):
            self._recording.frame(view)
        self._recording.update(last)
