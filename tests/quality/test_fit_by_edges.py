"""How well a solution by edges fits the pictures: shares of close points and the score along the unknowns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from edge_fits import CONFIG, SIGMAS, fit_at, fit_by_edges, problem_by_edges, solution_by_edges

from sst_graph.edges.agreement import score
from sst_graph.fit import CLOSE_PX, Profile
from sst_graph.graph.matching import edges_of
from sst_graph.quality.profiles import score_profiles


def turned(axis: int, degrees: float) -> np.ndarray:
    step = np.zeros(7)
    step[axis] = np.radians(degrees)
    return step


def top(profile: Profile) -> float:
    """Where the score is best, in sigmas."""
    return float(profile.steps[int(np.argmin(profile.costs))]) / float(SIGMAS[profile.unknown])


@pytest.mark.slow
def test_close_points_stand_out_from_those_of_random_rotations() -> None:
    fit = fit_by_edges()
    quality = fit.quality
    assert fit.by_edges and quality.by_chance is not None and quality.share_at_start is not None
    assert quality.share > 2.0 * quality.by_chance
    assert quality.share == pytest.approx(quality.attainable, abs=0.03)
    # The start is as wrong as a random rotation, and so is a far state itself, whose own edges count.
    assert quality.share_at_start == pytest.approx(quality.by_chance, abs=0.07)
    far = fit_at(turned(2, 3.0)).quality
    assert far.by_chance is not None and far.share < 1.3 * far.by_chance < 0.6 * quality.share


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [-0.3, 0.3])
def test_three_tenths_of_a_degree_are_visible(degrees: float) -> None:
    """About the vertical, at two thirds of the usual size: 2.5 px."""
    wrong = fit_at(turned(2, degrees))
    assert wrong.quality.share < 0.75 * wrong.quality.attainable
    assert wrong.quality.share < 0.7 * fit_by_edges().quality.share
    # The score is best where the turn is taken back; the shift that it is mistaken for follows.
    profile = wrong.profiles[2]
    assert profile.unknown == 2 and 1.0 <= -np.sign(degrees) * top(profile) <= 2.0


@pytest.mark.slow
def test_the_score_is_best_at_the_estimate() -> None:
    profiles = fit_by_edges().profiles
    assert [profile.unknown for profile in profiles] == list(range(7))
    for profile in profiles:
        assert abs(top(profile)) <= 1.0
        assert profile.costs.min() == 0.0 and (profile.costs >= 0.0).all()
        assert (np.diff(profile.steps) > 0.0).all() and 0.0 in profile.steps
        assert profile.steps[-1] == pytest.approx(3.0 * SIGMAS[profile.unknown])


def test_a_profile_is_of_the_score_that_solutions_are_compared_by() -> None:
    problem, solution = problem_by_edges(), solution_by_edges()
    edges = edges_of(problem.drives, problem.motions, problem.config.joint.graph)
    held = np.diag(SIGMAS**2)  # nothing follows
    for profile in score_profiles(edges, solution.state, held, SIGMAS):
        assert profile.best_score is not None
        for step, cost in zip(profile.steps, profile.costs, strict=True):
            moved = np.zeros(7)
            moved[profile.unknown] = step
            state = solution.state
            offset_s = state.time_offsets_s[0] + float(moved[6])
            there = replace(state, cTl=state.cTl.retract(moved[:6]), time_offsets_s=(offset_s,))
            if profile.unknown < 6 or step == 0.0:  # another offset leaves out other moving objects
                assert profile.best_score - cost == pytest.approx(score(edges, there, 1.5), rel=1e-3)


def test_the_gaussian_of_a_profile_is_the_nearest_to_its_costs() -> None:
    """Least squares: no other sigma fits the costs better."""
    for profile in fit_by_edges().profiles:

        def misfit(sigma: float, own: Profile = profile) -> float:
            return float(((0.5 * (own.steps / sigma) ** 2 - own.costs) ** 2).sum())

        assert misfit(profile.sigma) < min(misfit(0.98 * profile.sigma), misfit(1.02 * profile.sigma))


def test_profiles_are_left_out_where_no_report_is_wanted() -> None:
    fit = fit_at(np.zeros(7), replace(CONFIG, for_report=False))
    assert fit.profiles == () and fit.quality == fit_by_edges().quality


def test_points_are_those_of_the_strongest_edges() -> None:
    points = fit_by_edges().points
    assert ((points.weights >= 0.0) & (points.weights <= 1.0)).all() and points.weights.std() > 0.05
    close = np.abs(points.residuals_px) < CLOSE_PX
    assert close.mean() == pytest.approx(fit_by_edges().quality.share)
    # Those that meet another edge lie to either side alike.
    far = points.residuals_px[np.abs(points.residuals_px) > 5.0]
    assert len(far) > 50 and 0.3 < float((far > 0.0).mean()) < 0.7
