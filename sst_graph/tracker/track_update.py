"""What the tracker returns for each frame: its present state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import gtsam
import numpy as np

from sst_graph.batch.method_estimate import UNKNOWN_SIGMAS
from sst_graph.covariance.observability import open_directions
from sst_graph.result import WeakDirection
from sst_graph.types import ByValue, Calibration, FloatArray

if TYPE_CHECKING:
    from sst_graph.tracker.monitor.monitor import Monitor
    from sst_graph.tracker.tracker import Tracker

Sensor = Literal["image", "scan"]
TrackStatus = Literal["starting", "ok", "unobservable", "unconfirmed", "contradicted", "alarm"]


@dataclass(frozen=True, eq=False)
class TrackUpdate(ByValue):
    """The estimate after a frame. Signs and order: :mod:`factors`.

    Attributes:
        stamp_ns: of the scan or image that was added.
        T_camera_lidar: p_camera = T_camera_lidar . p_lidar.
        time_offset_s: t_lidar = t_camera_stamp + time_offset_s [s].
        covariance: (7, 7) cluster-robust; None while there is no estimate, and ``covariance_reason`` says so.
        status: ``starting`` until a first estimate exists; ``alarm`` from an alarm until there is an estimate
            again; ``contradicted`` where the data contradict what is assumed; ``unconfirmed`` where no frames
            have lately confirmed it, the latest contradict it, or ``undecided_sweep`` says why; else whether
            the limits of observability are met.
        accepted: all of the frame was used; else ``reason`` says why not.
        reason: why the frame was not accepted; empty where it was.
        refused: the sensors of it whose data were not used: they have changed nothing.
        matches: silhouette matches in the window.
        chi2: statistic of the change test, over its usual size; None where there are too few frames.
        suspected_change: why the statistic, past its threshold for some frames, raises no alarm; else empty.
        alarm: this frame raised the alarm: the calibration has changed.
        unconfirmed_s: time, up to this stamp, since frames last agreed with the estimate that would have
            shown a turn of the camera; above 1 s the status is ``unconfirmed`` [s].
        time_offset_unconfirmed_s: time at more than 3 m/s since frames last agreed with it that would have
            shown a jump of the clock; above 3 s the status is ``unconfirmed`` [s].
        adopted: the estimate is the calibration in use from now on.
        weak_directions: what is known worse than the limits.
        covariance_reason: why there is no covariance; empty where there is.
        converged: whether the solution of the whole window after this frame did (:meth:`Tracker.optimize`);
            None where it was not solved.
        contradictions: what the data contradict of what is assumed, with estimate, deviation and remedy.
        frame: index of the frame; None where a scan or an image was added alone.
        estimated: value and standard deviation of each parameter that is estimated beside the calibration, by
            its assumption's name, in its unit; empty while there is no estimate.
        unconfirmed_reason: why no frames confirm the estimate, under whatever status; empty where they do.
        undecided_sweep: that the scans do not show whether they are compensated for the sweep, where it
            matters; else empty.
    """

    stamp_ns: int
    T_camera_lidar: gtsam.Pose3
    time_offset_s: float
    covariance: FloatArray | None
    status: TrackStatus
    accepted: bool
    reason: str = ""
    refused: tuple[Sensor, ...] = ()
    matches: int = 0
    chi2: float | None = None
    suspected_change: str = ""
    alarm: bool = False
    unconfirmed_s: float = 0.0
    time_offset_unconfirmed_s: float = 0.0
    adopted: bool = False
    weak_directions: tuple[WeakDirection, ...] = ()
    covariance_reason: str = ""
    converged: bool | None = None
    contradictions: tuple[str, ...] = ()
    frame: int | None = None
    estimated: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    undecided_sweep: str = ""
    unconfirmed_reason: str = ""

    @property
    def calibration(self) -> Calibration:
        """``T_camera_lidar`` and ``time_offset_s`` as one."""
        return Calibration(self.T_camera_lidar, self.time_offset_s)

    @property
    def sigmas(self) -> FloatArray:
        """(7,) standard deviations [rad, m, s]; wide ones while there is no estimate."""
        if self.covariance is None:
            return UNKNOWN_SIGMAS.copy()
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_dict(self) -> dict[str, Any]:
        """As one line of strict JSON; degrees nowhere, units in the names."""
        sigmas = self.sigmas.tolist()
        line = {} if self.frame is None else {"frame": self.frame}
        return line | {
            "stamp_ns": self.stamp_ns,
            "T_camera_lidar": self.T_camera_lidar.matrix().tolist(),
            "time_offset_s": self.time_offset_s,
            "sigma_rotation_rad": sigmas[:3],
            "sigma_translation_m": sigmas[3:6],
            "sigma_time_offset_s": sigmas[6],
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "covariance_reason": self.covariance_reason,
            "status": self.status,
            "accepted": self.accepted,
            "reason": self.reason,
            "refused": list(self.refused),
            "matches": self.matches,
            "chi2": self.chi2,
            "suspected_change": self.suspected_change,
            "alarm": self.alarm,
            "unconfirmed_s": self.unconfirmed_s,
            "time_offset_unconfirmed_s": self.time_offset_unconfirmed_s,
            "unconfirmed_reason": self.unconfirmed_reason,
            "adopted": self.adopted,
            "converged": self.converged,
            "contradictions": list(self.contradictions),
            "estimated": {
                name: {"value": value, "sigma": sigma} for name, (value, sigma) in self.estimated.items()
            },
            "undecided_sweep": self.undecided_sweep,
            "weak": [weak.sentence for weak in self.weak_directions],
        }


def unconfirmed_sentences(update: TrackUpdate) -> tuple[str, ...]:
    """Why no frames confirm the estimate, and a suspected change where that does not say it."""
    why, change = update.unconfirmed_reason, update.suspected_change
    return tuple(filter(None, (why, "" if change in why else change)))


def make_update(
    tracker: Tracker,
    stamp_ns: int,
    reason: str = "",
    *,
    sensor: Sensor = "scan",
    chi2: float | None = None,
    alarm: bool = False,
) -> TrackUpdate:
    """The present estimate, its covariance and status, as an update.

    Args:
        stamp_ns: of the scan or image that was added.
        reason: why it was not accepted; empty where it was.
        sensor: whose clock the stamp is of.
        chi2: statistic of the change test.
        alarm: it raised the alarm.
    """
    estimate, changes = tracker.estimate, tracker.monitor.changes
    point, covariance = estimate.point, estimate.reported_covariance()
    confirmation, contradictions = changes.confirmation, estimate.contradictions
    # Where no scan can be used, nothing confirms the estimate either.
    offset_ns = round(1e9 * point.time_offset_s) if sensor == "image" else 0
    since_scan_s = tracker.inputs.window.seconds_since_scan(stamp_ns + offset_ns) if estimate.exists else 0.0
    status: TrackStatus = "alarm" if tracker.initializer.alarmed else "starting"
    weak: tuple[WeakDirection, ...] = ()
    sweep = why = ""
    if estimate.exists:
        limits = tracker.setup.config.calibration.observability
        weak = open_directions(covariance, estimate.uncertainty.by_static_objects, point.cTl, limits)
        sweep = estimate.by_sweep().sentence
        why = _unconfirmed(tracker.monitor, since_scan_s)
        status = "unobservable" if weak else "unconfirmed" if why or sweep else "ok"
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
        unconfirmed_s=confirmation.turn_s + since_scan_s,
        time_offset_unconfirmed_s=confirmation.time_offset_s,
        weak_directions=weak,
        contradictions=contradictions,
        estimated=estimate.parameters,
        undecided_sweep=sweep,
        unconfirmed_reason=why,
    )


def _unconfirmed(monitor: Monitor, since_scan_s: float) -> str:
    """Why no frames confirm the estimate; empty where they do.

    Args:
        since_scan_s: time since the last scan that could be used.
    """
    changes, confirmation = monitor.changes, monitor.changes.confirmation
    if changes.start_unconfirmed:
        return "no frames that came after the start have been found to agree with those it was made of"
    if monitor.contradicted:
        why = changes.suspected_change or "a changed calibration, or wrong labels; further frames show which"
        return f"the latest frames contradict the estimate: {why}"
    if not confirmation.too_old_after(since_scan_s):
        return ""
    of_offset = (
        f", nor one of the time offset for {confirmation.time_offset_s:.1f} s of driving"
        if confirmation.time_offset_s > 0.0
        else ""
    )
    turn_s = confirmation.turn_s + since_scan_s
    return (
        f"no frame would have shown a change of where the camera looks for the last {turn_s:.1f} s{of_offset}"
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
    return replace(update, **{name: getattr(last, name) for name in of_frame})
