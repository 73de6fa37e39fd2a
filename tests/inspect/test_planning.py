"""Predictions of what to record: closed forms, and the classic cure of forward against delay."""

from __future__ import annotations

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.strict_json import json_able
from sst_graph.inspect.frame_information import FrameInformation, with_offset
from sst_graph.inspect.planning import (
    Proposal,
    _vague,
    considered_covariance,
    driving_axes,
    limits_of,
    motion_twists,
    nearer,
    plan_recording,
    predict,
    predicted_covariance,
)
from sst_graph.result import CalibrationResult, DriveOffset, FrameId

CTL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.0, -0.1, -0.3]))
"""The camera looks along the LiDAR's x axis."""
CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
LIMITS = ObservabilityConfig()


def view_of(cPs: np.ndarray, cTl: gtsam.Pose3 = CTL) -> np.ndarray:
    """(6, 6) information of points (n, 3) in the camera, each seen to 1 px, on cTl."""
    R = cTl.rotation().matrix()
    L = np.zeros((6, 6))
    for cP, uv_H_cP in zip(cPs, CAMERA.uv_H_cP(cPs), strict=True):
        J = uv_H_cP @ R @ np.hstack([-gtsam.Rot3.Hat(cTl.transformTo(cP)), np.eye(3)])
        L += J.T @ J
    return L


def street(seed: int = 0, n: int = 40) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-6, 6, n), rng.uniform(-1, 1.5, n), rng.uniform(6, 25, n)], axis=1)


def at_constant_speed(
    speed: float = 8.0, frames: int = 5
) -> tuple[CalibrationResult, list[FrameInformation]]:
    """A result whose frames all drove at one speed along the LiDAR's x, and its frames."""
    twist = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])
    views = [view_of(street(seed)) / 500.0 for seed in range(frames)]
    information = sum(with_offset(view, twist) for view in views)
    priors = np.diag(np.array([1.0] * 3 + [0.5] * 3 + [0.3]) ** -2.0)
    result = CalibrationResult(CTL, 0.0, np.linalg.inv(information + priors), "unobservable", CAMERA)
    ones = np.ones(7)
    return result, [
        FrameInformation(FrameId("street/00", k), 0.1, ones, ones, view, twist, 80, 4, 6.0, 0.5)
        for k, view in enumerate(views)
    ]


