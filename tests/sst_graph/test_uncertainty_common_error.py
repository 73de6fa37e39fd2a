"""The error that all contours of a picture share, in the covariance."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.camera import PinholeCamera
from sst_graph.config import with_overrides
from sst_graph.errors import ConfigError
from sst_graph.uncertainty.assumptions import AssumptionConfig
from sst_graph.uncertainty.common_error import common_covariance

CAMERA = PinholeCamera(700.0, 720.0, 600.0, 180.0, 1242, 375)
def shifted(sigma_px: float) -> AssumptionConfig:
    """A principal point with this deviation."""
    return with_overrides(AssumptionConfig(), [f"sigmas.cx={sigma_px}", f"sigmas.cy={sigma_px}"])


AXES = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
cTl = gtsam.Pose3(AXES, np.array([0.1, -0.3, -0.2]))


@pytest.mark.parametrize("axis", [0, 1])
def test_it_moves_the_middle_of_the_picture_by_its_sigma(axis: int) -> None:
    """Far along the optical axis, the covariance of a projected point is sigma squared in u and in v."""
    covariance = common_covariance(cTl, CAMERA, shifted(0.4))[:6, :6]
    lP = cTl.transformTo(np.array([0.0, 0.0, 500.0]))
    step, columns = 1e-6, []
    for i in range(6):
        moved = cTl.retract(step * np.eye(6)[i])
        places = [CAMERA.project(pose.transformFrom(lP)[None])[0] for pose in (cTl, moved)]
        columns.append((places[1] - places[0]) / step)
    J = np.array(columns).T
    assert (J @ covariance @ J.T)[axis, axis] == pytest.approx(0.4**2, rel=1e-3)
    assert (J @ covariance @ J.T)[0, 1] == pytest.approx(0.0, abs=1e-6)


def test_the_camera_turns_about_its_own_centre() -> None:
    """Its place in the LiDAR's frame stays as certain as it was."""
    covariance = common_covariance(cTl, CAMERA, shifted(0.4))[:6, :6]
    values, vectors = np.linalg.eigh(covariance)
    assert np.linalg.matrix_rank(covariance, tol=1e-9 * values[-1]) == 2
    centre = cTl.inverse().translation()
    for value, vector in zip(values[-2:], vectors[:, -2:].T, strict=True):
        moved = cTl.retract(1e-6 * vector / np.sqrt(value))
        np.testing.assert_allclose(moved.inverse().translation(), centre, atol=1e-8)


def test_the_time_offset_is_not_concerned_and_zero_turns_it_off() -> None:
    assert not common_covariance(cTl, CAMERA, AssumptionConfig())[6].any()
    assert not common_covariance(cTl, CAMERA, shifted(0.0)).any()


@pytest.mark.parametrize("sigma", [-0.1, float("nan"), float("inf")])
def test_a_sigma_out_of_range_is_refused(sigma: float) -> None:
    with pytest.raises(ConfigError, match=r"sigmas\.cx"):
        shifted(sigma)
