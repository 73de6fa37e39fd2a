"""What is considered of a parameter given the data, against its generative model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.covariance.broken_assumptions import Evidence, considered_sigmas

FloatArray = NDArray[np.float64]
K1 = Evidence(estimate=0.0, deviation=0.008, prior=0.001, span=0.3, prevalence=0.5)


def considered_sigma(estimate: float, **change: float) -> float:
    return considered_sigmas({"k1": dataclasses.replace(K1, estimate=estimate, **change)})["k1"]


@pytest.fixture(scope="module")
def drawn() -> tuple[FloatArray, FloatArray]:
    """Parameters and their estimates from the generative model."""
    rng = np.random.default_rng(3)
    n = 4_000_000
    taus = K1.prior * (K1.span / K1.prior) ** rng.uniform(size=n)
    broken = rng.uniform(size=n) < K1.prevalence
    thetas = np.where(broken, taus, K1.prior) * rng.standard_normal(n)
    return thetas, thetas + K1.deviation * rng.standard_normal(n)


@pytest.mark.parametrize("estimate", [0.0, 0.012, 0.03])
def test_the_mean_square_is_that_of_drawn_parameters(
    drawn: tuple[FloatArray, FloatArray], estimate: float
) -> None:
    thetas, seen = drawn
    alike = np.abs(seen - estimate) < 0.05 * K1.deviation
    assert considered_sigma(estimate) == pytest.approx(np.sqrt((thetas[alike] ** 2).mean()), rel=0.05)


def test_the_considered_sigma_grows_with_the_estimate() -> None:
    sigmas = [considered_sigma(score * K1.deviation) for score in (0.0, 1.0, 2.0, 3.0, 5.0)]
    assert (np.diff(sigmas) > 0.0).all()
    # Data that contradict the assumption leave nothing of the prior.
    assert sigmas[-1] == pytest.approx(5.0 * K1.deviation, rel=0.1)


def test_a_well_determined_parameter_keeps_its_prior() -> None:
    assert considered_sigma(0.0, deviation=1e-5) == K1.prior


def test_an_assumption_that_is_hardly_ever_broken_keeps_its_prior() -> None:
    assert considered_sigma(0.008, prevalence=1e-6) == pytest.approx(K1.prior, rel=1e-2)


def test_what_holds_exactly_is_never_considered() -> None:
    assert considered_sigma(0.1, prior=0.0) == 0.0


def test_two_assumptions_share_one_deviation() -> None:
    seen = dataclasses.replace(K1, estimate=0.02, prevalence=0.2)
    alone, both = considered_sigmas({"a": seen}), considered_sigmas({"a": seen, "b": seen})
    assert K1.prior < both["b"] == both["a"] < alone["a"]


def test_a_huge_estimate_gives_a_finite_sigma() -> None:
    assert considered_sigma(1e6) == pytest.approx(1e6 * (0.3**2 / (0.3**2 + 0.008**2)), rel=0.1)


def test_all_assumptions_together_leave_room_for_none_broken() -> None:
    assert 0.0 < sum(each.prevalence for each in ASSUMPTIONS.values()) < 1.0


def test_without_evidence_the_variance_is_that_of_both_cases() -> None:
    """Broken with the prevalence, log-uniform from the prior to the span, whose ends count in full."""
    none = Evidence.none(K1.prior, K1.span, K1.prevalence)
    taus = np.geomspace(K1.prior, K1.span, 24)
    expected = np.sqrt((1.0 - K1.prevalence) * K1.prior**2 + K1.prevalence * (taus**2).mean())
    assert considered_sigmas({"k1": none})["k1"] == pytest.approx(expected, rel=1e-6)
