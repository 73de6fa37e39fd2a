"""From what a method found to a result: status, reasons, versions; the same for every method."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.config import CalibrationConfig
from sst_graph.config import to_dict
from sst_graph.covariance.observability import (
    MOTION,
    SILHOUETTES,
    Advice,
    ObservabilityConfig,
    involves_offset,
    open_directions,
)
from sst_graph.drive.preparation import Drive
from sst_graph.drive.stamp_intervals import jumps_of
from sst_graph.odometry.sweep import SWEEP_KEY
from sst_graph.result import CalibrationResult, DriveOffset, FrameId, Status, WeakDirection

FloatArray = NDArray[np.float64]

PACKAGES = ("sst-graph", "gtsam", "numpy", "scipy", "small_gicp")


@dataclass(frozen=True)
class Guess:
    """What is known at first: an extrinsic, or None, and a time offset [s]."""

    cTl: gtsam.Pose3 | None
    offset_s: float = 0.0


@dataclass(frozen=True)
class DriveKnowledge:
    """How well the extrinsic and the time offset of one drive are known.

    Attributes:
        drive: its name.
        covariance: (7, 7) of the extrinsic and the drive's own offset.
        by_static: (7, 7) the same by static objects alone.
    """

    drive: str
    covariance: FloatArray
    by_static: FloatArray


@dataclass(frozen=True)
class Answer:
    """What a method found.

    Attributes:
        cTl, offset_s: the estimate.
        covariance: (7, 7), see :class:`~sst_graph.result.CalibrationResult`.
        frames: that took part.
        doubts: why the estimate may be wrong altogether; any makes the status ``not_converged``.
        remarks: what else was missing, for the reader.
        by_static: (7, 7) covariance by static objects alone, and the motion where it is always heard.
        drive_offsets: an offset for each drive, where one each was asked for.
        by_drive: how well each of them is known.
        diagnostics: JSON-able numbers about the run.
    """

    cTl: gtsam.Pose3
    offset_s: float
    covariance: FloatArray
    frames: tuple[FrameId, ...]
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    by_static: FloatArray | None = None
    drive_offsets: tuple[DriveOffset, ...] = ()
    by_drive: tuple[DriveKnowledge, ...] = ()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)


def result_of(
    answer: Answer, drives: Sequence[Drive], guess: Guess, config: CalibrationConfig
) -> CalibrationResult:
    """The result: unobservable where the covariance says so, not_converged where there are doubts."""
    advice = MOTION if config.method == "motion" else SILHOUETTES
    weak = _weak_directions(answer, config.observability, advice)
    doubts = (*answer.doubts, *(_jumps(drives) if config.check_stamps else ()))
    status: Status = "not_converged" if doubts else "unobservable" if weak else "ok"
    sentences = (f"{direction.sentence}: {direction.advice}" for direction in weak)
    return CalibrationResult(
        T_camera_lidar=answer.cTl,
        time_offset_s=answer.offset_s,
        covariance=answer.covariance,
        status=status,
        camera=drives[0].camera,
        reasons=(*doubts, *answer.remarks, *sentences),
        weak_directions=weak,
        frames_used=answer.frames,
        drive_offsets=answer.drive_offsets,
        method=config.method,
        config=to_dict(config),
        initial=guess.cTl,
        initial_offset_s=guess.offset_s,
        diagnostics={**answer.diagnostics, **sweeps_of(drives)},
        versions=_versions(),
    )


def _weak_directions(
    answer: Answer, limits: ObservabilityConfig, advice: Advice
) -> tuple[WeakDirection, ...]:
    """What is not known; where drives have an offset each, of each drive's, named by the drive."""
    if not answer.by_drive:
        return open_directions(answer.covariance, answer.by_static, answer.cTl, limits, advice)
    found: list[WeakDirection] = []
    for number, known in enumerate(answer.by_drive):
        for weak in open_directions(known.covariance, known.by_static, answer.cTl, limits, advice):
            if involves_offset(weak):
                found.append(replace(weak, sentence=f"drive {known.drive!r}: {weak.sentence}"))
            elif number == 0:  # of the extrinsic alone, which all drives share
                found.append(weak)
    return tuple(sorted(found, key=lambda weak: -weak.sigma))


def sweeps_of(drives: Sequence[Drive]) -> dict[str, Any]:
    """What was decided of the sweeps, by name of the drive, as an entry of the diagnostics."""
    found = {drive.name: drive.sweep.to_dict() for drive in drives if drive.sweep is not None}
    return {SWEEP_KEY: found} if found else {}


def _jumps(drives: Sequence[Drive]) -> list[str]:
    """Where the clocks of drives have jumped, so that no one time offset holds."""
    found = []
    for drive in drives:
        for jump in jumps_of(drive.image_stamps_ns, drive.scan_stamps_ns):
            image, scan = jump.place
            frame = drive.images[image].index if jump.sensor == "image" else drive.scans[scan].index
            found.append(
                f"{drive.name}: {jump.sentence} at frame {frame}: "
                "calibrate the frames before it and those from it on apart"
            )
    return found


def no_answer(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, reason: str
) -> CalibrationResult:
    """What is known when no estimate could be made: the guess, with sigmas that say so."""
    sigmas = np.array([1.0] * 3 + [2.0] * 3 + [1.0])
    return CalibrationResult(
        T_camera_lidar=guess.cTl or gtsam.Pose3(),
        time_offset_s=guess.offset_s,
        covariance=np.diag(sigmas**2),
        status="unobservable",
        camera=drives[0].camera,
        reasons=(reason,),
        method=config.method,
        config=to_dict(config),
        initial=guess.cTl,
        initial_offset_s=guess.offset_s,
        versions=_versions(),
    )


def _versions() -> dict[str, str]:
    """Of what took part; OpenCV's by the module, for four distributions bring it."""
    return {**{name: _version(name) for name in PACKAGES}, "opencv": str(cv2.__version__)}


def _version(name: str) -> str:
    """A distribution's version; a package that was put on the path by hand has none."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
