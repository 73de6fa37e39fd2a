"""Metrics against numbers worked by hand."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.metrics import (
    FORWARD_R_OPTICAL,
    TruthSigma,
    calibration_errors,
    euler_angles_deg,
    mean_euler_difference_deg,
    mean_translation_difference_m,
    nees,
    quaternion_angle_deg,
    tangent_error,
)
from sst_graph.types import GroundTruth


def _camera_from(roll_deg: float, pitch_deg: float, yaw_deg: float) -> gtsam.Rot3:
    """cRl of a LiDAR turned by these angles against a camera on vehicle axes."""
    vehicle = gtsam.Rot3.RzRyRx(*np.radians([roll_deg, pitch_deg, yaw_deg]))
    return FORWARD_R_OPTICAL.inverse().compose(vehicle)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-7, 0.3, 30.0, 179.0, 180.0])
def test_quaternion_angle_is_the_angle_between(angle_deg: float) -> None:
    R = gtsam.Rot3.RzRyRx(0.4, -0.2, 1.0)
    axis = np.array([0.6, 0.0, 0.8])
    turned = R.compose(gtsam.Rot3.Expmap(np.radians(angle_deg) * axis))
    assert quaternion_angle_deg(turned, R) == pytest.approx(angle_deg, rel=1e-6, abs=1e-12)


def test_quaternion_angle_is_the_papers_formula() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        p, q = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 4)))
        expected = np.degrees(2.0 * np.arccos(abs(p @ q)))
        assert quaternion_angle_deg(gtsam.Rot3.Quaternion(*p), gtsam.Rot3.Quaternion(*q)) == pytest.approx(
            expected, abs=1e-5
        )


def test_euler_angles_are_those_on_vehicle_axes() -> None:
    assert euler_angles_deg(_camera_from(2.0, -1.0, 3.0)) == pytest.approx([2.0, -1.0, 3.0])


def test_forward_looking_optical_axes() -> None:
    # A point ahead of the LiDAR (x) lies along the camera's z; to its left (y) along the camera's -x.
    cRl = _camera_from(0.0, 0.0, 0.0).matrix()
    assert cRl @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 0.0, 1.0])
    assert cRl @ [0.0, 1.0, 0.0] == pytest.approx([-1.0, 0.0, 0.0])


def test_mean_euler_difference() -> None:
    assert mean_euler_difference_deg(_camera_from(2, -1, 3), _camera_from(0, 0, 0)) == pytest.approx(2.0)


def test_mean_euler_difference_wraps() -> None:
    assert mean_euler_difference_deg(_camera_from(0, 0, 179), _camera_from(0, 0, -179)) == pytest.approx(
        2 / 3
    )


def test_mean_translation_difference() -> None:
    a, b = gtsam.Pose3(gtsam.Rot3(), [0.1, -0.2, 0.3]), gtsam.Pose3()
    assert mean_translation_difference_m(a, b) == pytest.approx(0.2)


def test_tangent_error_leads_from_the_estimate_to_the_truth() -> None:
    estimate = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.2, 1.0), [1.0, 2.0, 3.0])
    xi = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    truth = estimate.compose(gtsam.Pose3.Expmap(xi))
    assert tangent_error(estimate, truth, time_error_s=0.004) == pytest.approx([*xi, -0.004])


def test_nees_by_hand() -> None:
    assert nees(np.array([1.0, 1.0]), np.array([[1.0, 0.5], [0.5, 1.0]])) == pytest.approx(4.0 / 3.0)
    assert nees(np.array([3e-3, 0.0]), np.diag([1e-6, 1e12])) == pytest.approx(9.0)


def test_nees_refuses_what_is_no_covariance() -> None:
    with pytest.raises(DataError, match="not positive definite"):
        nees(np.ones(2), np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(DataError, match="not positive definite"):
        nees(np.ones(2), np.zeros((2, 2)))


def test_nees_of_draws_has_the_dimension_as_its_mean() -> None:
    rng = np.random.default_rng(0)
    root = np.diag([1e-3] * 3 + [1e-2] * 3 + [2e-3]) @ (np.eye(7) + 0.3 * rng.normal(size=(7, 7)))
    estimate = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.2, 1.0), [1.0, 2.0, 3.0])
    values = []
    for draw in rng.normal(size=(2000, 7)) @ root.T:
        truth = GroundTruth(estimate.compose(gtsam.Pose3.Expmap(draw[:6])), 0.1 + draw[6])
        errors = calibration_errors(estimate, 0.1, truth, root @ root.T)
        assert errors.nees is not None
        values.append(
            [errors.nees.joint, errors.nees.rotation, errors.nees.translation, errors.nees.time_offset]
        )
    assert np.mean(values, axis=0) == pytest.approx([7.0, 3.0, 3.0, 1.0], rel=0.08)


def test_errors_without_a_known_offset() -> None:
    errors = calibration_errors(gtsam.Pose3(), 0.1, GroundTruth(gtsam.Pose3(), None), np.eye(7))
    assert errors.time_offset_s is None
    assert errors.nees is not None and errors.nees.time_offset is None and errors.nees.joint == 0.0


def test_time_error_is_estimate_minus_truth() -> None:
    assert calibration_errors(
        gtsam.Pose3(), 0.11, GroundTruth(gtsam.Pose3(), 0.1)
    ).time_offset_s == pytest.approx(0.01)


def test_a_truth_with_an_error_of_its_own_counts_in_the_nees() -> None:
    """Each part by hand: e^2 / (sigma^2 + sigma_truth^2)."""
    truth = GroundTruth(gtsam.Pose3(gtsam.Rot3.Rz(0.02), np.array([0.0, 0.0, 0.03])), 0.004)
    covariance = np.diag([0.01**2] * 3 + [0.01**2] * 3 + [0.002**2])
    sigma = TruthSigma(np.degrees(0.02), 0.02, 0.001)
    errors = calibration_errors(gtsam.Pose3(), 0.0, truth, covariance, sigma)
    assert errors.nees is not None
    assert errors.nees.rotation == pytest.approx(0.02**2 / (0.01**2 + 0.02**2), rel=1e-6)
    assert errors.nees.translation == pytest.approx(0.03**2 / (0.01**2 + 0.02**2), rel=1e-3)
    assert errors.nees.time_offset == pytest.approx(0.004**2 / (0.002**2 + 0.001**2), rel=1e-6)


@pytest.mark.parametrize(
    "sigmas", [(-0.1, 0.0, 0.0), (0.0, np.nan, 0.0), (0.0, 0.0, np.inf), (1e308, 0.0, 0.0)]
)
def test_a_truth_sigma_out_of_range_is_refused(sigmas: tuple[float, float, float]) -> None:
    with pytest.raises(DataError, match="truth sigma"):
        TruthSigma(*sigmas)
