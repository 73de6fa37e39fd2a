"""Camera models against OpenCV, gtsam, equations of the papers, and their own inverse."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
import pytest

from sst_graph.cameras import BrownConradyCamera, CameraModel, DoubleSphereCamera, FisheyeCamera
from sst_graph.errors import ConfigError
from sst_graph.factors.camera import PinholeCamera

K = PinholeCamera(400.0, 410.0, 503.0, 378.0, 1000, 760)
BROWN_CONRADY = [
    (),
    (-0.28, 0.07, 0.0002, 1e-5),
    (-0.3, 0.0, 0.0, 0.0, 0.0),
    (-0.3, 0.05, 0.001, -0.002, 0.01),
    (0.1, -0.2, 0.001, 0.002, 0.05, 0.2, -0.1, 0.03),
    (0.1, -0.2, 0.001, 0.002, 0.05, 0.2, -0.1, 0.03, 0.001, 0.002, -0.001, 0.0005),
]
FISHEYES = [(0.0, 0.0, 0.0, 0.0), (0.02, -0.01, 0.003, -0.001), (-0.05, 0.01, 0.0, 0.0)]
SPHERES = [(0.3, 0.6), (-0.2, 0.55), (-0.18, 0.59), (-0.2, 0.3), (0.0, 0.0), (0.5, 0.5)]
MODELS: list[CameraModel] = [
    *(BrownConradyCamera(K, c) for c in BROWN_CONRADY),
    *(FisheyeCamera(K, c) for c in FISHEYES),
    FisheyeCamera(K, FISHEYES[1], 190.0),
    *(DoubleSphereCamera(K, xi, alpha) for xi, alpha in SPHERES),
]


def points(widest_deg: float = 180.0, n: int = 4000) -> np.ndarray:
    """Points in all directions up to an angle from the axis, 0.5 to 50 m away."""
    rng = np.random.default_rng(1)
    theta = np.deg2rad(rng.uniform(0.0, widest_deg, n))
    phi = rng.uniform(-np.pi, np.pi, n)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return np.asarray(rays * rng.uniform(0.5, 50.0, (n, 1)))


@pytest.mark.parametrize("coefficients", BROWN_CONRADY)
def test_brown_conrady_is_opencvs(coefficients: tuple[float, ...]) -> None:
    cPs = points(60.0)
    uvs, valid = BrownConradyCamera(K, coefficients).project(cPs)
    D = np.array(coefficients) if coefficients else np.zeros(4)
    known = cv2.projectPoints(cPs[valid], np.zeros(3), np.zeros(3), K.matrix, D)[0].reshape(-1, 2)
    np.testing.assert_allclose(uvs[valid], known, rtol=0.0, atol=1e-9)
    assert valid.mean() > 0.6


def test_no_distortion_is_the_pinhole() -> None:
    cPs = points()
    uvs, valid = BrownConradyCamera(K).project(cPs)
    near = np.hypot(cPs[:, 0], cPs[:, 1]) < 50.0 * cPs[:, 2]
    np.testing.assert_allclose(uvs[near], K.project(cPs)[near], atol=1e-9)
    assert valid[near & K.in_front(cPs)].all() and not valid[cPs[:, 2] < 0.0].any()


@pytest.mark.parametrize("coefficients", FISHEYES)
def test_fisheye_is_opencvs_and_gtsams(coefficients: tuple[float, ...]) -> None:
    cPs = points(85.0)
    uvs, valid = FisheyeCamera(K, coefficients).project(cPs)
    D = np.array(coefficients)
    known = cv2.fisheye.projectPoints(cPs.reshape(-1, 1, 3), np.zeros((3, 1)), np.zeros((3, 1)), K.matrix, D)
    np.testing.assert_allclose(uvs, np.asarray(known[0]).reshape(-1, 2), rtol=0.0, atol=1e-9)
    assert valid.all()
    calibration = gtsam.Cal3Fisheye(K.fx, K.fy, 0.0, K.cx, K.cy, *coefficients)
    for cP, uv in zip(cPs[:50], uvs, strict=False):
        np.testing.assert_allclose(calibration.uncalibrate(cP[:2] / cP[2]), uv, atol=1e-9)


def test_fisheye_beyond_the_image_plane() -> None:
    """An ideal one by hand: 100 degrees to the right are f theta from the centre."""
    theta = np.deg2rad(100.0)
    ray = np.array([[np.sin(theta), 0.0, np.cos(theta)]])
    uvs, valid = FisheyeCamera(K).project(3.0 * ray)
    np.testing.assert_allclose(uvs, [[K.cx + K.fx * theta, K.cy]], atol=1e-12)
    assert valid.all()
    assert not FisheyeCamera(K, field_of_view_deg=190.0).project(3.0 * ray)[1].any()


@pytest.mark.parametrize(("xi", "alpha"), SPHERES)
def test_double_sphere_is_two_spheres_and_a_plane(xi: float, alpha: float) -> None:
    """As the paper draws it: to the first sphere, from its shifted centre to the second, then to the plane
    from alpha/(1 - alpha) behind that."""
    cPs = points(85.0)
    on_first = cPs / np.linalg.norm(cPs, axis=1)[:, None] + np.array([0.0, 0.0, xi])
    on_second = on_first / np.linalg.norm(on_first, axis=1)[:, None]
    seen = on_second + np.array([0.0, 0.0, alpha / (1.0 - alpha)])
    # The image plane's scale: fx stands for the paper's f_x, in units of 1 / (1 - alpha).
    known = seen[:, :2] / seen[:, 2:] / (1.0 - alpha) * [K.fx, K.fy] + [K.cx, K.cy]
    uvs, valid = DoubleSphereCamera(K, xi, alpha).project(cPs)
    np.testing.assert_allclose(uvs[valid], known[valid], rtol=1e-12, atol=1e-9)
    assert valid.mean() > 0.9


def test_double_sphere_without_shift_is_the_unified_model_of_gtsam() -> None:
    """xi = 0 is the unified camera; gtsam's has alpha = xi_u / (1 + xi_u), f = f_u / (1 + xi_u)."""
    alpha = 0.55
    xi_u = alpha / (1.0 - alpha)
    calibration = gtsam.Cal3Unified(
        K.fx * (1.0 + xi_u), K.fy * (1.0 + xi_u), 0.0, K.cx, K.cy, 0.0, 0.0, 0.0, 0.0, xi_u
    )
    cPs = points(80.0, 100)
    uvs, valid = DoubleSphereCamera(K, 0.0, alpha).project(cPs)
    assert valid.all()
    for cP, uv in zip(cPs, uvs, strict=True):
        np.testing.assert_allclose(calibration.uncalibrate(cP[:2] / cP[2]), uv, atol=1e-8)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.name}-{MODELS.index(m)}")
