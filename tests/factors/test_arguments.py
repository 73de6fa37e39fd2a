"""What counts as an array, a positive number, a covariance; how a message is made printable."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors.arguments import (
    checked_array,
    checked_covariance,
    checked_positive,
    checked_rows,
    described,
)
from sst_graph.factors.errors import FactorError, SstGraphError, printable


def test_rounding_is_no_asymmetry() -> None:
    covariance = np.diag([1e-8, 1e-6])
    covariance[0, 1] = 1e-25
    np.testing.assert_array_equal(checked_covariance("covariance", covariance, 2), covariance)


@pytest.mark.parametrize(
    ("covariance", "found"),
    [
        ([[1e-8, 1e-12], [0.0, 1e-6]], "unsymmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "eigenvalue -1"),
        ([[0.0, 0.0], [0.0, 1.0]], "eigenvalue 0"),
        ([[1.0]], r"shape \(1, 1\)"),
        ([[np.nan, 0.0], [0.0, 1.0]], "NaN"),
    ],
)
def test_refuses_what_is_none(covariance: list[list[float]], found: str) -> None:
    with pytest.raises(FactorError, match=found):
        checked_covariance("covariance", covariance, 2)


@pytest.mark.parametrize(("share", "symmetric"), [(0.9e-6, True), (1.1e-6, False)])
def test_asymmetry_counts_beside_the_sigmas(share: float, symmetric: bool) -> None:
    covariance = np.diag([4.0, 25.0])
    covariance[0, 1] = share * 2.0 * 5.0
    if symmetric:
        assert not checked_covariance("covariance", covariance, 2).flags.writeable
    else:
        with pytest.raises(FactorError, match="unsymmetric"):
            checked_covariance("covariance", covariance, 2)


def test_an_array_is_a_read_only_copy_of_its_shape() -> None:
    given = np.ones((2, 3), np.float32)
    array = checked_array("x", given, (None, 3))
    assert array.dtype == np.float64 and not array.flags.writeable
    given[:] = 2.0
    assert (array == 1.0).all()
    assert checked_array("x", np.zeros((0, 3)), (None, 3)).shape == (0, 3)
    for wrong in (np.ones((2, 2)), np.ones(3), "abc", [[1.0, None, 2.0]], [[1.0, np.inf, 0.0]]):
        with pytest.raises(FactorError):
            checked_array("x", wrong, (None, 3))  # type: ignore[arg-type]


def test_a_mask_is_not_read_through() -> None:
    hidden = np.ma.masked_array(np.ones((2, 3)), mask=[[False, True, False], [True, False, False]])
    with pytest.raises(FactorError, match="found 2 masked values"):
        checked_array("x", hidden, (None, 3))
    with pytest.raises(FactorError, match="found 2 masked values"):
        checked_rows("x", hidden, 3)
    assert type(checked_rows("x", np.ma.masked_array(np.ones((2, 3))), 3)) is np.ndarray


@pytest.mark.parametrize("value", [1e-300, 1, np.float32(2.0), np.int64(3)])
def test_positive_numbers(value: float) -> None:
    found = checked_positive("x", value)
    assert type(found) is float and found == value


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan, True, "1", None, np.ones(1)])
def test_no_positive_numbers(value: object) -> None:
    with pytest.raises(FactorError, match="a finite number above 0"):
        checked_positive("x", value)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "word"),
    [
        (np.ones((2, 3)), "an array of shape (2, 3)"),
        (None, "None"),
        (1.5, "1.5"),
        (True, "True"),
        ([1, 2], "a list of 2"),
        ("abc", "the text 'abc'"),
        (np.float64(1.5), "1.5"),
        (10**50, "an int of more than 40 digits"),
        (gtsam.noiseModel.Isotropic.Sigma(1, 2.0), "an Isotropic"),
        (gtsam.noiseModel.Unit.Create(1), "a Unit"),
        (gtsam.Pose3, "the class Pose3"),
    ],
)
def test_a_value_in_short(value: object, word: str) -> None:
    assert described(value) == word


def test_messages_hold_no_control_characters_and_are_short() -> None:
    assert printable("a\x1b[31m\n\ud800b") == "a\\x1b[31m\\n\\ud800b"
    long = printable("a" * 50 + "b" * 50, 41)
    assert long == "a" * 24 + " ... " + "b" * 12
    assert printable("a" * 41, 41) == "a" * 41
    assert len(printable("\x1b" * 41, 41)) == 41
    assert str(SstGraphError("one\n  two\tthree")) == "one two three"
    assert str(SstGraphError()) == ""
