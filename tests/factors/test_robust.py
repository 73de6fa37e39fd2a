"""Robust kernels against gtsam's own."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, RobustKernel

X = np.linspace(-12.0, 12.0, 401)
ESTIMATORS = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
}


@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("scale", [0.7, 3.0])
def test_same_as_gtsam(kind, scale):
    kernel, estimator = RobustKernel(kind, scale), ESTIMATORS[kind].Create(scale)
    np.testing.assert_allclose(kernel.loss(X), [estimator.loss(x) for x in X], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(kernel.weight(X), [estimator.weight(x) for x in X], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("kind", ["none", *ESTIMATORS])
def test_weight_is_the_slope_over_x_and_the_slack_is_not_negative(kind):
    kernel, h = RobustKernel(kind, 2.0), 1e-5
    x = X[np.abs(X) > 1e-3] + 1e-4
    slope = (kernel.loss(x + h) - kernel.loss(x - h)) / (2.0 * h)
    np.testing.assert_allclose(kernel.weight(x) * x, slope, rtol=1e-6, atol=1e-8)
    assert (2.0 * kernel.loss(X) - kernel.weight(X) * X**2 >= -1e-12).all()


@pytest.mark.parametrize("kind", ["none", *ESTIMATORS])
def test_curvature_is_the_slope_of_the_slope(kind):
    kernel, h = RobustKernel(kind, 2.0), 1e-5
    x = X[np.abs(np.abs(X) - 2.0) > 1e-3]
    slopes = [kernel.weight(x + step) * (x + step) for step in (-h, h)]
    np.testing.assert_allclose(kernel.curvature(x), (slopes[1] - slopes[0]) / (2.0 * h), rtol=1e-6, atol=1e-8)


def test_least_squares_by_hand():
    assert RobustKernel().loss(3.0) == 4.5
    assert RobustKernel().weight(3.0) == 1.0
    assert RobustKernel("huber", 1.0).loss(3.0) == 2.5


@pytest.mark.parametrize(("kind", "scale"), [("hubert", 1.0), ("huber", 0.0), ("tukey", np.nan)])
def test_refuses_unknown_kinds_and_bad_scales(kind, scale):
    with pytest.raises(FactorError, match="expected"):
        RobustKernel(kind, scale)