def test_rays_of_projected_points(model: CameraModel) -> None:
    cPs = points(180.0, 20_000)
    uvs, valid = model.project(cPs)
    rays, known = model.unproject(uvs[valid])
    assert known.all()
    directions = cPs[valid] / np.linalg.norm(cPs[valid], axis=1)[:, None]
    np.testing.assert_allclose(rays, directions, rtol=0.0, atol=1e-9)
    assert np.isnan(uvs[~valid]).all() and valid.mean() > 0.1


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.name}-{MODELS.index(m)}")
def test_pixels_of_rays(model: CameraModel) -> None:
    """No pixel has a ray that falls elsewhere, on the image and far off it."""
    rng = np.random.default_rng(2)
    uvs = rng.uniform([-1500.0, -1500.0], [2500.0, 2500.0], (20_000, 2))
    rays, valid = model.unproject(uvs)
    again, seen = model.project(3.0 * rays[valid])
    assert seen.all() and valid.any() and np.isnan(rays[~valid]).all()
    np.testing.assert_allclose(again, uvs[valid], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(rays[valid], axis=1), 1.0, atol=1e-12)


def test_the_radius_where_plumb_bob_turns_back() -> None:
    """k1 alone: r + k1 r^3 is greatest at r = 1/sqrt(-3 k1)."""
    model = BrownConradyCamera(K, (-0.3, 0.0, 0.0, 0.0))
    most = 1.0 / np.sqrt(0.9)
    assert model.largest_radius == pytest.approx(most, abs=1e-12)
    cPs = np.array([[most - 1e-6, 0.0, 1.0], [most + 1e-6, 0.0, 1.0], [2.0, 0.0, 1.0]])
    _, valid = model.project(cPs)
    assert valid.tolist() == [True, False, False]
    rim = K.cx + K.fx * most * (1.0 - 0.3 * most**2)
    assert model.unproject(np.array([[rim - 1e-3, K.cy], [rim + 1e-3, K.cy]]))[1].tolist() == [True, False]
    assert BrownConradyCamera(K, (0.1, 0.0, 0.0, 0.0)).largest_radius == np.inf


def test_a_rational_model_ends_at_its_pole() -> None:
    """1 / (1 - s / 4): at r = 2 the image is at infinity."""
    model = BrownConradyCamera(K, (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0))
    assert model.largest_radius == pytest.approx(2.0, abs=1e-12)
    assert model.project(np.array([[1.9, 0.0, 1.0], [2.1, 0.0, 1.0]]))[1].tolist() == [True, False]


def test_a_fisheye_polynomial_that_turns_back_ends_the_field() -> None:
    """theta - theta^3 / 6 is greatest at sqrt(2)."""
    model = FisheyeCamera(K, (-1.0 / 6.0, 0.0, 0.0, 0.0))
    assert model.largest_angle == pytest.approx(np.sqrt(2.0), abs=1e-12)


def test_the_field_of_the_double_sphere() -> None:
    """z > -w2 d with w1 and w2 of the paper's eq. 43 to 45."""
    model = DoubleSphereCamera(K, -0.2, 0.6)
    w1 = 0.4 / 0.6
    w2 = (w1 - 0.2) / np.sqrt(2.0 * w1 * -0.2 + 0.04 + 1.0)
    end = np.arccos(-w2)
    for angle, inside in ((end - 1e-6, True), (end + 1e-6, False)):
        ray = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
        assert bool(model.project(5.0 * ray)[1][0]) is inside


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.name}-{MODELS.index(m)}")
def test_resolution_at_the_axis(model: CameraModel) -> None:
    small = 1e-5
    uvs, _ = model.project(10.0 * np.array([[small, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    assert (uvs[0, 0] - uvs[1, 0]) / small == pytest.approx(model.axis_scale * K.fx, rel=1e-2)


def test_bad_models() -> None:
    with pytest.raises(ConfigError, match="6 distortion coefficients"):
        BrownConradyCamera(K, (0.0,) * 6)
    with pytest.raises(ConfigError, match="expected k1 k2 k3 k4"):
        FisheyeCamera(K, (0.0,))
    with pytest.raises(ConfigError, match="field of view"):
        FisheyeCamera(K, field_of_view_deg=400.0)
    with pytest.raises(ConfigError, match="xi = 2"):
        DoubleSphereCamera(K, 2.0, 0.5)
