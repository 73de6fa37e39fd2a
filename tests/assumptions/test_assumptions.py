"""Each assumption's effect against drives and cameras that break it by a known size."""

from __future__ import annotations

from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.assumptions.model import Scene
from sst_graph.experiments.assumptions import SIZES
from sst_graph.experiments.wrong_drives import WRONG
from sst_graph.factors.alignment import Alignment, residuals
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.nuisances import Deviation, residual_columns

FloatArray = NDArray[np.float64]

PAGE = Path(__file__).resolve().parents[2] / "docs" / "understand" / "assumptions.md"
CAMERA = PinholeCamera(700.0, 720.0, 610.0, 170.0, 1242, 375)
AXES = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
cTl = gtsam.Pose3(AXES * gtsam.Rot3.Expmap(np.array([0.01, -0.02, 0.03])), np.array([0.1, -0.3, -0.2]))
L_TWIST = np.array([0.02, -0.01, 0.1, 8.0, 0.3, -0.1])
C_TWIST = np.asarray(cTl.AdjointMap()) @ L_TWIST
SCENE = Scene(CAMERA, L_TWIST, 2.5, 0.1)
OFFSET_S, BASE_TAU_S = 0.07, 0.02


def alignment(lPs: FloatArray, offsets_s: FloatArray) -> Alignment:
    rng = np.random.default_rng(3)
    normals = rng.standard_normal((len(lPs), 2))
    return Alignment(
        camera=CAMERA,
        lPs=lPs,
        base_taus_s=BASE_TAU_S - offsets_s,
        pixels=rng.uniform([0, 0], [1242, 375], (len(lPs), 2)),
        sigmas_px=np.ones(len(lPs)),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
    )


def points(n: int = 40) -> FloatArray:
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(6, 40, n), rng.uniform(-5, 5, n), rng.uniform(-1.5, 0.5, n)])


def projected(a: Alignment, twist: FloatArray = C_TWIST) -> FloatArray:
    """(n, 2) pixels of the matches' points, by the factor's own residual with both axes."""
    both = Alignment(CAMERA, a.lPs, a.base_taus_s, np.zeros((len(a), 2)), 1.0)
    r, _ = residuals(both, cTl, OFFSET_S, twist)
    return r.reshape(2, -1).T


