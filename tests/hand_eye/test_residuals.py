"""All pairs in one factor say the same as a factor of each pair by itself."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from moving_drives import OFFSET_S, TRUE, PoseAt, made_drive, resting, weaving

from sst_graph.graph.state import State
from sst_graph.hand_eye.graph import (
    HandEyeTerms,
    camera_steps,
    hand_eye_terms,
    lidar_paths,
    pair_motions,
    state_values,
)


def terms_of(wTl: PoseAt, state: State) -> HandEyeTerms:
    drive = made_drive(wTl, frames=12)
    pairs = pair_motions(camera_steps([drive]), lidar_paths([drive]), state.time_offsets_s[0])
    return hand_eye_terms(pairs, state)[0]


def beside(state: State) -> State:
    """Another state, so that the LiDAR's motions are carried on by their twists."""
    step = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05])
    return State(state.cTl.retract(step), (state.time_offsets_s[0] + 0.013,))


@pytest.mark.parametrize("wTl", [weaving, resting])
def test_the_cost_is_the_sum_of_each_pairs(wTl: PoseAt) -> None:
    at = State(TRUE, (OFFSET_S - 0.02,))
    terms = terms_of(wTl, at)
    assert terms.residuals.directed.any() == (wTl is weaving)
    for state in (at, beside(at)):
        values = state_values(state)
        apart = sum(factor.error(values) for factor in terms.each())
        assert terms.factor().error(values) == pytest.approx(apart, rel=1e-9)
        information = sum(factor.linearize(values).information() for factor in terms.each())
        together = terms.factor().linearize(values).information()
        np.testing.assert_allclose(together, information, rtol=1e-7, atol=1e-9 * np.abs(information).max())


def test_jacobians_against_numerical_ones() -> None:
    at = State(TRUE, (OFFSET_S - 0.02,))
    terms, state = terms_of(weaving, at), beside(at)
    residuals, offset = terms.residuals, state.time_offsets_s[0]
    H = residuals.evaluate(state.cTl, offset, True)[1]
    assert residuals.evaluate(state.cTl, offset, False)[1].size == 0
    for column in range(7):
        step = 1e-6 * np.eye(7)[column]
        ends = [
            residuals.evaluate(state.cTl.retract(sign * step[:6]), offset + sign * step[6], False)[0]
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, H[:, :, column], rtol=1e-5, atol=1e-6)


def test_a_motion_without_direction_has_rows_of_zeros() -> None:
    terms = terms_of(resting, State(TRUE, (OFFSET_S,)))
    J, r = terms.linearized(State(TRUE, (OFFSET_S,)))
    assert not J[:, 3:].any() and not r[:, 3:].any() and r[:, :3].any()
    assert isinstance(terms.factor(), gtsam.CustomFactor)


def test_jacobians_by_the_cameras_motions_are_those_of_the_lidars_but_for_noise() -> None:
    drive = made_drive(weaving, frames=12, noise=1e-4)
    pairs = pair_motions(camera_steps([drive]), lidar_paths([drive]), OFFSET_S)
    residuals = hand_eye_terms(pairs, State(TRUE, (OFFSET_S,)))[0].residuals
    H, by_camera = residuals.evaluate(TRUE, OFFSET_S, True)[1], residuals.jacobians_by_camera(TRUE, OFFSET_S)
    assert np.abs(by_camera).max() > 0.1
    # What is left is the interpolation between stamps.
    np.testing.assert_allclose(by_camera, H, atol=0.02 * np.abs(H).max())
