"""The joint covariance of cameras by the errors that they have in common, in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.covariance.shared_errors import FEWEST, SharedErrors
from sst_graph.rig.influences import KINDS, CameraInfluences, Influence, _of_names
from sst_graph.rig.joint_covariance import joint_covariance

NAMES = np.arange(40)


def _camera(
    seed: int,
    names: NDArray[np.int64] = NAMES,
    means: NDArray[np.float64] | None = None,
    motion: float = 0.0,
    assumption: float = 0.0,
) -> CameraInfluences:
    """A camera whose only errors are those of the sides of some objects, the motion and an assumption."""
    rng = np.random.default_rng(seed)
    steps = 1e-3 * rng.standard_normal((len(names), 7))
    found = rng.standard_normal(len(names)) if means is None else means
    nothing = Influence(np.zeros(0, np.int64), np.zeros((0, 7)), np.zeros(0), np.zeros(0))
    side = Influence(names, steps, found, np.ones(len(names)))
    return CameraInfluences(
        {kind: side if kind == "side" else nothing for kind in KINDS},
        np.zeros(0, np.int64),
        np.zeros((0, 7)),
        np.array([3]),
        motion * np.ones((1, 7, 6)),
        {"range_bias": assumption * np.ones(7)},
    )


def _covariance(camera: CameraInfluences) -> NDArray[np.float64]:
    steps, motion = camera.matches["side"].steps, camera.motion[0]
    own = steps.T @ steps + motion @ motion.T + sum(np.outer(s, s) for s in camera.assumptions.values())
    return np.asarray(own + 1e-9 * np.eye(7))


def _joint(*cameras: CameraInfluences) -> tuple[NDArray[np.float64], float]:
    found = joint_covariance([_covariance(camera) for camera in cameras], cameras)
    return found.matrix, found.correlations["side"]


def test_errors_that_are_the_same_in_both() -> None:
    means = np.random.default_rng(9).standard_normal(40)
    one, other = _camera(1, means=means), _camera(2, means=2.0 * means)
    matrix, rho = _joint(one, other)
    assert rho == pytest.approx(1.0)
    expected = one.matches["side"].steps.T @ other.matches["side"].steps
    np.testing.assert_allclose(matrix[:7, 7:], expected, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(matrix[:7, :7], _covariance(one))
    np.testing.assert_allclose(matrix, matrix.T)


def test_errors_that_are_alike_in_part() -> None:
    """The residuals tell how far: half of their variance is in common."""
    rng = np.random.default_rng(3)
    names = np.arange(4000)
    common, own = rng.standard_normal(4000), rng.standard_normal((2, 4000))
    one, other = (_camera(k, names, common + own[k]) for k in range(2))
    matrix, rho = _joint(one, other)
    assert rho == pytest.approx(0.5, abs=0.05)
    expected = rho * one.matches["side"].steps.T @ other.matches["side"].steps
    np.testing.assert_allclose(matrix[:7, 7:], expected, rtol=1e-6, atol=1e-12)


def test_a_point_in_several_images_of_its_scan_is_one_error() -> None:
    """It moves the estimate by all of them, its residual is their weighted mean."""
    found = _of_names(
        np.array([7, 3, 7]),
        np.arange(21.0).reshape(3, 7),
        np.array([1.0, 5.0, 4.0]),
        np.array([2.0, 1.0, 1.0]),
    )
    np.testing.assert_array_equal(found.names, [3, 7])
    np.testing.assert_array_equal(found.steps, [np.arange(7.0, 14.0), np.arange(7.0) + np.arange(14.0, 21.0)])
    np.testing.assert_allclose(found.means, [5.0, 2.0])
    np.testing.assert_array_equal(found.weights, [1.0, 3.0])


def test_other_objects_are_independent() -> None:
    matrix, _ = _joint(_camera(1), _camera(2, NAMES + 100))
    assert not matrix[:7, 7:].any()


def test_half_samples_that_both_cameras_have() -> None:
    """By edges: the same objects move both estimates, and so do the LiDAR's errors; without samples in common
    only the latter are left."""
    rng = np.random.default_rng(4)
    steps, step = rng.standard_normal((16, 7)), np.arange(7.0)
    one = SharedErrors(steps, {"elevation": step, "own": step})
    other = SharedErrors(2.0 * steps, {"elevation": -step})
    own, its = one.cross_covariance(one), other.cross_covariance(other)
    objects = own - 2.0 * np.outer(step, step)
    matrix = joint_covariance([own, its], [one, other]).matrix
    np.testing.assert_allclose(matrix[:7, 7:], 2.0 * objects - np.outer(step, step), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(np.diag(objects), np.mean(steps**2, axis=0) * 16.0 / 8.0)
    few = SharedErrors(np.where(np.arange(16)[:, None] < 17 - FEWEST, np.nan, steps), other.common)
    assert few.estimated == FEWEST - 1
    np.testing.assert_allclose(one.cross_covariance(few), -np.outer(step, step))
    alone = joint_covariance([own, its], [one, None]).matrix
    assert not alone[:7, 7:].any()


def test_residuals_of_opposite_sign_are_no_negative_correlation() -> None:
    means = np.random.default_rng(9).standard_normal(40)
    _, rho = _joint(_camera(1, means=means), _camera(2, means=-means))
    assert rho == 0.0


def test_few_common_errors_count_as_the_same() -> None:
    _, rho = _joint(_camera(1, NAMES[:3]), _camera(2, NAMES[:3]))
    assert rho == 1.0


def test_motion_and_assumptions_of_the_lidar_are_shared() -> None:
    far = NAMES + 100
    matrix, _ = _joint(
        _camera(1, motion=1e-3, assumption=2e-3), _camera(2, far, motion=3e-3, assumption=1e-3)
    )
    np.testing.assert_allclose(matrix[:7, 7:], np.full((7, 7), 6 * 3e-6 + 2e-6), rtol=1e-6)


def test_errors_of_the_lidar_are_added_in_their_own_order() -> None:
    """To the last bit, in every process: sets of texts have an order that differs from run to run."""
    rng = np.random.default_rng(5)
    steps = {f"error {k}": 10.0 ** rng.uniform(-9, 0) * rng.standard_normal(7) for k in range(30)}
    in_order = np.zeros((7, 7))
    for step in steps.values():
        in_order += np.outer(step, step)
    nothing = np.full((FEWEST, 7), np.nan)
    by_edges = SharedErrors(nothing, steps)
    np.testing.assert_array_equal(by_edges.cross_covariance(by_edges), in_order)
    by_labels = replace(_camera(1), assumptions=steps)
    other = replace(_camera(2, NAMES + 100), assumptions=dict(reversed(steps.items())))
    found = joint_covariance([100.0 * np.eye(7)] * 2, [by_labels, other]).matrix
    np.testing.assert_array_equal(found[:7, 7:], in_order)


def test_a_camera_without_estimate_has_nothing_in_common() -> None:
    one = _camera(1)
    found = joint_covariance([_covariance(one), np.eye(7)], [one, None])
    assert not found.matrix[:7, 7:].any() and found.common == 0


def test_the_matrix_is_positive_where_the_parts_would_not_be() -> None:
    """Claimed covariances far below the influences: what is in common is scaled down."""
    means = np.random.default_rng(9).standard_normal(40)
    one, other = _camera(1, means=means), _camera(2, means=means)
    small = [0.1 * _covariance(camera) for camera in (one, other)]
    matrix = joint_covariance(small, [one, other]).matrix
    scale = 1.0 / np.sqrt(np.diag(matrix))
    assert np.linalg.eigvalsh(matrix * np.outer(scale, scale))[0] > 0.0
    np.testing.assert_allclose(matrix[:7, :7], small[0])
