"""The tracker's last estimate as a calibration result."""

from __future__ import annotations

import numpy as np

from sst_graph.batch.assumption_tests import assumption_report
from sst_graph.config import to_dict
from sst_graph.inspect.gained import KEY, to_document
from sst_graph.result import UNNAMED_CAMERA, CalibrationResult, FrameId, Status
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.tracker.tracker import Tracker


def tracker_result(
    tracker: Tracker, drive: str = "stream", camera_name: str = UNNAMED_CAMERA
) -> CalibrationResult:
    """The present estimate as :meth:`Tracker.current` answers it; frames used are those of the window."""
    last = tracker.current()
    status: Status = "ok" if last.status == "ok" else "not_converged"
    reasons = tuple(f"{weak.sentence}: {weak.advice}" for weak in last.weak_directions)
    if last.status == "unobservable":
        status = "unobservable"
    elif last.status == "contradicted":
        reasons = (*last.contradictions, *reasons)
    elif last.status == "unconfirmed":
        reasons = _unconfirmed(last, tracker.trial.on)
    elif last.status != "ok":
        reasons = (f"the tracker is {last.status}: no estimate of the calibration as it is now",)
    entries = {} if tracker.smoother is None else tracker.smoother.entries
    used = [FrameId(drive, scan.index) for number, scan in tracker.window.scans if number in entries]
    model = None if tracker.smoother is None else tracker.smoother.model
    return CalibrationResult(
        T_camera_lidar=last.T_camera_lidar,
        time_offset_s=last.time_offset_s,
        covariance=np.diag(last.sigmas**2) if last.covariance is None else last.covariance,
        status=status,
        camera=tracker.camera,
        camera_name=camera_name,
        reasons=reasons,
        weak_directions=last.weak_directions,
        frames_used=tuple(used),
        method="track",
        config=to_dict(tracker.config),
        initial=tracker.guess.cTl,
        initial_offset_s=tracker.guess.offset_s,
        diagnostics={
            "scans": tracker.window.next_scan,
            "matches": last.matches,
            "mask_bias_px": {
                c.name.lower(): bias
                for (_, c), bias in tracker.point.state(tracker.classes).biases_px.items()
            },
            "assumptions": assumption_report(tracker.considered(), tracker.tests.findings),
            "estimated": last.to_dict()["estimated"],
            "error_model": None
            if model is None
            else {"side": model.side, "side_frame": model.side_frame, "match": model.match},
            **(
                {}
                if tracker.config.drift.enabled
                else {KEY: to_document(tracker.information_log.gained(drive))}
            ),
        },
    )


def _unconfirmed(last: TrackUpdate, new: bool) -> tuple[str, ...]:
    if new:
        return ("no frames that came after the start have been found to agree with those it was made of",)
    return (
        "no frame would have shown a change: of where the camera looks for the last "
        f"{last.unconfirmed_s:.1f} s, of the time offset for {last.offset_unconfirmed_s:.1f} s of driving"
        + (f"; {last.doubt}" if last.doubt else ""),
    )
