"""Differences of estimates against their covariance: probabilities, directions that count, words."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from sst_graph.covariance.contradiction import Difference, PartEstimate, combined, name_step

SIGMAS = np.array([0.001] * 3 + [0.01] * 3 + [0.002])
FORWARD = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])),
    np.array([0.06, -0.08, -0.27]),
)


def part(step: np.ndarray, sigmas: np.ndarray = SIGMAS, clusters: float = np.inf) -> PartEstimate:
    return PartEstimate(step, np.diag(sigmas**2), clusters)


def test_the_length_is_chi_squared_where_covariances_are_known() -> None:
    rng = np.random.default_rng(1)
    lengths = [
        Difference.of(part(SIGMAS * rng.normal(size=7)), part(SIGMAS * rng.normal(size=7))).chi2
        for _ in range(400)
    ]
    assert kstest(lengths, chi2(7).cdf).pvalue > 0.01


def test_probabilities_hold_for_covariances_from_few_clusters() -> None:
    """Means of 14 clusters each, covariances from the same: chi-squared would be wrong one time in four."""
    rng = np.random.default_rng(2)
    p_values, naive = [], []
    for _ in range(600):
        parts = []
        for _ in range(2):
            samples = SIGMAS * rng.normal(size=(14, 7))
            parts.append(PartEstimate(samples.mean(axis=0), np.cov(samples.T) / 14, 14))
        difference = Difference.of(*parts)
        p_values.append(difference.p_value)
        naive.append(replace(difference, freedom=np.inf).p_value)
    assert np.mean(np.array(naive) < 0.05) > 0.2
    assert np.mean(np.array(p_values) < 0.05) < 0.15


def test_the_part_that_is_known_worse_decides_the_degrees_of_freedom() -> None:
    few, many = part(SIGMAS, 10.0 * SIGMAS, 8.0), part(np.zeros(7), SIGMAS, 100.0)
    assert Difference.of(many, few).freedom == pytest.approx(7.0, rel=0.05)
    alike = Difference.of(part(np.zeros(7), clusters=20.0), part(SIGMAS, clusters=20.0))
    assert alike.freedom == pytest.approx(38.0)


def test_a_direction_that_a_part_does_not_know_does_not_count() -> None:
    vague = SIGMAS.copy()
    vague[6] = 0.3
    step = np.zeros(7)
    step[6] = 0.2
    assert Difference.of(part(np.zeros(7)), part(step)).p_value < 1e-12
    assert Difference.of(part(np.zeros(7)), part(step, vague)).p_value > 0.99
    # with a time offset each, the extrinsics alone are compared
    assert Difference.of(part(np.zeros(7)).extrinsic(), part(step).extrinsic()).p_value > 0.99


def test_combined_parts_are_weighted_by_their_information() -> None:
    one, other = part(np.zeros(7)), part(np.full(7, 0.003), SIGMAS / 2.0)
    both = combined([one, other])
    np.testing.assert_allclose(both.step, 0.8 * 0.003, rtol=1e-9)
    np.testing.assert_allclose(np.diag(both.covariance), SIGMAS**2 / 5.0, rtol=1e-9)


def test_what_shifts_both_parts_alike_hides_no_step() -> None:
    """As a principal point that is off does; what shifts one part more than the other counts."""
    shift, more = ({"cy": size * SIGMAS * np.eye(7)[1]} for size in (50.0, 53.0))
    one = replace(part(np.zeros(7)), common=shift)
    step = 8.0 * SIGMAS * np.eye(7)[1]
    alike = Difference.of(one, replace(part(step), common=shift))
    assert alike.chi2 == pytest.approx(64.0 / 2.0)
    assert Difference.of(one, replace(part(step), common=more)).chi2 == pytest.approx(64.0 / 11.0)
    # a part of other sensors shares none of it
    assert Difference.of(one, part(step)).chi2 == pytest.approx(64.0 / 2502.0)
    assert Difference.of(part(step), one).chi2 == pytest.approx(64.0 / 2502.0)


def test_each_against_the_others_in_one_go() -> None:
    rng = np.random.default_rng(8)
    parts = [
        replace(
            part(SIGMAS * rng.normal(size=7), clusters=float(rng.uniform(5.0, 30.0))),
            common={name: SIGMAS * rng.normal(size=7) for name in ("cx", "cy")[: k % 3]},
        )
        for k in range(7)
    ]
    for k, found in enumerate(Difference.each_from_others(parts)):
        expected = Difference.from_others([*parts[:k], *parts[k + 1 :]], parts[k])
        np.testing.assert_allclose(found.step, expected.step, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-9, atol=1e-18)
        assert found.freedom == pytest.approx(expected.freedom)


def test_what_combined_parts_have_in_common_is_weighted_as_they_are() -> None:
    one = replace(part(np.zeros(7)), common={"cx": np.full(7, 1.0), "k1": np.full(7, 1.0)})
    other = replace(part(np.zeros(7), SIGMAS / 2.0), common={"cx": np.full(7, 6.0), "k1": np.full(7, 6.0)})
    common = combined([one, other]).common
    for name in ("cx", "k1"):
        np.testing.assert_allclose(common[name], 0.2 * 1.0 + 0.8 * 6.0)


@pytest.mark.parametrize(
    ("column", "size", "words"),
    [
        (1, -np.radians(1.1), "rotation by 1.10° ± 0.06° about the camera's x axis (pitch)"),
        (2, np.radians(2.0), "rotation by 2.00° ± 0.06° about the camera's y axis (yaw)"),
        (3, 0.2, "translation by 20.0 cm ± 1.0 cm forward"),
        (4, 0.2, "translation by 20.0 cm ± 1.0 cm left"),
        (5, 0.2, "translation by 20.0 cm ± 1.0 cm up"),
        (6, -0.1036, "time offset by -104 ms ± 2 ms"),
    ],
)
def test_a_step_is_named_along_the_axes_of_the_camera(column: int, size: float, words: str) -> None:
    step = np.zeros(7)
    step[column] = size
    named = name_step(Difference(step, np.diag(SIGMAS**2)), FORWARD)
    assert named.sentence == words
    assert len(named.kinds) == 1
    # At a steady speed a step forward may be one of the time offset: a lost image or scan.
    assert named.possible_kinds == (*named.kinds, *["offset"] * words.endswith("forward"))


def test_one_number_is_preferred_where_time_and_translation_look_alike() -> None:
    """At 8 m/s only forward - 8 offset is known: 100 ms and 80 cm are the same."""
    way = np.array([0, 0, 0, 8.0, 0, 0, 1.0])
    covariance = np.diag(SIGMAS**2) + 0.2**2 * np.outer(way, way)
    step = np.array([0, 0, 0, -0.8, 0, 0, 0])
    named = name_step(Difference(step, covariance), FORWARD)
    assert named.kinds == ("offset",)
    assert "+100 ms" in named.sentence


def test_several_kinds_are_named_where_each_explains_much() -> None:
    step = np.array([0, np.radians(1.0), 0, 0, 0, 0, 0.1])
    named = name_step(Difference(step, np.diag(SIGMAS**2)), FORWARD)
    assert named.kinds == ("rotation", "offset")