def test_what_is_taken_for_granted_stays() -> None:
    """A principal point that is off is off in every frame: more of them leave its part of the sigma."""
    result, frames = at_constant_speed()
    step = np.array([0.0, 2e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
    entry = {"sigma": 0.5, "sensitivity": (2.0 * step).tolist()}
    granted = replace(
        result,
        covariance=result.covariance + np.outer(step, step),
        diagnostics={"assumptions": {"cx": entry}},
    )
    np.testing.assert_allclose(considered_covariance(granted), np.outer(step, step))
    plan, without = plan_recording(granted, frames, 1000), plan_recording(result, frames, 1000)
    by_name = {motion.name: motion for motion in without.motions}
    assert {motion.name for motion in plan.motions} == by_name.keys()
    for found, free in ((motion, by_name[motion.name]) for motion in plan.motions):
        np.testing.assert_allclose(found.sigmas**2, free.sigmas**2 + step**2, rtol=1e-6)
    assert plan.best.sigmas[1] > 2e-3 > 4.0 * without.best.sigmas[1]


@pytest.mark.parametrize("taken", [[0, 1], [0, 4], [5, 6], [2]])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e10])
def test_an_assumption_that_takes_all_of_a_variance(
    taken: list[int], size: float, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nothing is left on the diagonal, but something beside it: it is not divided by."""
    result, frames = at_constant_speed()
    step = np.zeros(7)
    step[taken] = size
    covariance = np.diag(np.where(step > 0.0, step, 1e-3) ** 2)
    covariance[np.ix_(taken, taken)] += 0.5 * size**2 * (1.0 - np.eye(len(taken)))
    entry = {"sigma": 1.0, "sensitivity": step.tolist()}
    granted = replace(result, covariance=covariance, diagnostics={"assumptions": {"cx": entry}})
    plan = plan_recording(granted, frames, 10)
    for found in (plan.now, plan.best, *plan.motions):
        np.testing.assert_allclose(found.sigmas[taken], size, rtol=1e-6)  # no frames reduce it
        assert (np.delete(found.sigmas, taken) <= 1e-3 * (1.0 + 1e-6)).all()
    assert json.dumps(json_able(plan), allow_nan=False)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "entry",
    [
        None,
        [],
        {"sigma": 1.0},
        {"sigma": "1", "sensitivity": [1e-3] * 6},
        {"sigma": 10**400, "sensitivity": [0.0] * 7},
        {"sigma": 1.0, "sensitivity": [1e9] * 7},
        {"sigma": float("nan"), "sensitivity": [0.0] * 7},
    ],
)
def test_an_assumption_that_makes_no_sense_is_none(entry: object) -> None:
    result, _ = at_constant_speed()
    assert not considered_covariance(replace(result, diagnostics={"assumptions": {"cx": entry}})).any()


def test_information_adds_to_the_inverse() -> None:
    rng = np.random.default_rng(1)
    root, more = rng.normal(size=(7, 7)), rng.normal(size=(3, 7))
    C, L = root @ root.T, more.T @ more
    np.testing.assert_allclose(predicted_covariance(C, L), np.linalg.inv(np.linalg.inv(C) + L), rtol=1e-8)
    np.testing.assert_allclose(predicted_covariance(C, np.zeros((7, 7))), C)
    # A covariance without an inverse, and units far apart.
    flat = np.diag([1e-12, 1.0, 0.0, 1e6, 1.0, 1.0, 1.0])
    L = np.diag([1e12, 1.0, 1.0, 1e-6, 0.0, 3.0, 0.0])
    np.testing.assert_allclose(
        np.diag(predicted_covariance(flat, L)), [5e-13, 0.5, 0.0, 5e5, 1.0, 0.25, 1.0], rtol=1e-9
    )


def test_what_rounding_leaves_of_no_information_is_none() -> None:
    C, L = 1e-4 * np.eye(7), 1e4 * np.eye(7)
    for nothing in (0.0, -1e-9):
        L[6] = L[:, 6] = 1e-6
        L[6, 6] = nothing
        after = predicted_covariance(C, L)
        np.testing.assert_allclose(np.diag(after), [5e-5] * 6 + [1e-4], rtol=1e-9)


def test_steady_driving_does_not_help_and_standing_does() -> None:
    result, frames = at_constant_speed()
    plan = plan_recording(result, frames, 10)
    by_name = {motion.name: motion for motion in plan.motions}
    x_and_offset = [3, 6]
    now = plan.now.sigmas[x_and_offset]
    # The same speed leaves the line x = speed * offset where it was; standing or another speed cuts it.
    np.testing.assert_array_less(0.95 * now, by_name["straight on at 8.0 m/s"].sigmas[x_and_offset])
    np.testing.assert_array_less(0.95 * now, by_name["as in this record"].sigmas[x_and_offset])
    for cure in ("standing", "straight on at 4.0 m/s", "speed changing, 0 to 8 m/s"):
        np.testing.assert_array_less(by_name[cure].sigmas[x_and_offset], 0.5 * now)
        assert by_name[cure].bits > 3.0 and by_name[cure].worst < 0.5 * plan.now.worst
    assert by_name["standing"].sigmas[3] < 0.12 * now[0] and plan.best.worst < 1.5 < plan.now.worst
    assert plan.motions[-1].name == "straight on at 8.0 m/s" or plan.motions[-1].name == "as in this record"
    assert [m.worst for m in plan.motions] == sorted(m.worst for m in plan.motions)
    assert plan.now.bits == 0.0 and plan.motions[-1].enough is None


def test_a_prediction_is_what_the_frames_then_give() -> None:
    result, frames = at_constant_speed()
    mean = np.mean([frame.view for frame in frames], axis=0)
    standing = with_offset(mean, np.zeros(6))
    expected = np.linalg.inv(np.linalg.inv(result.covariance) + 10 * standing)
    (found,) = [m for m in plan_recording(result, frames, 10).motions if m.name == "standing"]
    np.testing.assert_allclose(found.sigmas, np.sqrt(np.diag(expected)), rtol=1e-6)


def test_the_fewest_frames_that_are_enough() -> None:
    C = np.diag(np.array([0.001] * 3 + [0.001] * 3 + [0.05]) ** 2)
    one = Proposal("one", np.diag([0.0] * 6 + [1.0 / 0.02**2]))
    found = predict(C, one, 1, LIMITS)
    # 1 / 0.05^2 + n / 0.02^2 >= 1 / 0.01^2 from n = 3.84 on.
    assert found.enough == 4
    assert predict(C, one, 4, LIMITS).worst <= 1.0 < predict(C, one, 3, LIMITS).worst
    assert predict(C, replace(one, information=np.zeros((7, 7))), 1, LIMITS).enough is None
    assert predict(C, one, 1, LIMITS, search=False).enough is None
    wide = ObservabilityConfig(time_offset_s=0.1)
    assert predict(C, one, 1, wide).enough == 0


def test_nearer_views_of_points() -> None:
    cPs = street(3)
    found = nearer(view_of(cPs), CTL)
    np.testing.assert_allclose(found, view_of(0.5 * cPs), rtol=1e-9, atol=1e-6 * np.abs(found).max())


def test_axes_of_driving() -> None:
    _, frames = at_constant_speed()
    forward, up = driving_axes(CTL, frames)
    np.testing.assert_allclose(forward, [1, 0, 0])
    np.testing.assert_allclose(up, [0, 0, 1])
    # A camera that looks to the left still drives the way the record does; without motion, it looks ahead.
    left = CTL * gtsam.Pose3(gtsam.Rot3.Rz(-np.pi / 2), np.zeros(3))
    np.testing.assert_allclose(driving_axes(left, frames)[0], [1, 0, 0], atol=1e-12)
    standing = [replace(frame, l_twist=np.zeros(6)) for frame in frames]
    np.testing.assert_allclose(driving_axes(CTL, standing)[0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(driving_axes(left, standing)[0], [0, 1, 0], atol=1e-12)
    turns = motion_twists(CTL, frames)["turning, 20 deg/s both ways, 5 m/s"]
    np.testing.assert_allclose(turns, [[0, 0, s * np.radians(20), 5, 0, 0] for s in (1, -1)], atol=1e-12)


def test_views_are_ranked_by_what_they_would_bring() -> None:
    result, frames = at_constant_speed()
    poor = replace(frames[2], view=0.01 * frames[2].view)
    frames = [*frames[:2], poor, *frames[3:]]
    plan = plan_recording(result, frames, 3)
    assert plan.views[-1].position == 2
    assert sorted(view.position for view in plan.views) == [0, 1, 2, 3, 4]
    assert plan.nearer.sigmas[4] < plan.best.sigmas[4]


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({}, LIMITS),
        (
            {"observability": {"rotation_deg": 0.1, "translation_m": 0.02, "time_offset_s": 0.002}},
            (0.1, 0.02, 0.002),
        ),
        ({"calibration": {"observability": {"time_offset_s": 0.001}}}, (0.5, 0.05, 0.001)),
        ({"observability": {"time_offset_s": 0.0, "rotation_deg": "x"}}, LIMITS),
        ({"observability": None, "calibration": 3}, LIMITS),
    ],
)
def test_limits_of_a_result(config: dict[str, object], expected: object) -> None:
    result = CalibrationResult(CTL, 0.0, np.eye(7), "ok", CAMERA, config=config)
    limits = ObservabilityConfig(*expected) if isinstance(expected, tuple) else expected
    assert limits_of(result) == limits


def test_frames_of_a_drive_with_another_time_offset_tell_of_the_extrinsic_alone() -> None:
    """Against extrinsic and both offsets in one matrix."""
    speeds = [("a", 0.0), ("a", 8.0), *(("b", float(v)) for v in range(12))]
    view = np.diag(1.0 / np.square([*np.radians([0.3] * 3), 0.05, 0.05, 0.05]))
    frames, H = [], np.diag(np.append(1.0 / np.diag(_vague()), 1.0 / _vague()[6, 6]))
    for k, (drive, speed) in enumerate(speeds):
        twist = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])
        found = FrameInformation(FrameId(drive, k), 1.0, np.ones(7), np.ones(7), view, twist, 90, 4, 6.5, 0.4)
        J = np.zeros((6, 8))
        J[:, :6], J[:, 6 if drive == "a" else 7] = np.eye(6), -twist
        frames, H = [*frames, found], H + J.T @ view @ J
    covariance = np.linalg.inv(H)[:7, :7]
    offsets = DriveOffset("a", 0.05, 0.01), DriveOffset("b", 0.02, 0.01)
    result = CalibrationResult(gtsam.Pose3(), 0.05, 4.0 * covariance, "ok", CAMERA, drive_offsets=offsets)
    plan = plan_recording(result, frames, 10)
    np.testing.assert_allclose(plan.elsewhere.sigmas, np.sqrt(np.diag(covariance)), rtol=1e-6)
    one_clock = plan_recording(replace(result, drive_offsets=()), frames, 10)
    assert one_clock.elsewhere.sigmas[6] < 0.6 * plan.elsewhere.sigmas[6]
