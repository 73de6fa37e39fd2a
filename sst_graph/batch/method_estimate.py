"""From the estimate of any method to a calibration result: status, reasons, versions."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import cv2
import gtsam
import numpy as np

from sst_graph.batch.config import CalibrationConfig
from sst_graph.config import to_dict
from sst_graph.covariance.contradiction import Difference, PartEstimate
from sst_graph.covariance.observability import (
    MOTION,
    SILHOUETTES,
    Advice,
    ObservabilityConfig,
    involves_offset,
    open_directions,
    reasons_of,
)
from sst_graph.covariance.shared_errors import SharedErrors
from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.drive.stamp_intervals import Jump, jumps_of
from sst_graph.fit import EDGES_QUALITY, QUALITY, Fit
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.graph.state import State
from sst_graph.odometry.sweep import SWEEP_KEY
from sst_graph.result import CalibrationResult, DriveOffset, FrameId, Status, WeakDirection
from sst_graph.types import Calibration, FloatArray, Guess

if TYPE_CHECKING:
    from sst_graph.batch.problem import JointOutcome, MatchedDrives

_AGREES, _CONTRADICTS = 3.0, 4.0
"""After a jump the stamps are right where the time offset has changed by fewer sigmas than the first, and
differs from the jump by more than the second."""
UNKNOWN_SIGMAS = np.array([1.0] * 3 + [2.0] * 3 + [1.0])
"""(7,) deviations of what is not known at all [rad, m, s]."""
PACKAGES = ("sst-graph", "gtsam", "numpy", "scipy", "small_gicp")
"""Distributions whose versions a result names."""


@dataclass(frozen=True)
class DriveCovariance:
    """How well the extrinsic and the time offset of one drive are known.

    Attributes:
        drive: its name.
        covariance: (7, 7) of the extrinsic and the drive's own offset.
        by_static_objects: (7, 7) the same by static objects alone.
    """

    drive: str
    covariance: FloatArray
    by_static_objects: FloatArray


_CALIBRATE_APART = (
    "calibrate the frames before and from there apart, or use --set check_stamps=false if the sensor has no "
    "steady rate"
)
"""Advice for a jump of the stamps."""


def jumps_in(drive: Drive) -> list[Jump]:
    """Jumps of a drive's stamps that change its time offset where a clock was set."""
    return jumps_of(drive.image_stamps_ns, drive.scan_stamps_ns)


def first_after(drive: Drive, jump: Jump) -> ImageFeatures | ScanFeatures:
    """The first image, or scan, whose stamp has jumped."""
    image, scan = jump.place
    return drive.images[image] if jump.sensor == "image" else drive.scans[scan]


def jump_sentence(drive: Drive, jump: Jump) -> str:
    """Where a jump is, and how large."""
    return f"{drive.name}: at frame {first_after(drive, jump).index} {jump.sentence}"


def held_offsets(
    drives: Sequence[Drive],
    config: CalibrationConfig,
    estimates: Callable[[int, Sequence[Jump]], Sequence[PartEstimate | None]],
    source: str,
) -> dict[str, str]:
    """Jumps of the stamps, by :func:`jump_sentence`, before and after which the time offset is the same, and
    a remark about each.

    One odd interval is a clock that was set, or a camera that paused for part of its period, or a frame that
    was picked from a faster camera one later: then the stamps are right.

    Args:
        estimates: of a drive's number and its jumps: the estimates of the frames before, between and behind
            these by themselves, None where there is none; they have one extrinsic.
        source: of these estimates.
    """
    held = {}
    for number, drive in enumerate(drives):
        jumps = jumps_in(drive) if config.check_stamps else []
        parts = estimates(number, jumps) if jumps else []
        for jump, before, after in zip(jumps, parts[:-1], parts[1:], strict=True):
            if before is None or after is None:
                continue
            found = Difference.of(before, after)
            weights = np.linalg.inv(found.covariance)[6]
            step_s, sigma_s = float(weights @ found.step / weights[6]), float(1.0 / np.sqrt(weights[6]))
            jumped = abs(step_s - jump.time_offset_s) < _CONTRADICTS * sigma_s
            if not jumped and abs(step_s) < _AGREES * sigma_s:
                sentence = jump_sentence(drive, jump)
                held[sentence] = (
                    f"{sentence}, but by {source} the time offset is the same before and after it (they "
                    f"differ by {1e3 * step_s:+.1f} +- {1e3 * sigma_s:.1f} ms): the stamps are right, and "
                    "the sensor has paused, or frames were picked from a faster one"
                )
    return held


