"""How far a result can be trusted, in numbers for people: sigmas, correlations, weak directions, frames.

Pure functions of a :class:`~sst_graph.result.CalibrationResult`; nothing is measured again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_graph.covariance.observability import MOTION, SILHOUETTES, ObservabilityConfig, weak_directions
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import described, is_whole
from sst_graph.files.strict_json import json_able
from sst_graph.fit import EDGES_QUALITY, FitQuality
from sst_graph.inspect.changed import change_of
from sst_graph.inspect.frame_information import KEY, FrameInformation, frames_of
from sst_graph.inspect.gained import Gained, gained_of
from sst_graph.inspect.misfit import DEPTHS_M, misfit_at
from sst_graph.inspect.planning import Plan, limits_of, plan_recording
from sst_graph.inspect.verdict import fit_line, verdict
from sst_graph.result import CalibrationResult, Sigmas, WeakDirection
from sst_graph.types import ByValue, FloatArray

NAMES = ("rotation x", "rotation y", "rotation z", "x", "y", "z", "time offset")
UNITS = ("deg", "deg", "deg", "cm", "cm", "cm", "ms")
HUMAN: FloatArray = np.array([180.0 / np.pi] * 3 + [100.0] * 3 + [1000.0])
"""(7,) from SI to :data:`UNITS`."""

STRONG = 0.6
"""Least correlation that is put into words: above it, knowing one unknown takes a fifth or more off the
other's sigma."""

REDUNDANT_SHARE = 0.01
"""A frame is redundant if no sigma grows by more than this share without it."""

MOST_NEXT_FRAMES = 1_000_000
"""Most frames that the predictions may add."""


@dataclass(frozen=True)
class Correlation:
    """Two correlated unknowns; numbers of the covariance's order.

    Attributes:
        first, second: the two.
        value: correlation, -1 to 1.
        slope: change of the second for a change of the first [SI].
        first_alone, second_alone: sigma of each if the other were known [SI].
    """

    first: int
    second: int
    value: float
    slope: float
    first_alone: float
    second_alone: float


@dataclass(frozen=True)
class PixelSigma:
    """Error in the image, one sigma, everything at rest.

    Attributes:
        range_m: depth of the point [m].
        across_px, down_px: straight ahead, by the calibration alone, along the image's x and y [px].
        corner_px: at the worst place of the image, the lens counted [px].
        lens_counts: whether the lens makes the last one clearly larger than the calibration alone does.
    """

    range_m: float
    across_px: float
    down_px: float
    corner_px: float
    lens_counts: bool


@dataclass(frozen=True, eq=False)
class Inspection(ByValue):
    """The uncertainty of a result, analysed.

    Attributes:
        result: the result.
        lidar: sigmas about and along the LiDAR's axes.
        camera: the same about and along the camera's axes (x right, y down, z forward).
        pixels: error in the image.
        correlation: (7, 7).
        strong: the strongest correlations, strongest first.
        weakest: the direction known worst, measured in the limits, also where it is within them.
        frames: information of each frame; empty where the result has none.
        redundant: positions in ``frames`` of those without which, one at a time, no sigma grows by more than
            ``redundant_share``.
        redundant_share: as a fraction of the sigma.
        plan: what to record next, or None without ``frames``.
        gained: other information by frame in the result, or None.
    """

    result: CalibrationResult
    lidar: Sigmas
    camera: Sigmas
    pixels: tuple[PixelSigma, ...]
    correlation: FloatArray
    strong: tuple[Correlation, ...]
    weakest: WeakDirection
    frames: tuple[FrameInformation, ...]
    redundant: tuple[int, ...]
    redundant_share: float
    plan: Plan | None
    gained: Gained | None


