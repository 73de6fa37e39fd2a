"""Where a point is drawn, against where the picture shows it: the lens moves both."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.pixels import cP_H_cTl, pixel_covariance
from sst_graph.result import CalibrationResult

CAMERA = PinholeCamera(700.0, 700.0, 620.0, 187.0, 1241, 375)
CTL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.1, -0.1, -0.3]))
REST = np.eye(6, 7)
POSE = np.diag(np.square([*np.radians([0.02, 0.03, 0.01]), 0.01, 0.02, 0.005, 0.002]))


def result_of(assumptions: Any, covariance: np.ndarray = POSE) -> CalibrationResult:
    return CalibrationResult(
        CTL, 0.1, covariance, status="ok", camera=CAMERA, diagnostics={"assumptions": assumptions}
    )


def considered(sensitivities: dict[str, list[float]], sigmas: dict[str, float]) -> CalibrationResult:
    """POSE, and what the parameters add to it."""
    covariance = POSE.copy()
    for name, sensitivity in sensitivities.items():
        covariance += sigmas[name] ** 2 * np.outer(sensitivity, sensitivity)
    entries = {n: {"sigma": sigmas[n], "sensitivity": s} for n, s in sensitivities.items()}
    return result_of(entries, covariance)


def test_a_wrong_principal_point_that_the_pose_takes_up_is_not_seen() -> None:
    # Turning the LiDAR about its y axis (the camera's x, to the left) moves pixels up or down.
    J = CAMERA.uv_H_cP(np.array([[0.0, 0.0, 1e4]]))[0] @ cP_H_cTl(CTL, np.array([0.0, 0.0, 1e4]))
    turn = -1.0 / J[1, 1]
    with_cy = considered({"cy": [0.0, turn, 0.0, 0.0, 0.0, 0.0, 0.0]}, {"cy": 5.0})
    far = np.array([0.0, 0.0, 1e4])
    np.testing.assert_allclose(
        pixel_covariance(with_cy, far, REST), pixel_covariance(result_of({}), far, REST), atol=1e-3
    )
    assert np.degrees(np.sqrt(with_cy.covariance[1, 1])) > 0.4


def test_a_lens_parameter_that_the_pose_does_not_take_up_counts_whole() -> None:
    with_cx = considered({"cx": [0.0] * 7}, {"cx": 2.0})
    P = pixel_covariance(with_cx, np.array([1.0, 0.5, 20.0]), REST)
    alone = pixel_covariance(result_of({}), np.array([1.0, 0.5, 20.0]), REST)
    np.testing.assert_allclose(P - alone, [[4.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_by_drawing() -> None:
    """Poses and lenses drawn at random: the picture by these, against the point by the given ones."""
    rng = np.random.default_rng(0)
    sigmas = {"cx": 1.0, "cy": 1.5, "focal": 0.001, "k1": 0.004}
    sensitivities = {
        name: (rng.normal(size=7) * np.sqrt(np.diag(POSE)) / sigmas[name]).tolist() for name in sigmas
    }
    result = considered(sensitivities, sigmas)
    cP = np.array([-9.0, 2.0, 20.0])
    lP = CTL.transformTo(cP)
    x, y = cP[:2] / cP[2]
    errors = []
    for _ in range(6000):
        thetas = {name: sigma * rng.normal() for name, sigma in sigmas.items()}
        # The optimum if the parameters were these, and noise of the matches.
        step = sum(theta * np.array(sensitivities[name]) for name, theta in thetas.items())
        step = step + np.sqrt(np.diag(POSE)) * rng.normal(size=7)
        xt, yt, zt = CTL.retract(step[:6]).transformFrom(lP)
        x, y = xt / zt, yt / zt
        stretch = (1.0 + thetas["focal"]) * (1.0 + thetas["k1"] * (x * x + y * y))
        centre = np.array([CAMERA.cx + thetas["cx"], CAMERA.cy + thetas["cy"]])
        errors.append(centre + 700.0 * stretch * np.array([x, y]) - CAMERA.project(cP[None])[0])
    # Three deviations of a covariance of 2.7 px^2 by so many draws.
    expected = pixel_covariance(result, cP, REST)
    np.testing.assert_allclose(np.cov(np.array(errors).T), expected, atol=0.14)


@pytest.mark.parametrize(
    "odd",
    [
        None,
        [],
        {"cx": None},
        {"cx": {"sigma": "1", "sensitivity": [0.0] * 7}},
        {"cx": {"sigma": 1.0, "sensitivity": [0.0] * 6}},
        {"cx": {"sigma": 1e300, "sensitivity": [0.0] * 7}},
        {"unknown": {"sigma": 1.0, "sensitivity": [0.0] * 7}},
    ],
)
def test_what_a_file_may_hold_instead_adds_nothing(odd: Any) -> None:
    cP = np.array([0.0, 0.0, 20.0])
    plain = pixel_covariance(result_of({}), cP, REST)
    np.testing.assert_array_equal(pixel_covariance(result_of(odd), cP, REST), plain)
