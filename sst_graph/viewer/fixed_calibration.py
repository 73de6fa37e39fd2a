"""Views of a drive under a calibration that stays as it is."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import gtsam

from sst_graph.batch import CalibrationConfig
from sst_graph.errors import one_line
from sst_graph.factors.camera import PinholeCamera
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.spread_work import NUMERICAL_ERRORS
from sst_graph.tracker.tracker import Tracker
from sst_graph.types import Frame, SemanticClass
from sst_graph.viewer.frame_view import FrameView, FrameViews

_LOG = logging.getLogger(__name__)

_WINDOW = 8
"""Scans that are kept: a scan is shown a few after it came at the latest."""


def views_under(
    frames: Iterable[Frame],
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    classes: tuple[SemanticClass, ...],
) -> Iterator[FrameView]:
    """Views of frames in the order of their stamps; what cannot be used is passed over with a warning.

    Args:
        classes: whose boundary points are matched.
    """
    calibration = CalibrationConfig(classes=classes)
    config = TrackerConfig(calibration=calibration, window=_WINDOW, start_scans=1)
    # Its inputs and its matcher; nothing is estimated.
    tracker = Tracker(camera, config, cTl, time_offset_s)
    views, point = FrameViews(tracker.matcher), tracker.estimate.point
    for frame in frames:
        before = tracker.inputs.window.place
        try:
            _take(tracker, frame)
        except NUMERICAL_ERRORS as error:
            _LOG.warning("frame %d is not shown: %s", frame.index, one_line(error))
        yield from views.taken(frame, before, point)
    yield from views.rest(point)


def _take(tracker: Tracker, frame: Frame) -> None:
    """Take the frame's image and scan into the window."""
    inputs = tracker.inputs
    if frame.image is not None:
        image, clock_step_ns = inputs.check_image(frame.image, tracker.estimate.point.time_offset_s)
        inputs.add_image(image, clock_step_ns, tracker.estimate)
    if frame.scan is not None:
        scan, clock_step_ns = inputs.check_scan(frame.scan)
        inputs.add_scan(scan, clock_step_ns, tracker.estimate)
