"""The known pose between two cameras: sign by hand, Jacobians, and gtsam's between factor as an oracle."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, camera_pose_factor, check_jacobians

B, C = gtsam.symbol("E", 0), gtsam.symbol("E", 1)
SIGMAS = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])


def _values(bTl: gtsam.Pose3, cTl: gtsam.Pose3) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(B, bTl)
    values.insert(C, cTl)
    return values


def _random(rng: np.random.Generator, size: float = 1.0) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(size * rng.standard_normal(6))


def test_a_right_camera_by_hand() -> None:
    """The right camera of a stereo rig sees the left one 0.5 m to the left; it is 0.1 m too near."""
    left = gtsam.Pose3()
    right = gtsam.Pose3(gtsam.Rot3(), np.array([-0.4, 0.0, 0.0]))
    known = gtsam.Pose3(gtsam.Rot3(), np.array([-0.5, 0.0, 0.0]))
    factor = camera_pose_factor(B, C, known, np.diag(SIGMAS**2))
    error = factor.unwhitenedError(_values(left, right))
    np.testing.assert_allclose(error, [0, 0, 0, 0.1, 0, 0], atol=1e-12)
    assert factor.error(_values(left, right)) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(4))
def test_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bTl, cTl = _random(rng), _random(rng)
    known = cTl * bTl.inverse() * _random(rng, 0.2)
    values = _values(bTl, cTl)
    report = check_jacobians(camera_pose_factor(B, C, known, np.diag(SIGMAS**2)), values)
    assert report.ok, report


@pytest.mark.parametrize("seed", range(4))
def test_as_gtsam_has_it_on_the_cameras_poses_in_the_lidar(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bTl, cTl, known = _random(rng), _random(rng), _random(rng)
    poses = gtsam.Values()
    poses.insert(B, bTl.inverse())
    poses.insert(C, cTl.inverse())
    between = gtsam.BetweenFactorPose3(C, B, known, gtsam.noiseModel.Diagonal.Sigmas(SIGMAS))
    ours = camera_pose_factor(B, C, known, np.diag(SIGMAS**2))
    assert ours.error(_values(bTl, cTl)) == pytest.approx(between.error(poses), rel=1e-9)


def test_a_covariance_that_is_none() -> None:
    with pytest.raises(FactorError, match="covariance of the camera's pose"):
        camera_pose_factor(B, C, gtsam.Pose3(), -np.eye(6))
