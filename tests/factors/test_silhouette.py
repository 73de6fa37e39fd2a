"""The silhouette factor: sign, derivatives, and a circle's true distance as the oracle."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import Alignment, FactorError, PinholeCamera, check_jacobians, silhouette_factor

E, D, V, B = (gtsam.symbol(letter, 0) for letter in "edvb")
CAMERA = PinholeCamera(100.0, 100.0, 50.0, 40.0, 101, 81)


def test_outside_is_positive_and_a_dilated_mask_hides_more_of_it():
    # predicted at u = 60, contour at u = 57 with the outside to the right, mask dilated by 2 px: the
    # outline is at u = 55
    alignment = Alignment(CAMERA, [[1.0, 0.0, 10.0]], 0.0, [[57.0, 40.0]], 1.0, [[1.0, 0.0]])
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3())
    values.insert(B, np.array([2.0]))
    factor = silhouette_factor(alignment, E, bias_px=B, condensed=False)
    np.testing.assert_allclose(factor.unwhitenedError(values), [5.0, 0.0], atol=1e-12)
    assert silhouette_factor(alignment, E, bias_px=2.0).error(values) == pytest.approx(12.5)
    assert silhouette_factor(alignment, E).error(values) == pytest.approx(4.5)


def test_jacobians_at_100_states(make_scene):
    for seed in range(100):
        alignment, cTl, offset_s, twist = make_scene(seed, 4, normals=True, per_point=bool(seed % 2))
        values = gtsam.Values()
        values.insert(E, cTl.retract(np.full(6, 0.01)))
        values.insert(D, np.array([offset_s + 0.01]))
        values.insert(V, twist)
        values.insert(B, np.array([0.4]))
        check_jacobians(silhouette_factor(alignment, E, D, V, B, condensed=False), values, 1e-6)


def test_distance_to_a_circle():
    # nearest contour points and normals of a circular mask: the factor's error is |uv - centre| - radius
    rng, centre, radius = np.random.default_rng(0), np.array([50.0, 40.0]), 20.0
    lPs = rng.uniform([-4, -3, 8], [4, 3, 12], (50, 3))
    outward = CAMERA.project(lPs) - centre
    distance = np.linalg.norm(outward, axis=1)
    normals = outward / distance[:, None]
    alignment = Alignment(CAMERA, lPs, 0.0, centre + radius * normals, 1.0, normals)
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3())
    error = silhouette_factor(alignment, E, condensed=False).unwhitenedError(values)
    np.testing.assert_allclose(error[:-1], distance - radius, atol=1e-9)


def test_needs_normals(make_scene):
    with pytest.raises(FactorError, match="no normals"):
        silhouette_factor(make_scene(0)[0], E)
