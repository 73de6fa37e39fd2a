"""Which combinations of the seven unknowns the data do not determine, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.config import Settings, setting
from sst_graph.result import DIRECTION_SCALES, WeakDirection
from sst_graph.types import FloatArray

_TAKES_PART = 0.1
"""Least part of a weak direction's unit vector that is named."""
_TRADE_CORRELATION = 0.9
"""From here on a translation would be known more than twice as well if the time offset were known."""
_WITH_ROTATION = 0.3
"""Least part of both rotation and time offset in a direction that is said to be of the two."""
_ALONG_AXIS = 0.95
"""Least component of a rotation's unit vector along an axis that is named instead of it (18 deg)."""
_PAIR_CORRELATION = 0.98
"""A translation and the time offset that are correlated as closely as this hardly separate, as at constant
speed: they are separated by small differences only."""
_PAIR_SHARE = 0.5
"""Two unknowns that hardly separate must be determined to this fraction of the limits."""


@dataclass(frozen=True)
class Advice:
    """What to record so that a direction is determined, by what is weak in it.

    Attributes:
        together: translation against time offset.
        offset, rotation, translation: one of them alone.
    """

    together: str
    offset: str
    rotation: str
    translation: str


SILHOUETTES = Advice(
    together="record a stop, a change of speed or a turn",
    offset="record motion with a change of speed or a turn",
    rotation="record objects on all sides of the image, near and far",
    translation="record objects nearer to the sensors, at several distances",
)
"""For calibration by objects that both sensors see."""
MOTION = Advice(
    together="record turns to both sides, at different speeds",
    offset="record turns that begin and end, or a rough road (the offset is seen where turning changes)",
    rotation="record turns (a straight drive leaves the rotation about its direction open)",
    translation="record tight turns and ramps, or use method joint (motion without turns leaves the "
    "translation open, and motion in a plane the height)",
)
"""For calibration by motion alone."""


@dataclass(frozen=True)
class ObservabilityConfig(Settings):
    """Largest standard deviations of an estimate that may be called ok."""

    rotation_deg: float = setting(
        0.5,
        at_least=1e-30,
        at_most=180.0,
        doc="Largest standard deviation of any rotation of a result that is ok. Lower it where the "
        "use needs more.",
    )
    translation_m: float = setting(
        0.05,
        at_least=1e-30,
        at_most=1000.0,
        doc="Largest standard deviation of any translation of a result that is ok. Lower it where the"
        " use needs more.",
    )
    time_offset_s: float = setting(
        0.01,
        at_least=1e-30,
        at_most=1000.0,
        doc="Largest standard deviation of the time offset of a result that is ok. Lower it where the"
        " use needs more.",
    )


def weak_directions(
    covariance: FloatArray, cTl: gtsam.Pose3, config: ObservabilityConfig, advice: Advice = SILHOUETTES
) -> tuple[WeakDirection, ...]:
    """Directions whose standard deviation is past the limits, the weakest first; none where every unknown is
    within its own.

    The eigenvectors of the (7, 7) covariance, each unknown measured in its own limit: an eigenvalue above
    1 is a combination known worse than the limits allow.
    """
    limits = limits_of_unknowns(covariance, config)
    scaled = covariance / np.outer(limits, limits)
    if _worst(scaled) <= 1.0:
        return ()
    values, vectors = np.linalg.eigh(scaled)
    found = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value <= 1.0:
            break
        found.append(_describe(limits * vector * np.sqrt(value), covariance, cTl, advice))
    return tuple(found)


def worst_ratio(covariance: FloatArray, config: ObservabilityConfig) -> float:
    """Largest standard deviation in units of its limit: of a rotation about any axis, a translation along any
    axis, the time offset."""
    limits = limits_of_unknowns(covariance, config)
    return _worst(covariance / np.outer(limits, limits))


def _worst(scaled: FloatArray) -> float:
    """:func:`worst_ratio` of a covariance (7, 7) in units of the limits."""
    parts = (scaled[own, own] for own in (slice(0, 3), slice(3, 6), slice(6, 7)))
    return float(np.sqrt(max(np.linalg.eigvalsh(part)[-1] for part in parts)))


