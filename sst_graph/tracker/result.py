"""The tracker's last estimate as a calibration result."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sst_graph.batch.assumption_tests import assumption_report
from sst_graph.batch.method_estimate import package_versions
from sst_graph.config import to_dict
from sst_graph.covariance.observability import reasons_of
from sst_graph.factors.arguments import checked_type
from sst_graph.fit import EDGE_BIAS, MASK_BIAS, bias_entry
from sst_graph.inspect.gained import KEY, to_document
from sst_graph.result import CalibrationResult, FrameId, Status
from sst_graph.tracker.track_update import TrackUpdate, current_update

if TYPE_CHECKING:
    from sst_graph.tracker.tracker import Tracker

_NO_ESTIMATE = {
    "starting": "there is no estimate yet: record more frames with objects in view",
    "alarm": "the calibration has changed, and there is no estimate of the new one yet: record more frames",
}
"""By the status: why the result is but the guess."""


def tracker_result(tracker: Tracker, drive: str, camera_name: str) -> CalibrationResult:
    """The present estimate as a result; frames used are those of the window.

    Raises:
        FactorError: a name that is no text.
    """
    checked_type("drive", drive, str, "a text")
    last, estimate, window = current_update(tracker), tracker.estimate, tracker.inputs.window
    status: Status = "ok" if last.status == "ok" else "not_converged"
    reasons = reasons_of(last.weak_directions)
    if last.status == "unobservable":
        status = "unobservable"
    elif last.status == "contradicted":
        reasons = (*last.contradictions, *reasons)
    elif last.status == "unconfirmed":
        reasons = tuple(filter(None, (last.unconfirmed_reason, window.lacking_labels())))
        status = "not_converged" if reasons else "unobservable"  # for an undecided sweep alone
    elif last.status != "ok":
        reasons = tuple(filter(None, (_NO_ESTIMATE[last.status], tracker.initializer.why)))
    if last.status != "ok":
        reasons = (*reasons, *_refused(tracker.last_update))
    if last.undecided_sweep:
        reasons = (*reasons, last.undecided_sweep)
    shifts = estimate.uncertainty.shifts
    if last.covariance is not None:
        reasons = (*reasons, *shifts.sentences(last.covariance))
    entries = {} if estimate.smoother is None else estimate.smoother.entries
    used = [FrameId(drive, scan.index) for number, scan in window.scans if number in entries]
    model = None if estimate.smoother is None else estimate.smoother.model
    guess, config = tracker.initializer.guess, tracker.setup.config.estimating
    biases_px = estimate.point.state(config.calibration.classes).biases_px
    return CalibrationResult(
        T_camera_lidar=last.T_camera_lidar,
        time_offset_s=last.time_offset_s,
        covariance=np.diag(last.sigmas**2) if last.covariance is None else last.covariance,
        status=status,
        camera=tracker.setup.camera,
        camera_name=camera_name,
        reasons=reasons,
        weak_directions=last.weak_directions,
        frames_used=tuple(used),
        method="track",
        config=to_dict(tracker.setup.config),
        initial=guess.cTl,
        initial_time_offset_s=guess.time_offset_s,
        diagnostics={
            "scans": window.next_scan,
            "matches": last.matches,
            MASK_BIAS if estimate.edges is None else EDGE_BIAS: bias_entry([drive], biases_px),
            "assumptions": assumption_report(estimate.considered(), estimate.findings),
            "estimated": last.to_dict()["estimated"],
            "error_model": None
            if model is None
            else {"side": model.side, "side_frame": model.side_frame, "match": model.match},
            **shifts.diagnostics,
            **({} if config.drift.enabled else {KEY: to_document(estimate.information_log.gained(drive))}),
        },
        versions=package_versions(),
    )


def _refused(last: TrackUpdate | None) -> tuple[str, ...]:
    """Why data of the last frame were not used."""
    return (last.reason,) if last is not None and last.refused else ()