@dataclass(frozen=True)
class MethodEstimate:
    """The estimate of a method, and what it reports.

    Attributes:
        cTl, time_offset_s: the estimate.
        covariance: (7, 7), see :class:`~sst_graph.result.CalibrationResult`.
        frames: that took part.
        reasons: why the estimate may be wrong altogether; any makes the status ``not_converged``.
        remarks: notes for the reader that do not change the status.
        assumed: what was assumed where the data are silent: said before the directions that it leaves open.
        by_static_objects: (7, 7) covariance by static objects alone, and by motion where used.
        drive_offsets: an offset for each drive, with ``time_offset_per_drive``.
        by_drive: how well each of them is known.
        diagnostics: JSON-able numbers about the run.
        solved: the problem of the joint graph with its matches; None of methods without such a graph.
        fit: how the estimate fits its data, of methods that measure it.
        edges_fit: the same of edges in other frames, where ``fit`` is of labels.
        matched: what it was matched with, of methods that match.
        by_sweeps: (7, 7) part of the covariance by sweeps that the scans leave undecided.
        open_sweeps: that such sweeps matter, which makes the status ``unobservable``.
        shared: errors that other cameras on the LiDAR have, too, of methods without ``solved``.
        held_offsets: as of :func:`held_offsets`, by methods that compare the frames before and after jumps.
        assumption_steps: (7,) step of the estimate by one deviation of each assumption that is considered in
            the covariance, by name.
    """

    cTl: gtsam.Pose3
    time_offset_s: float
    covariance: FloatArray
    frames: tuple[FrameId, ...]
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    by_static_objects: FloatArray | None = None
    drive_offsets: tuple[DriveOffset, ...] = ()
    by_drive: tuple[DriveCovariance, ...] = ()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    solved: JointOutcome | None = None
    fit: Fit | None = None
    edges_fit: Fit | None = None
    matched: MatchedDrives | None = None
    by_sweeps: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))
    open_sweeps: tuple[str, ...] = ()
    shared: SharedErrors | None = None
    held_offsets: Mapping[str, str] = field(default_factory=dict)
    assumption_steps: Mapping[str, FloatArray] = field(default_factory=dict)


def result_of(
    estimate: MethodEstimate, drives: Sequence[Drive], guess: Guess, config: CalibrationConfig
) -> CalibrationResult:
    """The result: not_converged where there is a reason, unobservable where a direction exceeds the limits
    or nothing decides a sweep that matters."""
    advice = MOTION if config.method == "motion" else SILHOUETTES
    weak = _weak_directions(estimate, config.observability, advice)
    held = estimate.held_offsets
    wrong, remarks = [*estimate.reasons], [*estimate.remarks]
    if config.check_stamps:
        jumps = [jump_sentence(drive, jump) for drive in drives for jump in jumps_in(drive)]
        wrong += [f"{jump}: {_CALIBRATE_APART}" for jump in jumps if jump not in held]
        remarks += [held[jump] for jump in jumps if jump in held]
    status: Status = "not_converged" if wrong else "unobservable" if estimate.open_sweeps or weak else "ok"
    at = Calibration(estimate.cTl, estimate.time_offset_s)
    qualities = quality_of(estimate.fit, at) | quality_of(estimate.edges_fit, at, EDGES_QUALITY)
    return CalibrationResult(
        T_camera_lidar=estimate.cTl,
        time_offset_s=estimate.time_offset_s,
        covariance=estimate.covariance,
        status=status,
        camera=drives[0].camera,
        reasons=(*wrong, *estimate.open_sweeps, *estimate.assumed, *reasons_of(weak), *remarks),
        weak_directions=weak,
        frames_used=estimate.frames,
        drive_offsets=estimate.drive_offsets,
        method=config.method,
        config=to_dict(config),
        initial=guess.cTl,
        initial_time_offset_s=guess.time_offset_s,
        diagnostics={**estimate.diagnostics, **qualities, **sweeps_of(drives)},
        versions=package_versions(),
        fit=estimate.fit,
        edges_fit=estimate.edges_fit,
    )


