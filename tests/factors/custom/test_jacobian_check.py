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


def test_the_error_is_relative_to_the_greatest_entry_of_its_block():
    # [x0^2, x1 tx] by x0, x1, whitened by 0.1 and 2: greatest entry 2 |x0| / 0.1 = 6, wrong by 1e-3 tx / 2
    at = values()
    report = check_jacobians(factor_with(wrong=1e-3), at, tolerance=1.0)
    tx = at.atPose3(KEYS[1]).translation()[0]
    assert report.blocks[0].error == pytest.approx(1e-3 * tx / 2.0 / 6.0, rel=1e-6)
    assert report.error == report.blocks[0].error > report.blocks[1].error
    assert report.tolerance == 1.0
    with pytest.raises(FactorError):
        check_jacobians(factor_with(wrong=1e-3), at, tolerance=0.999 * report.error)
    assert check_jacobians(factor_with(wrong=1e-3), at, tolerance=1.001 * report.error).ok


def polynomial(power, slope, keys=1):
    """x^power with the derivative ``slope``, by ``keys`` variables of which the first alone counts."""

    def function(*xs, jacobians):
        H = [np.array([[slope(xs[0][0])]]), *[np.full((1, 1), 1e-9)] * (keys - 1)]
        return xs[0] ** power, H if jacobians else None

    return custom_factor(gtsam.noiseModel.Unit.Create(1), list(range(keys)), function, [1] * keys, 1)


def test_extrapolation_is_exact_for_polynomials_of_degree_six():
    at = gtsam.Values()
    at.insert(0, np.array([1.3]))
    for power in (1, 4, 6):
        report = check_jacobians(polynomial(power, lambda x, p=power: p * x ** (p - 1)), at, 1e-11, step=0.1)
        assert report.ok and report.blocks[0].numerical.shape == (1, 1)
    with pytest.raises(FactorError):  # of x^7 the error is 7! / 7! (h^6 / 64) = 1.6e-8 of a slope of 34
        check_jacobians(polynomial(7, lambda x: 7 * x**6), at, 1e-10, step=0.1)


def test_a_block_of_zeros_is_measured_by_the_factors_greatest_entry():
    at = gtsam.Values()
    at.insert(0, np.array([1.0]))
    at.insert(1, np.array([1.0]))
    report = check_jacobians(polynomial(2, lambda x: 2.0 * x, keys=2), at, tolerance=1.0)
    # wrong by 1e-9 against 1e-6 times the greatest entry, 2
    assert report.blocks[1].error == pytest.approx(1e-9 / 2e-6, rel=1e-3)