def open_directions(
    covariance: FloatArray,
    by_static_objects: FloatArray | None,
    cTl: gtsam.Pose3,
    config: ObservabilityConfig,
    advice: Advice = SILHOUETTES,
) -> tuple[WeakDirection, ...]:
    """Directions beyond the limits: of the covariance or, where that is within them, of that by static
    objects alone.

    Args:
        covariance: (7, 7) of the estimate.
        by_static_objects: (7, 7) by static objects alone, where dynamic ones are among the matches.
    """
    weak = weak_directions(covariance, cTl, config, advice)
    if weak or by_static_objects is None:
        return weak
    return inseparable_directions(by_static_objects, cTl, config)


def inseparable_directions(
    covariance: FloatArray, cTl: gtsam.Pose3, config: ObservabilityConfig
) -> tuple[WeakDirection, ...]:
    """Directions along which static objects do not separate the time offset from the translation.

    None unless the two are correlated as closely as at constant speed.

    Args:
        covariance: (7, 7) by static objects alone.
    """
    if _paired(covariance) < _PAIR_CORRELATION:
        return ()
    return tuple(
        replace(direction, sentence=f"by static objects alone, {direction.sentence}")
        for direction in weak_directions(covariance, cTl, config)
        if min(abs(float(direction.vector[6])), float(np.linalg.norm(direction.vector[3:6]))) > _TAKES_PART
    )


def reasons_of(directions: Sequence[WeakDirection]) -> tuple[str, ...]:
    """The reason of each direction; what two of them say alike, once."""
    return tuple(dict.fromkeys(direction.reason for direction in directions))


def involves_offset(direction: WeakDirection) -> bool:
    """Whether the time offset takes part in a weak direction."""
    return abs(float(direction.vector[6])) > _TAKES_PART


def limits_of_unknowns(covariance: FloatArray, config: ObservabilityConfig) -> FloatArray:
    """(7,) largest standard deviations [rad, m, s] that a covariance may have."""
    limits = np.array(
        [np.radians(config.rotation_deg)] * 3 + [config.translation_m] * 3 + [config.time_offset_s]
    )
    if _paired(covariance) >= _PAIR_CORRELATION:
        limits[3:] *= _PAIR_SHARE
    return limits


def _paired(covariance: FloatArray) -> float:
    """Multiple correlation of the time offset with the translation, 0 to 1."""
    sigmas = np.sqrt(np.maximum(np.diag(covariance)[3:], 0.0))
    if not (sigmas > 0.0).all():
        return 0.0
    correlation = covariance[3:, 3:] / np.outer(sigmas, sigmas)
    cross = correlation[:3, 3]
    explained = float(cross @ np.linalg.lstsq(correlation[:3, :3], cross)[0])
    return float(np.sqrt(min(max(explained, 0.0), 1.0)))


def _describe(step: FloatArray, covariance: FloatArray, cTl: gtsam.Pose3, advice: Advice) -> WeakDirection:
    """A weak direction from its one-sigma step (7,) [rad, m, s], an axis of the covariance."""
    scaled = step / DIRECTION_SCALES
    sigma = float(np.linalg.norm(scaled))
    vector = scaled / sigma
    if vector[np.abs(vector).argmax()] < 0:
        step, vector = -step, -vector
    c_step, c_alone = (_in_camera(one, cTl) for one in (step, _alone(covariance, step)))
    sentence, remedy = _words((c_step, c_alone), vector, _traded(covariance, step), advice)
    return WeakDirection(vector, sigma, sentence, remedy)


def _alone(covariance: FloatArray, step: FloatArray) -> FloatArray:
    """The rotation, translation and time offset of a step (7,), each as long as one sigma along it.

    A part of a one-sigma step is shorter: it moves with the others.
    """
    found = np.zeros(7)
    for own in (slice(0, 3), slice(3, 6), slice(6, 7)):
        length = float(np.linalg.norm(step[own]))
        if length > 0.0:
            direction = step[own] / length
            variance = float(direction @ covariance[own, own] @ direction)
            found[own] = direction * max(variance, 0.0) ** 0.5
    return found


def _in_camera(step: FloatArray, cTl: gtsam.Pose3) -> FloatArray:
    """A step (7,) with its translation in the camera's axes."""
    return np.concatenate([step[:3], np.asarray(cTl.rotation().matrix()) @ step[3:6], step[6:]])


