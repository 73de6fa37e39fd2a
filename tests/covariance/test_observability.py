"""Weak directions in words, from covariances made by hand."""

from __future__ import annotations

from dataclasses import astuple

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.observability import (
    MOTION,
    SILHOUETTES,
    ObservabilityConfig,
    inseparable_directions,
    reasons_of,
    weak_directions,
    worst_ratio,
)
from sst_graph.inspect.reasons import short_reason
from sst_graph.result import DIRECTION_SCALES

CTL = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])), np.array([0.0, -0.1, -0.3])
)
"""The camera looks along the LiDAR's x axis."""
CONFIG = ObservabilityConfig()
GOOD = np.diag(np.array([np.radians(0.05)] * 3 + [0.01] * 3 + [0.0005]) ** 2)


def with_direction(step: np.ndarray) -> np.ndarray:
    """A good covariance, but for one sigma along a step (7,) [rad, m, s]."""
    return GOOD + np.outer(step, step)


def test_a_good_covariance_has_none() -> None:
    assert weak_directions(GOOD, CTL, CONFIG) == ()


def test_the_worst_ratio_is_that_of_one_unknown_or_of_any_axis() -> None:
    sigmas = np.array([np.radians(0.25)] * 3 + [0.01, 0.01, 0.1] + [0.001])
    assert worst_ratio(np.diag(sigmas**2), CONFIG) == pytest.approx(2.0)
    diagonal = np.array([0.0, 0.0, 0.0, 0.08, 0.06, 0.0, 0.0])
    assert worst_ratio(np.diag(np.full(7, 1e-12)) + np.outer(diagonal, diagonal), CONFIG) == pytest.approx(
        2.0
    )


def test_unknowns_that_are_all_within_their_limits_are_never_weak() -> None:
    """9.5 ms of 10 allowed and 3.5 cm of 5: the limits that are documented are those that count."""
    near = GOOD + np.diag(np.square([0.0, 0.0, 0.0, 0.035, 0.0, 0.0, 0.0095]))
    near[3, 6] = near[6, 3] = 0.5 * 0.035 * 0.0095
    assert worst_ratio(near, CONFIG) < 1.0 and weak_directions(near, CTL, CONFIG) == ()
    over = near + np.diag(np.square([0.0] * 6 + [0.005]))
    (weak,) = weak_directions(over, CTL, CONFIG)
    assert "the time offset is known to" in weak.sentence


def test_forward_and_time_offset_are_named_together() -> None:
    # At 8 m/s, 1 m forward equals 125 ms; along the LiDAR's x axis.
    step = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.05])
    (weak,) = weak_directions(with_direction(step), CTL, CONFIG)
    assert "shifted forward" in weak.sentence and "later" in weak.sentence
    assert "1 m equals 125 ms" in weak.sentence
    assert "40.0 cm" in weak.sentence and "50.0 ms" in weak.sentence
    assert "stop" in weak.advice and "change of speed" in weak.advice
    expected = step / DIRECTION_SCALES
    assert weak.sigma == pytest.approx(np.linalg.norm(expected), rel=0.01)
    np.testing.assert_allclose(weak.vector, expected / np.linalg.norm(expected), atol=0.01)


def test_what_hardly_separates_must_be_known_better() -> None:
    """4 cm alone are within the limit of 5 cm; tied to the time offset, as at constant speed, not."""
    alone = np.array([0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0])
    tied = np.array([0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.005])
    sure = np.diag(np.array([np.radians(0.05)] * 3 + [0.005] * 3 + [0.0003]) ** 2)
    assert weak_directions(sure + np.outer(alone, alone), CTL, CONFIG) == ()
    (weak,) = weak_directions(sure + np.outer(tied, tied), CTL, CONFIG)
    assert "shifted forward" in weak.sentence and "4.0 cm, 5.0 ms" in weak.sentence
    assert weak_directions(sure + np.outer(0.5 * tied, 0.5 * tied), CTL, CONFIG) == ()


