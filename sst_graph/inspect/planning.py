"""What to record next: the covariance that frames not yet recorded would give.

A recorded frame's view (its information on the extrinsic) is combined with any motion: taken at
twist l_twist it informs the offset through J_offset = -J_extrinsic l_twist. Frames are predicted at other
places, each with objects and mask biases of its own, so that their information adds up.

What is assumed (a focal length, a principal point) has the same error in every frame: that part of the
covariance does not decrease with more frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sst_graph.covariance.observability import ObservabilityConfig, worst_ratio
from sst_graph.inspect.considered import considered_errors
from sst_graph.inspect.frame_information import (
    FrameInformation,
    positive_part,
    unit_diagonal,
    with_offset,
)
from sst_graph.result import CalibrationResult
from sst_graph.types import ByValue, FloatArray

AT_REST_MPS = 0.3
"""Below this speed a frame counts as standing [m/s]."""

USUAL_MPS = 8.0
"""Speed of predictions where the record does not move [m/s]."""

TURN_MPS, TURN_DEGPS = 5.0, 20.0
"""Speed and rate of a turn, as at a crossing [m/s], [deg/s]."""

MOST_FRAMES = 1000
"""Where the search for a sufficient number of frames ends."""


@dataclass(frozen=True, eq=False)
class Proposal(ByValue):
    """Frames that could be recorded.

    Attributes:
        name: what to do, in words.
        information: (7, 7) of one such frame on extrinsic and offset, on average.
    """

    name: str
    information: FloatArray


@dataclass(frozen=True, eq=False)
class Prediction(ByValue):
    """What a proposal would give.

    Attributes:
        name: of the proposal.
        sigmas: (7,) [rad, m, s] after it.
        worst: largest sigma over its limit (:func:`worst_ratio`): up to 1 the status would be ok.
        bits: information gained [bit]; 0 where a covariance has no inverse, and nothing is known.
        enough: fewest frames that bring ``worst`` below 1, or None where :data:`MOST_FRAMES` don't, or
            where it was not looked for.
    """

    name: str
    sigmas: FloatArray
    worst: float
    bits: float
    enough: int | None


@dataclass(frozen=True)
class RepeatedView:
    """A recorded frame's view, and what ``count`` of its like at other places would give.

    Attributes:
        position: of the frame in the record.
        prediction: with the plan's best motion.
    """

    position: int
    prediction: Prediction


@dataclass(frozen=True)
class Plan:
    """What to record next.

    Attributes:
        count: frames that the predictions add.
        now: the result as it is.
        elsewhere: the record's own frames, had each been taken at another place; what the calibration
            loses to errors that frames share.
        motions: proposals with the record's average view, the best first.
        nearer: the best motion, with objects half as far.
        views: every frame's view with the best motion, the best first.
    """

    count: int
    now: Prediction
    elsewhere: Prediction
    motions: tuple[Prediction, ...]
    nearer: Prediction
    views: tuple[RepeatedView, ...]

    @property
    def best(self) -> Prediction:
        """The best motion."""
        return self.motions[0]


def plan_recording(result: CalibrationResult, frames: Sequence[FrameInformation], count: int) -> Plan:
    """Predictions for ``count`` further frames; ``frames`` is not empty."""
    limits, lasting = limits_of(result), considered_covariance(result)
    views = np.stack([frame.view for frame in frames])
    twists = motion_twists(result.T_camera_lidar, frames)
    proposals = [Proposal(way, _mean_information(views.mean(axis=0), each)) for way, each in twists.items()]
    again = Proposal("as in this record", np.mean([frame.information for frame in frames], axis=0))

    def predicted(proposal: Proposal, number: int = count, search: bool = True) -> Prediction:
        return predict(result.covariance, proposal, number, limits, search, lasting)

    # Where the worst is the same, as far as it is shown, what else a motion teaches decides.
    motions = sorted((predicted(p) for p in (*proposals, again)), key=lambda p: (round(p.worst, 2), -p.bits))
    best = next((name for name in (motion.name for motion in motions) if name in twists), "standing")
    halved = nearer(views.mean(axis=0), result.T_camera_lidar)
    by_view = [
        RepeatedView(k, predicted(Proposal(best, _mean_information(frame.view, twists[best])), search=False))
        for k, frame in enumerate(frames)
    ]
    prior = np.zeros((7, 7))
    alone = _together(result, frames)
    return Plan(
        count,
        predicted(Proposal("now", prior), 0),
        predict(
            _vague() + lasting,
            Proposal("the same frames, each at another place", alone),
            1,
            limits,
            lasting=lasting,
        ),
        tuple(motions),
        predicted(Proposal("the best, with objects half as far", _mean_information(halved, twists[best]))),
        tuple(sorted(by_view, key=lambda view: view.prediction.worst)),
    )


def predict(
    covariance: FloatArray,
    proposal: Proposal,
    count: int,
    limits: ObservabilityConfig,
    search: bool = True,
    lasting: FloatArray | None = None,
) -> Prediction:
    """The covariance (7, 7) after ``count`` frames of a proposal.

    Without ``search`` the number of frames that is enough stays None. ``lasting``: (7, 7) part of the
    covariance that no frames reduce.
    """
    after = predicted_covariance(covariance, count * proposal.information, lasting)
    sigmas = np.sqrt(np.diag(covariance))
    before, left = (np.linalg.slogdet(_scaled(one, sigmas))[1] for one in (covariance, after))
    gain = before - left if np.isfinite([before, left]).all() else 0.0
    return Prediction(
        proposal.name,
        np.sqrt(np.maximum(np.diag(after), 0.0)),
        worst_ratio(after, limits),
        max(0.0, 0.5 * float(gain) / float(np.log(2.0))),
        _enough(covariance, proposal, limits, lasting) if search else None,
    )


def predicted_covariance(
    covariance: FloatArray, information: FloatArray, lasting: FloatArray | None = None
) -> FloatArray:
    """(7, 7) covariance after independent ``information`` (7, 7) is added: ((C - S)^-1 + information)^-1 + S.

    As C - C L (I + L' C L)^-1 L' C with information = L L', which needs no inverse of C.

    Args:
        lasting: S, (7, 7) part of C that no frames reduce; none by default.
    """
    lasting = np.zeros((7, 7)) if lasting is None else lasting
    own = positive_part(covariance - lasting) if lasting.any() else covariance
    unit, scale = unit_diagonal(information)
    values, vectors = np.linalg.eigh(unit)
    L = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    CL = own @ L
    # By least squares: beside a covariance of knowing nothing the unit matrix is lost in rounding.
    after = own - CL @ np.linalg.lstsq(np.eye(len(L)) + L.T @ CL, CL.T)[0]
    return np.asarray(0.5 * (after + after.T) + lasting)


def considered_covariance(result: CalibrationResult) -> FloatArray:
    """(7, 7) part of a result's covariance by its assumptions; zeros where it has none."""
    found, variances = np.zeros((7, 7)), np.diag(result.covariance)
    for sigma, sensitivity in considered_errors(result).values():
        step = sigma * sensitivity
        # A part of the covariance is no larger than the whole, whatever a file says.
        if (step**2 <= variances * (1.0 + 1e-3)).all():
            found += np.outer(step, step)
    return found


def motion_twists(cTl: gtsam.Pose3, frames: Sequence[FrameInformation]) -> dict[str, FloatArray]:
    """LiDAR twists (m, 6) [rad/s, m/s] of each way to drive."""
    forward, up = driving_axes(cTl, frames)
    moving = [frame.speed for frame in frames if frame.speed > AT_REST_MPS]
    v = float(np.median(moving)) if moving else USUAL_MPS
    other = 2.0 * v if v < USUAL_MPS else 0.5 * v
    turn = np.radians(TURN_DEGPS)

    def drive(speed: float, rate: float = 0.0) -> FloatArray:
        return np.concatenate([rate * up, speed * forward])

    top = max(v, USUAL_MPS)
    return {
        "standing": drive(0.0)[None],
        f"straight on at {v:.1f} m/s": drive(v)[None],
        f"straight on at {other:.1f} m/s": drive(other)[None],
        f"speed changing, 0 to {top:.0f} m/s": np.stack([drive(top * share) for share in (0, 0.25, 0.5, 1)]),
        f"turning, {TURN_DEGPS:.0f} deg/s both ways, {TURN_MPS:.0f} m/s": np.stack(
            [drive(TURN_MPS, turn), drive(TURN_MPS, -turn)]
        ),
    }


def driving_axes(cTl: gtsam.Pose3, frames: Sequence[FrameInformation]) -> tuple[FloatArray, FloatArray]:
    """Unit vectors forward and up in the LiDAR: the way the record drives, else the way the camera looks."""
    R = np.asarray(cTl.rotation().matrix())
    up = -R.T[:, 1]
    way = sum((frame.l_twist[3:] for frame in frames if frame.speed > 1.0), np.zeros(3))
    forward = way if np.linalg.norm(way) > 1.0 else R.T[:, 2]
    forward = forward / np.linalg.norm(forward)
    up = up - (up @ forward) * forward
    length = float(np.linalg.norm(up))
    return forward, up / length if length > 0.1 else -R.T[:, 1]


def nearer(view: FloatArray, cTl: gtsam.Pose3) -> FloatArray:
    """The view with everything twice as near to the camera: a shift moves the image twice as far.

    Counted about the camera's centre; the points per object, which grow too, stay as they are.
    """
    # Right perturbations at the LiDAR -> left perturbations at the camera, where depth scales translation.
    Ad = np.asarray(cTl.AdjointMap())
    to_camera = np.linalg.inv(Ad)
    scale = np.repeat([1.0, 2.0], 3)
    in_camera = to_camera.T @ view @ to_camera * np.outer(scale, scale)
    return np.asarray(Ad.T @ in_camera @ Ad)


def limits_of(result: CalibrationResult) -> ObservabilityConfig:
    """The limits of observability of the result; the defaults where it has none."""
    place: Any = result.config.get("observability")
    if place is None and isinstance(result.config.get("calibration"), Mapping):
        place = result.config["calibration"].get("observability")
    if not isinstance(place, Mapping):
        return ObservabilityConfig()
    names = [field.name for field in dataclasses.fields(ObservabilityConfig)]
    given = {
        name: float(place[name])
        for name in names
        if isinstance(place.get(name), (int, float)) and place[name] > 0
    }
    return dataclasses.replace(ObservabilityConfig(), **given)


def _together(result: CalibrationResult, frames: Sequence[FrameInformation]) -> FloatArray:
    """(7, 7) information of all frames on the extrinsic and the time offset in the result's covariance; of
    drives with offsets of their own on the extrinsic alone, that offset marginalised out."""
    own = [drive.drive for drive in result.drive_offsets[:1]]
    total = np.zeros((7, 7))
    for name in dict.fromkeys(frame.frame.drive for frame in frames):
        information = sum((one.information for one in frames if one.frame.drive == name), np.zeros((7, 7)))
        if own and name not in own:
            with_prior = information[6, 6] + 1.0 / _vague()[6, 6]
            information = information - np.outer(information[:, 6], information[6]) / with_prior
            information[6] = information[:, 6] = 0.0
        total += information
    return total


def _mean_information(view: FloatArray, twists: FloatArray) -> FloatArray:
    return np.asarray(np.mean([with_offset(view, twist) for twist in twists], axis=0))


def _enough(
    covariance: FloatArray, proposal: Proposal, limits: ObservabilityConfig, lasting: FloatArray | None
) -> int | None:
    """Fewest frames of a proposal that bring every direction within the limits."""

    def ok(count: int) -> bool:
        after = predicted_covariance(covariance, count * proposal.information, lasting)
        return worst_ratio(after, limits) <= 1.0

    if ok(0) or not ok(MOST_FRAMES):
        return 0 if ok(0) else None
    low, high = 0, MOST_FRAMES
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if ok(middle) else (middle, high)
    return high


def _vague() -> FloatArray:
    """(7, 7) covariance of the graph's priors alone."""
    return np.diag(np.array([1.0] * 3 + [0.5] * 3 + [0.3]) ** 2)


def _scaled(covariance: FloatArray, scale: FloatArray) -> FloatArray:
    scale = np.where(scale > 0.0, scale, 1.0)
    return np.asarray(covariance / np.outer(scale, scale))