def _traded(covariance: FloatArray, step: FloatArray) -> bool:
    """Whether the time offset and the translation along a step (7,) hardly separate: only then is the ratio
    of their parts a rate at which one makes up for the other."""
    along = np.concatenate([np.zeros(3), step[3:6], [0.0]])
    offset = np.eye(7)[6]
    variances = (along @ covariance @ along) * (offset @ covariance @ offset)
    return bool(abs(along @ covariance @ offset) > _TRADE_CORRELATION * np.sqrt(max(variances, 1e-300)))


def _words(
    steps: tuple[FloatArray, FloatArray], vector: FloatArray, traded: bool, advice: Advice
) -> tuple[str, str]:
    """What one sigma along a weak direction means, and what to record.

    Args:
        steps: (7,) along it, and its parts as long as one sigma of each alone; translations in the camera's
            axes.
        vector: (7,) the direction in scaled units.
        traded: translation and time offset hardly separate.
    """
    step, alone = steps
    rotation, c_translation, time_offset_s = step[:3], step[3:6], float(step[6])
    parts = {
        "rotation": float(np.linalg.norm(vector[:3])),
        "translation": float(np.linalg.norm(vector[3:6])),
        "offset": abs(float(vector[6])),
    }
    translation_m = float(np.linalg.norm(c_translation))
    words, either_way = _axis_words(c_translation)
    if traded and parts["offset"] > _TAKES_PART and parts["translation"] > _TAKES_PART:
        rate_ms = abs(time_offset_s) * 1e3 / translation_m if translation_m else 0.0
        sign = "later" if time_offset_s > 0 else "earlier"
        return (
            f"the LiDAR {words} cannot be distinguished from the image taken {sign}: "
            f"1 m equals {rate_ms:.0f} ms of time offset (one sigma: {100 * translation_m:.1f} cm, "
            f"{abs(time_offset_s) * 1e3:.1f} ms)",
            advice.together,
        )
    angle_deg = float(np.degrees(np.linalg.norm(rotation)))
    if min(parts["offset"], parts["rotation"]) > _WITH_ROTATION:
        sign = "later" if time_offset_s * rotation[np.abs(rotation).argmax()] > 0 else "earlier"
        return (
            f"the LiDAR turned about {_rotation_axis(rotation)} cannot be distinguished from the image "
            f"taken {sign} (one sigma: {angle_deg:.2f} deg, {abs(time_offset_s) * 1e3:.1f} ms)",
            advice.offset,
        )
    if parts["offset"] >= max(parts["rotation"], parts["translation"]):
        return (
            f"the time offset is known to {abs(float(alone[6])) * 1e3:.1f} ms only (one sigma)",
            advice.offset,
        )
    if parts["rotation"] > parts["translation"]:
        return (
            f"the rotation is known to {np.degrees(np.linalg.norm(alone[:3])):.2f} deg only (one sigma) "
            f"about {_rotation_axis(rotation)}",
            advice.rotation,
        )
    cm = 100.0 * float(np.linalg.norm(alone[3:6]))
    return (
        f"the translation is known to {cm:.1f} cm only (one sigma), {either_way}",
        advice.translation,
    )


def _rotation_axis(rotation: FloatArray) -> str:
    """The LiDAR's axis about which a rotation vector turns; its direction where it is none of them."""
    direction = rotation / max(float(np.linalg.norm(rotation)), 1e-12)
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > _ALONG_AXIS:
        return f"the LiDAR's {'xyz'[axis]} axis"
    x, y, z = np.round(direction * np.sign(direction[axis]), 2) + 0.0  # no -0.00
    # In brackets: a short reason leaves out what stands in parentheses.
    return f"the axis [{x:.2f}, {y:.2f}, {z:.2f}] of the LiDAR's frame"


def _axis_words(c_translation: FloatArray) -> tuple[str, str]:
    """Direction of a shift in the camera frame, and its axis, in words."""
    names = (("right", "left"), ("down", "up"), ("forward", "backward"))
    axis = int(np.abs(c_translation).argmax())
    way = names[axis][0 if c_translation[axis] > 0 else 1]
    return f"shifted {way}", " or ".join(names[axis])