def test_static_objects_alone_must_separate_offset_and_translation() -> None:
    """Only what ties the two as closely as constant speed counts, and only past the limits."""
    tied = np.array([0.0, 0.0, 0.0, 0.06, 0.0, 0.0, 0.0075])
    (weak,) = inseparable_directions(with_direction(tied), CTL, CONFIG)
    assert (
        weak.sentence.startswith("by static objects alone, the LiDAR shifted forward")
        and "stop" in weak.advice
    )
    assert inseparable_directions(with_direction(0.3 * tied), CTL, CONFIG) == ()
    loose = with_direction(tied) + np.diag([0.0] * 6 + [0.01**2])
    assert weak_directions(loose, CTL, CONFIG) and inseparable_directions(loose, CTL, CONFIG) == ()
    alone = np.array([np.radians(2.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert len(inseparable_directions(with_direction(tied) + np.outer(alone, alone), CTL, CONFIG)) == 1


def test_the_other_sign_of_the_time_offset() -> None:
    (weak,) = weak_directions(with_direction(np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0, -0.05])), CTL, CONFIG)
    # Forward and earlier is the same line as backward and later.
    forward, later = "shifted forward" in weak.sentence, "later" in weak.sentence
    assert forward != later and "1 m equals 125 ms" in weak.sentence


@pytest.mark.parametrize(
    ("step", "words", "advice"),
    [
        ([0, 0, 0, 0, 0, 0, 0.02], "the time offset is known to 20.0 ms only", "motion"),
        (
            [0, 0, np.radians(2), 0, 0, 0, 0],
            "known to 2.00 deg only (one sigma) about the LiDAR's z axis",
            "all sides",
        ),
        (
            [0.03, 0, -0.04, 0, 0, 0, 0],
            "about the axis [-0.60, 0.00, 0.80] of the LiDAR's frame",
            "all sides",
        ),
        ([0, 0, 0, 0, 0.3, 0, 0], "known to 30.0 cm only (one sigma), right or left", "nearer"),
    ],
)
def test_one_kind_alone(step: list[float], words: str, advice: str) -> None:
    (weak,) = weak_directions(with_direction(np.array(step)), CTL, CONFIG)
    assert words in weak.sentence and advice in weak.advice
    assert np.linalg.norm(weak.vector) == pytest.approx(1.0)
    assert weak.vector[np.abs(weak.vector).argmax()] > 0.0


@pytest.mark.parametrize(
    ("l_axis", "words"), [(0, ("forward", "backward")), (1, ("left", "right")), (2, ("up", "down"))]
)
def test_shifts_are_named_in_the_camera(l_axis: int, words: tuple[str, str]) -> None:
    step = np.zeros(7)
    step[3 + l_axis] = 0.3
    (weak,) = weak_directions(with_direction(step), CTL, CONFIG)
    assert {words[0], words[1]} == set(weak.sentence.rsplit(", ", 1)[1].split(" or "))


def test_a_rotation_that_goes_with_the_time_offset() -> None:
    (weak,) = weak_directions(with_direction(np.array([0.03, 0, 0, 0, 0, 0, 0.02])), CTL, CONFIG)
    about = "the LiDAR turned about the LiDAR's x axis cannot be distinguished from the image taken later"
    assert weak.sentence == f"{about} (one sigma: 1.72 deg, 20.0 ms)" and "motion" in weak.advice
    (other,) = weak_directions(with_direction(np.array([-0.03, 0, 0, 0, 0, 0, 0.02])), CTL, CONFIG)
    assert "taken earlier" in other.sentence
    (alone,) = weak_directions(with_direction(np.array([0.003, 0, 0, 0, 0, 0, 0.2])), CTL, CONFIG)
    assert alone.sentence == "the time offset is known to 200.0 ms only (one sigma)"


@pytest.mark.parametrize(
    ("one", "other", "words"),
    [
        (6, 4, "the time offset is known to 24.0 ms only (one sigma)"),
        (3, 2, "the translation is known to 24.0 cm only (one sigma), forward or backward"),
        (2, 3, "the rotation is known to 13.75 deg only (one sigma) about the LiDAR's z axis"),
    ],
)
def test_what_is_named_alone_has_its_own_sigma(one: int, other: int, words: str) -> None:
    """That of the covariance's diagonal, as in the tables beside it, not the part of it on the weak axis."""
    sigmas = np.array([1e-3] * 3 + [1e-2] * 3 + [1e-3])
    sigmas[one] = 0.24 * (0.1 if one == 6 else 1.0)
    sigmas[other] = 0.02 if other == 2 else 0.1
    correlation = np.eye(7)
    correlation[one, other] = correlation[other, one] = 0.5
    weak, *_ = weak_directions(correlation * np.outer(sigmas, sigmas), CTL, CONFIG)
    assert words in weak.sentence


def test_the_axis_of_a_rotation_stays_in_a_short_reason() -> None:
    (weak,) = weak_directions(with_direction(np.array([0.03, 0, -0.04, 0, 0, 0, 0])), CTL, CONFIG)
    short = short_reason(f"{weak.sentence}: {weak.advice}")
    assert "known to 2.87 deg only about the axis [-0.60, 0.00, 0.80] of the LiDAR" in short


def test_a_translation_that_hardly_depends_on_the_time_offset_names_no_rate() -> None:
    loose = GOOD + np.diag([0.0] * 3 + [0.1**2, 0.0, 0.0, 0.003**2])
    loose[3, 6] = loose[6, 3] = 0.3 * 0.1 * 0.003
    (weak,) = weak_directions(loose, CTL, CONFIG)
    assert abs(weak.vector[6]) > 0.05
    assert weak.sentence.startswith("the translation is known to 10.") and "forward" in weak.sentence


def test_the_weakest_first_and_only_past_the_limits() -> None:
    sigmas = np.array([0.001, 0.001, 0.02, 0.3, 0.01, 0.01, 0.001])
    found = weak_directions(np.diag(sigmas**2), CTL, CONFIG)
    # 0.3 m is six times its limit, 0.02 rad 2.3 times.
    assert [int(np.abs(weak.vector).argmax()) for weak in found] == [3, 2]
    wide = ObservabilityConfig(rotation_deg=2.0, translation_m=0.5, time_offset_s=0.01)
    assert weak_directions(np.diag(sigmas**2), CTL, wide) == ()


def test_what_two_directions_say_alike_is_said_once() -> None:
    found = weak_directions(with_direction(np.array([0.0, 0.02, 0.0, 0.3, 0.0, 0.0, 0.0])), CTL, CONFIG)
    assert found and reasons_of((*found, *found)) == tuple(weak.reason for weak in found)


@pytest.mark.parametrize("remedy", [*astuple(SILHOUETTES), *astuple(MOTION)])
def test_advice_is_one_clause(remedy: str) -> None:
    short = short_reason(f"the time offset is known to 20.0 ms only (one sigma): {remedy}")
    assert short.startswith("the time offset is known to 20.0 ms only: record ")