def inspect_result(result: CalibrationResult, next_frames: int = 10) -> Inspection:
    """Analyse the uncertainty of a result.

    Args:
        next_frames: frames that the predictions add.

    Raises:
        ConfigError: less than one frame, or more than :data:`MOST_NEXT_FRAMES`.
        DataError: no result, or one whose information by frame is malformed.
    """
    if not isinstance(result, CalibrationResult):
        raise DataError("result", f"a {type(result).__name__}", "a CalibrationResult (read_result)")
    if not (is_whole(next_frames) and 1 <= next_frames <= MOST_NEXT_FRAMES):
        expected = f"at least 1 and at most {MOST_NEXT_FRAMES}"
        raise ConfigError(f"next_frames: found {described(next_frames)}, expected {expected}")
    frames = frames_of(result)
    limits = limits_of(result)
    return Inspection(
        result,
        result.sigmas(),
        camera_sigmas(result),
        tuple(pixel_sigma(result, range_m) for range_m in DEPTHS_M),
        correlation_matrix(result.covariance),
        strong_correlations(result.covariance, STRONG),
        weakest_direction(result, limits),
        frames,
        redundant_frames(frames, REDUNDANT_SHARE),
        REDUNDANT_SHARE,
        _plan(result, frames, next_frames),
        gained_of(result),
    )


def _plan(result: CalibrationResult, frames: tuple[FrameInformation, ...], next_frames: int) -> Plan | None:
    """What to record next; None without information by frame, and of an estimate that is not to be trusted.

    Raises:
        DataError: that information is none that a calibration can have.
    """
    if not frames or result.status == "not_converged":
        return None
    try:
        with np.errstate(all="ignore"):
            return plan_recording(result, frames, next_frames)
    except np.linalg.LinAlgError as error:
        place = f"diagnostics.{KEY}"
        raise DataError(place, f"numbers that predict nothing ({error})", "information by frame") from error


def correlation_matrix(covariance: FloatArray) -> FloatArray:
    """(n, n) correlations; an unknown without variance is correlated with nothing."""
    sigmas = np.sqrt(np.diag(covariance))
    scale = np.where(sigmas > 0.0, sigmas, 1.0)
    correlation = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)


def strong_correlations(covariance: FloatArray, least: float) -> tuple[Correlation, ...]:
    """Pairs of unknowns whose correlation is ``least`` or more, either sign, strongest first."""
    sigmas, values = np.sqrt(np.diag(covariance)), correlation_matrix(covariance)
    found = []
    for i, j in zip(*np.triu_indices(len(sigmas), 1), strict=True):
        value = float(values[i, j])
        if abs(value) < least:
            continue
        rest = float(np.sqrt(max(0.0, 1.0 - value**2)))
        slope = value * float(sigmas[j] / sigmas[i])
        found.append(
            Correlation(int(i), int(j), value, slope, rest * float(sigmas[i]), rest * float(sigmas[j]))
        )
    return tuple(sorted(found, key=lambda pair: -abs(pair.value)))


def camera_covariance(result: CalibrationResult) -> FloatArray:
    """(7, 7) covariance with rotation and translation about and along the camera's axes."""
    R = result.T_camera_lidar.rotation().matrix()
    turn = np.eye(7)
    turn[:3, :3] = turn[3:6, 3:6] = R
    return np.asarray(turn @ result.covariance @ turn.T)


def camera_sigmas(result: CalibrationResult) -> Sigmas:
    """Standard deviations about and along the camera's axes, in degrees, centimetres and milliseconds."""
    rx, ry, rz, x, y, z, offset = (HUMAN * np.sqrt(np.diag(camera_covariance(result)))).tolist()
    return Sigmas((rx, ry, rz), (x, y, z), offset)


def pixel_sigma(result: CalibrationResult, range_m: float) -> PixelSigma:
    """How far a point may be drawn from where the picture shows it, straight ahead and in the corners."""
    one = misfit_at(result, range_m)
    return PixelSigma(range_m, one.across_px, one.down_px, one.corner_px, one.lens_counts)


