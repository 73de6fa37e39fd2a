"""The wrapper turns what crashes or poisons gtsam into errors."""

from __future__ import annotations

import gc
import weakref

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, custom_factor

UNIT2 = gtsam.noiseModel.Unit.Create(2)
GOOD_H = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


def factor_over(error, H):
    return custom_factor(UNIT2, [7], lambda x, *, jacobians: (error, H), [3], 2)


def values3():
    values = gtsam.Values()
    values.insert(7, np.array([1.0, 2.0, 3.0]))
    return values


def test_error_and_jacobian_reach_gtsam():
    factor = custom_factor(
        UNIT2, [7], lambda x, *, jacobians: (GOOD_H @ x, [GOOD_H] if jacobians else None), [3], 2
    )
    assert factor.error(values3()) == pytest.approx(0.5 * (1.0 + 16.0))
    A, b = factor.linearize(values3()).jacobian()
    np.testing.assert_array_equal(A, GOOD_H)
    np.testing.assert_array_equal(b, [-1.0, -4.0])


@pytest.mark.parametrize(
    ("error", "H", "found"),
    [
        (np.zeros(2), None, "None"),
        (np.zeros(2), [], "0"),
        (np.zeros(2), [GOOD_H, GOOD_H], "2"),
        (np.zeros(2), [np.zeros(3)], r"\(3,\)"),
        (np.zeros(2), [np.zeros((3, 3))], r"\(3, 3\)"),
        (np.zeros(2), [np.zeros((2, 2))], r"\(2, 2\)"),
        (np.zeros(2), [np.full((2, 3), np.nan)], "NaN"),
        (np.zeros(3), [GOOD_H], r"\(3,\)"),
        (np.zeros((2, 1)), [GOOD_H], r"\(2, 1\)"),
        (np.array([np.inf, 0.0]), [GOOD_H], "inf"),
    ],
)
def test_bad_callbacks_raise(error, H, found):
    with pytest.raises(FactorError, match=found):
        factor_over(error, H).linearize(values3())


@pytest.mark.parametrize(
    ("noise", "keys", "dims"),
    [
        (gtsam.noiseModel.Unit.Create(3), [7], [3]),
        (UNIT2, [7, 7], [3, 3]),
        (UNIT2, [], []),
        (UNIT2, [7], [3, 3]),
    ],
)
def test_bad_arguments_raise(noise, keys, dims):
    with pytest.raises(FactorError, match="expected"):
        custom_factor(noise, keys, lambda *x, jacobians: (np.zeros(2), None), dims, 2)


def test_wrong_values_raise():
    factor = factor_over(np.zeros(2), [GOOD_H])
    with pytest.raises(FactorError, match="no such variable"):
        factor.error(gtsam.Values())
    wrong = gtsam.Values()
    wrong.insert(7, np.zeros(4))
    with pytest.raises(FactorError, match=r"Vector\(4\), expected a type of tangent dimension 3"):
        factor.error(wrong)
    wrong = gtsam.Values()
    wrong.insert(7, gtsam.Pose3())
    with pytest.raises(FactorError, match="Pose3, dimension 6"):
        factor.error(wrong)


def test_poses_and_twists_are_told_apart():
    seen = []

    def function(pose, twist, rotation, *, jacobians):
        seen.extend([pose, twist, rotation])
        return np.zeros(2), None

    factor = custom_factor(UNIT2, [1, 2, 3], function, [6, 6, 3], 2)
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3())
    values.insert(2, np.arange(6.0))
    values.insert(3, gtsam.Rot3())
    factor.error(values)
    assert isinstance(seen[0], gtsam.Pose3)
    np.testing.assert_array_equal(seen[1], np.arange(6.0))
    assert isinstance(seen[2], gtsam.Rot3)


def test_an_error_passes_through_the_optimizer():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor_over(np.array([np.nan, 0.0]), [GOOD_H]))
    with pytest.raises(FactorError, match="NaN"):
        gtsam.LevenbergMarquardtOptimizer(graph, values3()).optimize()


def test_the_data_is_freed_with_the_factor():
    class Data:
        H = GOOD_H

    def build(data):
        return custom_factor(UNIT2, [7], lambda x, *, jacobians: (data.H @ x, [data.H]), [3], 2)

    data = Data()
    alive = weakref.ref(data)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(build(data))
    graph.linearize(values3())
    del data
    gc.collect()
    assert alive() is not None
    del graph
    gc.collect()
    assert alive() is None


@pytest.mark.parametrize(
    ("error", "H", "found"),
    [
        (np.zeros(2, complex), [GOOD_H], "complex128"),
        (np.ma.array([1.0, 2.0], mask=[False, True]), [GOOD_H], "1 masked value"),
        (np.array(["1", "2"]), [GOOD_H], "<U1"),
        (np.array([True, False]), [GOOD_H], "bool"),
        (np.zeros(2), [GOOD_H + 0j], "complex128"),
        (np.zeros(2), (GOOD_H for _ in range(1)), "a generator"),
        (np.zeros(2), {7: GOOD_H}, "a dict"),
        (np.zeros(2), 3.0, "3.0"),
    ],
)
def test_what_is_no_number_and_no_list_of_jacobians_is_refused(error, H, found):
    """A complex array would lose a part, a masked one its mask, in silence."""
    with pytest.raises(FactorError) as raised:
        factor_over(error, H).linearize(values3())
    assert found in str(raised.value)


@pytest.mark.parametrize("pair", [None, 3.0, np.zeros(2), (np.zeros(2),), (np.zeros(2), [GOOD_H], 1)])
def test_a_function_returns_error_and_jacobians(pair):
    factor = custom_factor(UNIT2, [7], lambda x, *, jacobians: pair, [3], 2)
    with pytest.raises(FactorError, match="returns: found"):
        factor.linearize(values3())


@pytest.mark.parametrize("function", [lambda x: 1, lambda x, y, *, jacobians: 1, lambda: 1])
def test_a_function_takes_a_value_for_each_key_and_jacobians(function):
    with pytest.raises(FactorError, match=r"function of a factor: found one with the arguments \("):
        custom_factor(UNIT2, [7], function, [3], 2)