def quality_of(fit: Fit | None, at: Calibration, name: str = QUALITY) -> dict[str, Any]:
    """The shares of a fit, and the calibration that they are of, as an entry of the diagnostics."""
    if fit is None:
        return {}
    place = {"T_camera_lidar": at.cTl.matrix().tolist(), "time_offset_s": at.time_offset_s}
    return {name: {**fit.quality.to_dict(), "at": place}}


def _weak_directions(
    estimate: MethodEstimate, limits: ObservabilityConfig, advice: Advice
) -> tuple[WeakDirection, ...]:
    """Directions beyond the limits; where drives have an offset each, those of each drive, named by the
    drive."""
    if not estimate.by_drive:
        return open_directions(estimate.covariance, estimate.by_static_objects, estimate.cTl, limits, advice)
    found: list[WeakDirection] = []
    for number, known in enumerate(estimate.by_drive):
        for weak in open_directions(known.covariance, known.by_static_objects, estimate.cTl, limits, advice):
            if involves_offset(weak):
                found.append(replace(weak, sentence=f"drive {known.drive!r}: {weak.sentence}"))
            elif number == 0:  # of the extrinsic alone, which all drives share
                found.append(weak)
    return tuple(sorted(found, key=lambda weak: -weak.sigma))


def sweeps_of(drives: Sequence[Drive]) -> dict[str, Any]:
    """Decisions about the sweeps by name of the drive, as an entry of the diagnostics."""
    found = {drive.name: drive.sweep.to_dict() for drive in drives if drive.sweep is not None}
    return {SWEEP_KEY: found} if found else {}


def frames_used(drives: Sequence[Drive], solution: JointSolution) -> tuple[FrameId, ...]:
    """The scans of a joint solution's pairs."""
    scans = dict.fromkeys((pair.drive, pair.pair.scan) for pair in solution.pairs)
    return tuple(FrameId(drives[drive].name, drives[drive].scans[scan].index) for drive, scan in scans)


def drive_offsets(drives: Sequence[Drive], state: State, covariance: FloatArray) -> tuple[DriveOffset, ...]:
    """Each drive's time offset, where they have one each; covariance: (n, n) of extrinsic and offsets."""
    if len(state.time_offsets_s) == 1:
        return ()
    sigmas = np.sqrt(np.diag(covariance))
    return tuple(
        DriveOffset(drive.name, state.time_offset_s(i), float(sigmas[6 + i]))
        for i, drive in enumerate(drives)
    )


def guess_as_result(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, reason: str
) -> CalibrationResult:
    """The result where no estimate could be made: the guess, with large sigmas."""
    return CalibrationResult(
        T_camera_lidar=guess.cTl or gtsam.Pose3(),
        time_offset_s=guess.time_offset_s,
        covariance=np.diag(UNKNOWN_SIGMAS**2),
        status="unobservable",
        camera=drives[0].camera,
        reasons=(reason,),
        method=config.method,
        config=to_dict(config),
        initial=guess.cTl,
        initial_time_offset_s=guess.time_offset_s,
        versions=package_versions(),
    )


def package_versions() -> dict[str, str]:
    """Versions of what took part; OpenCV's by the module, for four distributions bring it."""
    return {**{name: _version(name) for name in PACKAGES}, "opencv": str(cv2.__version__)}


def _version(name: str) -> str:
    """A distribution's version; a package that was put on the path by hand has none."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
