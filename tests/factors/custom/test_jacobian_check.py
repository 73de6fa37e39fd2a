"""The checker passes right derivatives and names wrong ones."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, check_gradient, check_jacobians, custom_factor

KEYS = [gtsam.symbol("x", 0), gtsam.symbol("e", 3)]


def values():
    result = gtsam.Values()
    result.insert(KEYS[0], np.array([0.3, -0.7]))
    result.insert(KEYS[1], gtsam.Pose3.Expmap(np.full(6, 0.2)))
    result.insert(gtsam.symbol("z", 9), np.ones(4))  # not the factor's
    return result


def factor_with(wrong=0.0):
    """[x0^2, x1 tx] with an error of ``wrong`` in the derivative by x1."""

    def function(x, pose, *, jacobians):
        t = pose.translation()
        H_pose = np.zeros((2, 6))
        H_pose[1, 3:] = x[1] * pose.rotation().matrix()[0]
        H_x = np.array([[2.0 * x[0], 0.0], [0.0, t[0] * (1.0 + wrong)]])
        return np.array([x[0] ** 2, x[1] * t[0]]), [H_x, H_pose] if jacobians else None

    return custom_factor(gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 2.0])), KEYS, function, [2, 6], 2)


def test_right_derivatives_pass_to_many_digits():
    for check in (check_jacobians, check_gradient):
        report = check(factor_with(), values())
        assert report.ok
        assert report.error < 1e-9
        assert [block.key for block in report.blocks] == KEYS


def test_a_wrong_derivative_is_named():
    with pytest.raises(FactorError, match=r"by x0: relative error .* row 1, column 1") as caught:
        check_jacobians(factor_with(wrong=1e-3), values())
    assert "by e3" in str(caught.value)
    with pytest.raises(FactorError, match="gradient"):
        check_gradient(factor_with(wrong=1e-3), values())


def test_the_tolerance_decides():
    assert check_jacobians(factor_with(wrong=1e-7), values(), tolerance=1e-6).ok
    with pytest.raises(FactorError, match=r"1.0e-08"):
        check_jacobians(factor_with(wrong=1e-6), values(), tolerance=1e-8)


def test_gtsams_own_factors_pass():
    pose = gtsam.PriorFactorPose3(KEYS[1], gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.3))
    check_jacobians(pose, values())
    check_gradient(pose, values())