def weakest_direction(result: CalibrationResult, limits: ObservabilityConfig) -> WeakDirection:
    """The direction known worst, each unknown measured in its limit; also where it is within the limits."""
    least = {
        name: max(1e-9 * getattr(limits, name), 1e-30)
        for name in ("rotation_deg", "translation_m", "time_offset_s")
    }
    tiny = dataclasses.replace(limits, **least)
    advice = MOTION if result.method == "motion" else SILHOUETTES
    return weak_directions(result.covariance, result.T_camera_lidar, tiny, advice)[0]


def redundant_frames(frames: Sequence[FrameInformation], share: float) -> tuple[int, ...]:
    """Positions of the frames without which, one at a time, no sigma grows by more than ``share``."""
    return tuple(k for k, frame in enumerate(frames) if frame.without.max() <= 1.0 + share)


def telling_frames(frames: Sequence[FrameInformation], unknown: int) -> list[int]:
    """Positions of the three frames that matter most for one unknown, the most important first."""
    order = np.argsort([-frame.without[unknown] for frame in frames], kind="stable")
    return [int(k) for k in order[:3] if frames[int(k)].without[unknown] > 1.0]


def sigma_ellipse(covariance: FloatArray, count: int) -> FloatArray:
    """(2, count) closed line of one sigma around the origin, of a covariance (2, 2)."""
    circle = np.stack([np.cos(t := np.linspace(0.0, 2.0 * np.pi, count)), np.sin(t)])
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle))


def to_dict(inspection: Inspection) -> dict[str, Any]:
    """The inspection as a JSON-able dictionary; units in the names, SI but for sigmas in ``sigmas``."""
    result = inspection.result
    document: dict[str, Any] = json_able(
        {
            "verdict": verdict(result),
            "status": result.status,
            "reasons": result.reasons,
            "method": result.method,
            "T_camera_lidar": result.T_camera_lidar,
            "time_offset_s": result.time_offset_s,
            "drive_offsets": result.drive_offsets,
            "fit": _fit(result),
            "sigmas": {"lidar_axes": inspection.lidar, "camera_axes": inspection.camera},
            "pixels": inspection.pixels,
            "order": NAMES,
            "correlation": inspection.correlation,
            "strong_correlations": inspection.strong,
            "weak_directions": result.weak_directions,
            "weakest_direction": inspection.weakest,
            "frames": [_frame(frame, k in inspection.redundant) for k, frame in enumerate(inspection.frames)],
            "plan": inspection.plan,
            "gained": None if inspection.gained is None else _gained(inspection.gained),
        }
    )
    return document


def _fit(result: CalibrationResult) -> dict[str, Any] | None:
    """What the result holds of its fit to its data; None of one that holds nothing."""
    stored = FitQuality.from_diagnostics(result.diagnostics)
    beside = FitQuality.from_diagnostics(result.diagnostics, EDGES_QUALITY)
    sentence, change = fit_line(result), change_of(result)
    if not sentence:
        return None
    by_edges = stored is not None and stored.by_chance is not None
    labels, edges = (None, stored) if by_edges else (stored, beside)
    return {
        "sentence": sentence,
        "labels": None if labels is None else labels.to_dict(),
        "edges": None if edges is None else edges.to_dict(),
        "changed_since": None if change is None else dataclasses.asdict(change),
    }


def _gained(gained: Gained) -> dict[str, Any]:
    name = "sigma_after" if gained.kind == "as they came" else "sigma_ratio_without"
    return {
        "kind": gained.kind,
        "frames": [
            {"drive": g.frame.drive, "frame": g.frame.frame, "bits": g.bits, name: g.values.tolist()}
            for g in gained.gains
        ],
    }


def _frame(frame: FrameInformation, redundant: bool) -> Mapping[str, Any]:
    return {
        "drive": frame.frame.drive,
        "frame": frame.frame.frame,
        "bits": frame.bits,
        "sigma_ratio_without": frame.without.tolist(),
        "sigma_ratio_so_far": frame.so_far.tolist(),
        "speed_mps": frame.speed,
        "turn_rate_radps": frame.turn_rate,
        "matches": frame.matches,
        "objects": frame.objects,
        "nearest_m": frame.nearest_m,
        "left": frame.left,
        "redundant": redundant,
    }