def truly_seen(name: str, theta: float, a: Alignment, offsets_s: FloatArray) -> FloatArray:
    """Residuals (n,) when the world breaks an assumption, from first principles."""
    lPs, taus, twist, camera = a.lPs.copy(), a.base_taus_s.copy(), C_TWIST, CAMERA
    ranges = np.linalg.norm(lPs, axis=1, keepdims=True)
    if name == "range_bias":
        lPs = lPs * (ranges + theta) / ranges
    if name == "range_scale":
        lPs = lPs * (1.0 + theta)
        twist = np.asarray(cTl.AdjointMap()) @ (L_TWIST * [1, 1, 1, 1 + theta, 1 + theta, 1 + theta])
    if name == "elevation":
        azimuth, across = np.arctan2(lPs[:, 1], lPs[:, 0]), np.hypot(lPs[:, 0], lPs[:, 1])
        raised = np.arctan2(lPs[:, 2], across) + theta
        ray = [np.cos(raised) * np.cos(azimuth), np.cos(raised) * np.sin(azimuth), np.sin(raised)]
        lPs = ranges * np.column_stack(ray)
    if name == "skew":
        taus = taus + theta * SCENE.image_s
    if name == "sweep":
        azimuth = np.degrees(np.arctan2(lPs[:, 1], lPs[:, 0]))
        taus = taus + theta * SCENE.period_s * azimuth / 360.0
    if name == "line_delay":
        taus = taus + theta * (projected(a)[:, 1] - 187.0)
    uvs = projected(Alignment(camera, lPs, taus, a.pixels, 1.0), twist)
    rays = (uvs - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if name in ("k1", "k2"):
        lens = np.array([theta, 0.0] if name == "k1" else [0.0, theta])
        cPs = np.column_stack([rays, np.ones(len(rays))])
        seen, _ = cv2.projectPoints(cPs, np.zeros(3), np.zeros(3), camera.matrix, np.append(lens, [0.0, 0.0]))
        uvs = seen.reshape(-1, 2)
    if name == "focal":
        uvs = rays * [camera.fx * (1 + theta), camera.fy * (1 + theta)] + [camera.cx, camera.cy]
    if name in ("cx", "cy"):
        uvs = uvs + theta * np.eye(2)[["cx", "cy"].index(name)]
    assert a.normals is not None
    return np.asarray(((uvs - a.pixels) * a.normals).sum(axis=1))


@pytest.mark.parametrize("name", ASSUMPTIONS)
def test_the_column_is_the_derivative_of_what_a_broken_assumption_shows(name: str) -> None:
    offsets = np.zeros(40)
    a, step = alignment(points(), offsets), 1e-5 * ASSUMPTIONS[name].span
    column = residual_columns(a, SCENE, offsets, (cTl, OFFSET_S, C_TWIST), [name])[name]
    plus, minus = (truly_seen(name, sign * step, a, offsets) for sign in (1.0, -1.0))
    np.testing.assert_allclose(column, (plus - minus) / (2.0 * step), rtol=2e-4, atol=1e-4)


def test_points_with_times_miss_a_share_of_them() -> None:
    offsets = np.linspace(-0.05, 0.05, 40)
    a = alignment(points(), offsets)
    column = residual_columns(a, SCENE, offsets, (cTl, OFFSET_S, C_TWIST), ["sweep"])["sweep"]
    later, _ = residuals(alignment(points(), 1.001 * offsets), cTl, OFFSET_S, C_TWIST)
    now, _ = residuals(a, cTl, OFFSET_S, C_TWIST)
    np.testing.assert_allclose(column, (later - now) / 0.001, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(("name", "theta"), [("k1", -0.1), ("k2", -0.05)])
def test_distortion_lays_no_point_from_beside_the_image_into_it(name: str, theta: float) -> None:
    """A polynomial of r turns round: with k1 = -0.1 a ray at r = 3.1 would be at the image's centre."""
    r = np.linspace(1.1, 6.0, 51)
    uvs = np.stack([CAMERA.cx + CAMERA.fx * r, np.full(51, CAMERA.cy)], axis=1)
    view = SCENE.view(np.zeros((51, 3)), np.zeros(51), uvs)
    shift = ASSUMPTIONS[name].effect(view).pixel_shift
    assert shift is not None
    assert (uvs[:, 0] + theta * shift[:, 0] > CAMERA.width).all()


def test_k2_is_to_be_estimated_with_k1() -> None:
    """With k1 at zero, k2 alone takes up a part of a lens of k1: of -0.1 on a street, 8 cm off and ok."""
    assert ASSUMPTIONS["k2"].remedy.endswith("--estimate k1,k2")
    assert ASSUMPTIONS["k1"].remedy.endswith("--estimate k1")


def test_several_parameters_add_up() -> None:
    lPs = points(5)
    uvs = np.tile([700.0, 200.0], (5, 1))
    both = Deviation({"cx": 2.0, "range_bias": 0.1, "cy": -1.0}, SCENE).effect(lPs, np.zeros(5), uvs)
    assert both.pixel_shift is not None and both.l_shift is not None and both.time_s is None
    np.testing.assert_allclose(both.pixel_shift, np.tile([2.0, -1.0], (5, 1)))
    np.testing.assert_allclose(np.linalg.norm(both.l_shift, axis=1), 0.1)


def test_some_of_the_points_keep_the_motion_of_their_image() -> None:
    """An effect may depend on the motion around each point's image."""
    twists, stamps_s = np.outer(np.arange(4.0), L_TWIST), np.arange(4.0)
    each = Deviation({"range_scale": 0.1}, Scene(CAMERA, twists, stamps_s, 0.1))
    some = each.take(np.array([3, 1]))
    np.testing.assert_array_equal(some.scene.l_twist, twists[[3, 1]])
    np.testing.assert_array_equal(some.scene.image_s, [3.0, 1.0])
    found = some.effect(points(2), np.zeros(2), np.zeros((2, 2))).twist_shift
    assert found is not None
    np.testing.assert_allclose(found[:, 3:], 0.1 * twists[[3, 1], 3:])


@pytest.mark.parametrize("name", ASSUMPTIONS)
def test_every_assumption_is_in_the_documented_table(name: str) -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert sum(f"`{name}`" in row.split("|")[1] for row in rows) == 1


def test_every_assumption_that_matches_test_can_be_broken_on_purpose() -> None:
    tested = {name for name, assumption in ASSUMPTIONS.items() if assumption.by_matches}
    assert set(SIZES) == tested
    assert set(WRONG) == tested - {"line_delay"}  # its pictures are drawn anew


@pytest.mark.parametrize("name", ASSUMPTIONS)
def test_every_assumption_has_violation_remedy_and_source(name: str) -> None:
    assumption = ASSUMPTIONS[name]
    assert assumption.name == name and assumption.violation and assumption.remedy and assumption.source
    assert 0.0 < assumption.sigma < assumption.span
    assert assumption.figure(0.01234, 0.004).startswith(f"{name} = 0.0123 ± 0.004")


def test_an_estimate_contradicts_only_where_a_value_that_may_be_would() -> None:
    bias = ASSUMPTIONS["range_bias"]
    assert bias.contradicted_by(0.1, 0.02, 3.3) and bias.contradicted_by(-1.0, 0.15, 3.3)
    assert not bias.contradicted_by(0.1, 0.04, 3.3)
    assert not bias.contradicted_by(-1.56, 0.45, 3.3)
