"""Calibration of whole drives: ``calibrate`` runs a method and says how far to trust its answer."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import time
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import to_dict
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.estimators.config import CalibrationConfig
from sst_graph.estimators.frames import as_sources
from sst_graph.estimators.joint import JointSolution, solve_joint
from sst_graph.estimators.start import find_start, rivals
from sst_graph.problem.drive import Drive, Progress, prepare_drive
from sst_graph.problem.graph import Tracks
from sst_graph.problem.objects import object_tracks
from sst_graph.problem.state import State
from sst_graph.result import CalibrationResult, DriveOffset, FrameId, Status
from sst_graph.types import Source
from sst_graph.uncertainty.covariance import robust_covariance
from sst_graph.uncertainty.observability import weak_directions

FloatArray = NDArray[np.float64]

PACKAGES = ("sst-graph", "gtsam", "numpy", "opencv-python-headless", "scipy", "small_gicp")


def calibrate(
    frames: Source | Sequence[Source],
    initial: gtsam.Pose3 | None = None,
    config: CalibrationConfig | None = None,
    *,
    initial_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Extrinsic, time offset and covariance from one drive or several.

    Args:
        frames: a source (:func:`sst_graph.open_source`), a slice of one, or several sources, which then
            share one extrinsic.
        initial: rough guess of cTl, or None when nothing is known.
        config: settings; the defaults fit driving data.
        initial_offset_s: rough guess of the time offset [s].
        progress: called with (stage, steps done, steps in all).

    Returns:
        The estimate; its ``status`` says whether it may be trusted.

    Raises:
        DataError: the frames cannot be used.
        ConfigError: the settings contradict each other or the data.
    """
    config = config or CalibrationConfig()
    sources = as_sources(frames)
    _check(sources, config)
    began = time.perf_counter()
    drives = [prepare_drive(source, config.classes, config.prepare, progress) for source in sources]
    prepared = time.perf_counter()
    try:
        result = _joint(drives, initial, initial_offset_s, config, progress)
    except EstimationError as error:
        result = _unanswered(drives, initial, initial_offset_s, config, str(error))
    timing = {"prepare": prepared - began, "estimate": time.perf_counter() - prepared}
    return _with_diagnostics(result, {"seconds": timing})


def _check(sources: Sequence[Source], config: CalibrationConfig) -> None:
    if not config.classes:
        raise ConfigError("classes: found none, expected one or more")
    names = [source.name for source in sources]
    if len(set(names)) < len(names) and config.delay_per_drive:
        raise ConfigError(f"delay_per_drive needs drives of different names, found {names}")


def _joint(
    drives: Sequence[Drive],
    initial: gtsam.Pose3 | None,
    initial_offset_s: float,
    config: CalibrationConfig,
    progress: Progress | None,
) -> CalibrationResult:
    # 1. A start that needs no luck.
    tracks = Tracks(drives)
    candidates = find_start(drives, tracks, config.classes, initial, initial_offset_s, config.start)
    # 2. Silhouettes over all frames, outer and inner loop.
    clocks = len(drives) if config.delay_per_drive else 1
    start = State(candidates[0].cTl, (candidates[0].offset_s,) * clocks)
    solution = solve_joint(drives, start, config.joint, progress)
    # 3. How sure, and in which directions not at all.
    covariance, model, _ = robust_covariance(
        solution.graph, solution.values, solution.pairs, solution.state, [object_tracks(d) for d in drives]
    )
    covariance7 = covariance[:7, :7]
    weak = weak_directions(covariance7, solution.state.cTl, config.observability)
    reasons = [f"{w.sentence}: {w.advice}" for w in weak]
    status: Status = "unobservable" if weak else "ok"
    if not solution.converged:
        status = "not_converged"
        reasons.insert(0, f"the outer loop still moved after {solution.outer_iterations} iterations")
    for rival in rivals(candidates, config.start):
        status = "not_converged"
        reasons.append(
            f"another pose explains the labels almost as well (score {rival.score:.3f} against "
            f"{candidates[0].score:.3f}): record more varied scenes or give a closer guess"
        )
    return CalibrationResult(
        T_camera_lidar=solution.state.cTl,
        time_offset_s=solution.state.offsets_s[0],
        covariance=covariance7,
        status=status,
        camera=drives[0].camera,
        reasons=tuple(reasons),
        weak_directions=weak,
        frames_used=_frames_used(drives, solution),
        drive_offsets=_drive_offsets(drives, solution, covariance),
        method="joint",
        config=to_dict(config),
        initial=initial,
        initial_offset_s=initial_offset_s,
        diagnostics={
            "outer_iterations": solution.outer_iterations,
            "matches": sum(len(pair) for pair in solution.pairs),
            "pairs": len(solution.pairs),
            "start_score": candidates[0].score,
            "mask_bias_px": {
                f"{drives[d].name}:{c.name.lower()}": bias
                for (d, c), bias in solution.state.biases_px.items()
            },
            "error_model": {"side": model.side, "side_frame": model.side_frame, "match": model.match},
        },
        versions=_versions(),
    )


def _frames_used(drives: Sequence[Drive], solution: JointSolution) -> tuple[FrameId, ...]:
    return tuple(
        FrameId(drives[pair.drive].name, drives[pair.drive].scans[pair.pair.scan].index)
        for pair in solution.pairs
    )


def _drive_offsets(
    drives: Sequence[Drive], solution: JointSolution, covariance: FloatArray
) -> tuple[DriveOffset, ...]:
    if len(solution.state.offsets_s) == 1:
        return ()
    sigmas = np.sqrt(np.diag(covariance))
    return tuple(
        DriveOffset(drive.name, solution.state.offset_s(i), float(sigmas[6 + i]))
        for i, drive in enumerate(drives)
    )


def _unanswered(
    drives: Sequence[Drive],
    initial: gtsam.Pose3 | None,
    initial_offset_s: float,
    config: CalibrationConfig,
    reason: str,
) -> CalibrationResult:
    """What is known when no estimate could be made: the guess, with sigmas that say so."""
    sigmas = np.array([1.0] * 3 + [2.0] * 3 + [1.0])
    return CalibrationResult(
        T_camera_lidar=initial or gtsam.Pose3(),
        time_offset_s=initial_offset_s,
        covariance=np.diag(sigmas**2),
        status="unobservable",
        camera=drives[0].camera,
        reasons=(reason,),
        method=config.method,
        config=to_dict(config),
        initial=initial,
        initial_offset_s=initial_offset_s,
        versions=_versions(),
    )


def _with_diagnostics(result: CalibrationResult, more: dict[str, Any]) -> CalibrationResult:
    return dataclasses.replace(result, diagnostics={**result.diagnostics, **more})


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in PACKAGES}
