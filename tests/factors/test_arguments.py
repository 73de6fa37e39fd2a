"""What counts as a covariance."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.factors.arguments import checked_covariance
from sst_graph.factors.errors import FactorError


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
