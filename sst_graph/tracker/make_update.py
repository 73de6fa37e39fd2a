"""The tracker's present state as a TrackUpdate."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from sst_graph.batch.assumption_tests import contradiction_sentence
from sst_graph.covariance.observability import open_directions
from sst_graph.result import WeakDirection
from sst_graph.tracker.track_update import TrackStatus, TrackUpdate

if TYPE_CHECKING:
    from sst_graph.tracker.tracker import Tracker


def make_update(
    tracker: Tracker, stamp_ns: int, reason: str = "", *, chi2: float | None = None, alarm: bool = False
) -> TrackUpdate:
    """The present estimate, its covariance and status, as an update.

    Args:
        stamp_ns: of the scan or image that was added.
        reason: why it was not accepted; empty where it was.
        chi2: statistic of the change test.
        alarm: it raised the alarm.
    """
    estimate, changes = tracker.estimate, tracker.monitor.changes
    point, covariance = estimate.point, estimate.reported_covariance()
    confirmation, contradictions = changes.confirmation, contradiction_sentence(estimate.findings)
    status: TrackStatus = "alarm" if tracker.initializer.alarmed else "starting"
    weak: tuple[WeakDirection, ...] = ()
    sweep = ""
    if estimate.exists:
        limits = tracker.setup.config.calibration.observability
        weak = open_directions(covariance, estimate.uncertainty.by_static_objects, point.cTl, limits)
        sweep = estimate.by_sweep().sentence
        unconfirmed = changes.start_unconfirmed or confirmation.too_old or sweep
        status = "unobservable" if weak else "unconfirmed" if unconfirmed else "ok"
        contradictions = (*contradictions, *estimate.reasons)
        status = "contradicted" if contradictions else status
    return TrackUpdate(
        stamp_ns=stamp_ns,
        T_camera_lidar=point.cTl,
        time_offset_s=point.time_offset_s,
        covariance=covariance if estimate.exists else None,
        covariance_reason="" if estimate.exists else "no estimate yet: this is the guess",
        status=status,
        accepted=not reason,
        reason=reason,
        matches=0 if estimate.smoother is None else estimate.smoother.matches,
        chi2=chi2,
        suspected_change=changes.suspected_change,
        alarm=alarm,
        unconfirmed_s=confirmation.turn_s,
        time_offset_unconfirmed_s=confirmation.time_offset_s,
        weak_directions=weak,
        contradictions=contradictions,
        estimated=estimate.parameters,
        undecided_sweep=sweep,
    )


def current_update(tracker: Tracker, last: TrackUpdate | None = None) -> TrackUpdate:
    """The present estimate, without a frame.

    Args:
        last: update of the last frame; its fields about that frame are kept.
    """
    update = make_update(tracker, tracker.inputs.window.last_stamp_ns or 0)
    if last is None:
        return update
    of_frame = ["frame", "stamp_ns", "refused", "chi2", "alarm", "adopted"]
    if last.covariance is not None or update.covariance is None or last.refused:
        of_frame += ["accepted", "reason"]
    return dataclasses.replace(update, **{name: getattr(last, name) for name in of_frame})
