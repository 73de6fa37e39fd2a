"""How good a result is, in one sentence: what a person who uses it needs to know."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.errors import count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.fit import CLOSE_PX, EDGES_QUALITY, FitQuality
from sst_graph.inspect.pixels import cP_H_cTl, pixel_covariance
from sst_graph.inspect.reasons import as_sentence, short_reasons
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

REACHES_M = (10.0, 30.0, 60.0)
"""Depths for which the error in the picture is given [m]."""
_PLACES = 3
"""Places across and down the picture, its borders among them, at which the error is evaluated."""
DRIVING_MPS = 10.0
"""Speed, straight ahead, for which the error is given besides that at rest [m/s]."""

CHECK_BY_EDGES = "a check by edges of the pictures, which the estimate has not used"


@dataclass(frozen=True)
class Misfit:
    """How far the cloud may sit from the picture: one standard deviation, worst direction, worst place in the
    picture.

    Attributes:
        depth_m: depth of the point [m].
        pixels: in the picture (:func:`~sst_graph.inspect.pixels.pixel_covariance`) [px].
        cm: across the line of sight [cm].
        driving_pixels: in the picture at :data:`DRIVING_MPS`, where the time offset counts too [px].
    """

    depth_m: float
    pixels: float
    cm: float
    driving_pixels: float


def misfits(result: CalibrationResult) -> tuple[Misfit, ...]:
    """At each of :data:`REACHES_M`, by the result's covariance."""
    return tuple(_misfit(result, depth_m) for depth_m in REACHES_M)


def largest_sigmas(result: CalibrationResult) -> tuple[float, float, float]:
    """Rotation [deg], translation [cm] and time offset [ms]: one sigma of the worst axis of each."""
    covariance = result.covariance
    rotation, translation = (float(np.linalg.eigvalsh(covariance[a : a + 3, a : a + 3])[-1]) for a in (0, 3))
    return float(np.degrees(np.sqrt(rotation))), 100.0 * np.sqrt(translation), 1e3 * covariance[6, 6] ** 0.5


def is_start(result: CalibrationResult) -> bool:
    """Whether no estimate could be made: what stands in the result is the start."""
    start = gtsam.Pose3() if result.initial is None else result.initial
    return not result.frames_used and bool(result.T_camera_lidar.equals(start, 1e-12))


def verdict(result: CalibrationResult) -> str:
    """The result in one or two sentences, without terms of the trade.

    Standard deviations of the worst axis; a result that is not ok begins with what is wrong.
    """
    if result.status == "not_converged":
        first = next(iter(short_reasons(result)), "the estimate contradicts the data")
        return f"Do not use this calibration: {as_sentence(first)}"
    if is_start(result):
        first = next(iter(short_reasons(result)), "no frame could be used")
        return f"No estimate: {as_sentence(first)} What stands in this result is the start."
    if result.status == "unobservable":
        first = next(iter(short_reasons(result)), "the data leave a direction open")
        return f"Not finished: {as_sentence(first)} As it is: {_known(result)}"
    return f"Good to {_known(result)}"


def quality_line(quality: FitQuality) -> str:
    """Shares of close points, as a line for a terminal."""
    by_labels = quality.by_chance is None
    others = {"at the start": quality.share_at_start, "at random rotations": quality.by_chance}
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in others.items() if share is not None)
    return (
        f"{100.0 * quality.share:.0f} % of {count_of(quality.points, 'boundary point')} within "
        f"{CLOSE_PX:g} px of the "
        f"{'contour' if by_labels else 'strongest edge nearby'}{f' ({shares})' if shares else ''}"
        # What edges allow falls with the calibration itself: it would not tell one that is wrong.
        + (f"; labels like these allow {100.0 * quality.attainable:.0f} %" if by_labels else "")
    )


def fit_line(result: CalibrationResult) -> str:
    """How well the result fits its data, as a line for a terminal: by labels, or by edges; else empty."""
    quality = FitQuality.from_diagnostics(result.diagnostics)
    if quality is None:
        return edges_line(result)
    of_edges = FitQuality.from_diagnostics(result.diagnostics, EDGES_QUALITY)
    if of_edges is not None:
        return f"labels: {quality_line(quality)}; edges in frames without labels: {quality_line(of_edges)}"
    if result.fit_is_check:
        return f"{CHECK_BY_EDGES}: {quality_line(quality)}"
    contrast = "" if quality.by_chance is None else edges_line(result)
    return "; ".join(line for line in (contrast, quality_line(quality)) if line)


def edges_line(result: CalibrationResult) -> str:
    """How far the score of the edges stands out; empty where it is not known."""
    stored = result.diagnostics.get("contrast")
    names = "sigmas", "least_sigmas", "score", "other", "least_over_other"
    found = [stored.get(name) for name in names] if isinstance(stored, dict) else []
    values = [float(x) for x in found if isinstance(x, int | float) and math.isfinite(x)]
    if len(values) < len(names):
        return ""
    sigmas, least_sigmas, score, other, least_over_other = values
    over_other = (
        f", {score / other:.2f} times that of the best other optimum ({least_over_other:g} or more expected)"
        if other > 0.0
        else ""
    )
    return (
        f"the score of the edges is {sigmas:.0f} standard deviations above those of random rotations "
        f"({least_sigmas:g} or more expected){over_other}"
    )


def _known(result: CalibrationResult) -> str:
    degrees, cm, ms = largest_sigmas(result)
    middle = misfits(result)[1]
    return (
        f"{figure(degrees)}° and {figure(cm)} cm: at {middle.depth_m:.0f} m the cloud sits within "
        f"{figure(middle.pixels)} pixels of the picture. The time offset is known to {figure(ms)} ms."
    )


def _misfit(result: CalibrationResult, depth_m: float) -> Misfit:
    forward = result.T_camera_lidar.rotation().unrotate(np.array([0.0, 0.0, DRIVING_MPS]))
    resting, driving = np.eye(6, 7), np.eye(6, 7)
    driving[3:, 6] = -forward
    found = []
    for cP in _places(result.camera, depth_m):
        sight = np.eye(3) - np.outer(cP, cP) / float(cP @ cP)
        across = sight @ cP_H_cTl(result.T_camera_lidar, cP)
        found.append(
            (
                _worst(pixel_covariance(result, cP, resting)),
                100.0 * _worst(across @ result.covariance[:6, :6] @ across.T),
                _worst(pixel_covariance(result, cP, driving)),
            )
        )
    pixels, cm, driving_pixels = np.max(found, axis=0).tolist()
    return Misfit(depth_m, pixels, cm, driving_pixels)


def _places(camera: PinholeCamera, depth_m: float) -> list[FloatArray]:
    """Points (3,) at a depth that are seen all over the picture [m]."""
    us, vs = (np.linspace(0.0, size - 1.0, _PLACES) for size in (camera.width, camera.height))
    return [
        depth_m * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        for u in us
        for v in vs
    ]


def _worst(covariance: FloatArray) -> float:
    """Largest standard deviation in any direction."""
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1])))


def figure(value: float) -> str:
    """Two significant digits of small numbers, whole numbers above ten."""
    if value == 0.0 or value >= 10.0:
        return f"{value:.0f}"
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(value))))}f}"
