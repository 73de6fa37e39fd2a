"""The pinhole camera against gtsam's."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.factors import MIN_DEPTH_M, PinholeCamera

CAMERA = PinholeCamera(700.0, 710.0, 600.0, 180.0, 1242, 375)


def test_numbers_of_numpy_are_kept_as_plain_ones():
    camera = PinholeCamera(np.float16(700.0), np.array(710.0), 600, 180.0, np.int16(1242), np.uint16(375))
    assert camera == PinholeCamera(700.0, 710.0, 600.0, 180.0, 1242, 375) and hash(camera) == hash(CAMERA)
    assert [type(value) for value in vars(camera).values()] == 4 * [float] + 2 * [int]


def test_projects_as_gtsam_does():
    cPs = np.random.default_rng(0).uniform([-5, -2, 3], [5, 2, 40], (100, 3))
    oracle = gtsam.PinholeCameraCal3_S2(gtsam.Pose3(), gtsam.Cal3_S2(700.0, 710.0, 0.0, 600.0, 180.0))
    np.testing.assert_allclose(CAMERA.project(cPs), [oracle.project(cP) for cP in cPs], rtol=1e-12)


def test_right_is_right_and_down_is_down():
    u, v = CAMERA.project(np.array([[1.0, 2.0, 10.0]]))[0]
    assert (u, v) == (670.0, 322.0)


def test_behind_gives_nan():
    assert np.isnan(CAMERA.project(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 0.05]]))).all()


def test_borders_are_inside():
    uvs = np.array([[-0.5, -0.5], [1241.4, 374.4], [1241.5, 10.0], [10.0, 374.5], [-0.6, 5.0], [np.nan, 1.0]])
    assert CAMERA.in_image(uvs).tolist() == [True, True, False, False, False, False]


def test_derivative():
    cPs, h = np.random.default_rng(1).uniform([-5, -2, 3], [5, 2, 40], (100, 3)), 1e-5
    for axis in range(3):
        step = h * np.eye(3)[axis]
        numerical = (CAMERA.project(cPs + step) - CAMERA.project(cPs - step)) / (2.0 * h)
        np.testing.assert_allclose(CAMERA.uv_H_cP(cPs)[:, :, axis], numerical, rtol=1e-6, atol=1e-6)


def test_the_matrix_projects_as_well():
    cPs = np.random.default_rng(2).uniform([-5, -2, 3], [5, 2, 40], (20, 3))
    homogeneous = cPs @ CAMERA.matrix.T
    np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], CAMERA.project(cPs), rtol=1e-12)


def test_in_front_is_beyond_the_least_depth():
    cPs = np.array([[0.0, 0.0, MIN_DEPTH_M], [9.0, 9.0, MIN_DEPTH_M + 1e-9], [9.0, 9.0, -1.0]])
    assert CAMERA.in_front(cPs).tolist() == [False, True, False]
