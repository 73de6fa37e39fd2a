"""The cluster-robust covariance in a user's graph: against a dense covariance of all errors, and on a street
at one speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from alignment_streets import D, E, Street, simulated_street

from sst_graph import AlignmentKeys, Trajectory, calibration_covariance, solve_with_terms
from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.errors import EstimationError
from sst_graph.factors import FactorError
from sst_graph.slam.alignment_keys import COLUMNS, bias_column
from sst_graph.slam.alignment_term import TermMatches, TermRows
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.covariance import (
    MASK_BIAS_PRIOR_PX,
    MASK_BIAS_PX,
    TermSums,
    covariance_warnings,
    fit_errors,
    inflation,
    robust_covariance,
    times_too_sure,
    total,
)
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.solving import RematchSolution
from sst_graph.slam.term_warnings import WarningKind
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
KEYS = AlignmentKeys(Trajectory(), E, D)
COLUMN = bias_column(VEHICLE)


def random_rows(images: int = 12, objects: int = 5, matches: int = 20, seed: int = 0) -> list[TermRows]:
    """Images of the same objects, every residual 0."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(images):
        n = objects * matches
        J = np.zeros((n, COLUMNS))
        J[:, :7], J[:, COLUMN] = rng.normal(size=(n, 7)), 1.0
        sides = np.repeat(np.arange(objects) * SIDES, matches) + rng.integers(0, 2, n)
        weights, sigmas_px = rng.uniform(0.2, 1.0, n), rng.uniform(0.5, 2.0, n)
        found.append(TermRows(J, np.zeros(n), weights, sigmas_px, sides, LevelEdges.none(n)))
    return found


def marginal_of(rows: list[TermRows], information: float, prior: float) -> np.ndarray:
    """(n, n) of seven unknowns, by the matches and a prior."""
    whole = TermRows.joined(rows)
    H = information * (whole.J[:, :7] * (whole.weights / whole.sigmas_px**2)[:, None]).T @ whole.J[:, :7]
    P = np.zeros((COLUMNS, COLUMNS))
    P[:7, :7] = np.linalg.inv(H + prior * np.eye(7))
    return P


@pytest.mark.parametrize("information", [1.0, 0.3])
def test_it_is_the_covariance_of_the_estimate_under_the_errors(information: float) -> None:
    """Against A S A' with the dense covariance S of all errors and A how the estimate follows them."""
    rows, prior = random_rows(), 5.0
    whole, errors = TermRows.joined(rows), ErrorModel(0.7, 0.3, 1.4)
    P = marginal_of(rows, information, prior)
    image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
    same_side = whole.sides[:, None] == whole.sides
    S = errors.side * same_side + errors.side_frame * (same_side & (image[:, None] == image))
    # a match whose robust weight is w counts as w of a match
    S = S + np.diag(errors.match * whole.sigmas_px**2 / whole.weights)
    A = information * P[:7, :7] @ (whole.J[:, :7] * (whole.weights / whole.sigmas_px**2)[:, None]).T
    by_prior = prior * P[:7, :7] @ P[:7, :7]
    by_bias = A @ whole.J[:, COLUMN]
    expected = A @ S @ A.T + by_prior + MASK_BIAS_PX**2 * np.outer(by_bias, by_bias)
    found = robust_covariance(P, total(TermSums.of(each, information) for each in rows), errors, KEYS)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-9, atol=1e-12)
    alone = A @ np.diag(whole.sigmas_px**2 / whole.weights) @ A.T + by_prior
    np.testing.assert_allclose(found.clustered, A @ S @ A.T + by_prior, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.independent, alone, rtol=1e-9, atol=1e-12)


def test_a_mask_bias_that_is_no_variable_is_found_and_considered() -> None:
    """Against least squares with the bias as a variable."""
    rows, bias = random_rows(seed=1), 2.5
    whole = TermRows.joined(rows)
    rng = np.random.default_rng(2)
    noise = rng.normal(size=len(whole)) * whole.sigmas_px
    weights = whole.weights / whole.sigmas_px**2
    A = np.column_stack([whole.J[:, :7], whole.J[:, COLUMN]])
    H = (A * weights[:, None]).T @ A
    H[7, 7] += MASK_BIAS_PRIOR_PX**-2
    # all points lie ``bias`` outside of the contours; the seven are solved without it
    r = bias + noise
    step = -np.linalg.solve(H[:7, :7], (A[:, :7] * weights[:, None]).T @ r)
    whole = replace(whole, r=r + A[:, :7] @ step)
    joint = -np.linalg.solve(H, (A * weights[:, None]).T @ r)
    P = marginal_of(rows, 1.0, 0.0)
    found = robust_covariance(P, TermSums.of(whole, 1.0), ErrorModel(0.0, 0.0, 1.0), KEYS)
    estimate, sigma = found.mask_biases_px[VEHICLE]
    assert estimate == pytest.approx(joint[7], rel=1e-9) == pytest.approx(-bias, abs=4.0 * sigma)
    assert sigma == pytest.approx(np.sqrt(np.linalg.inv(H)[7, 7]), rel=0.01)
    # the whole of the step between the two estimates is within the covariance
    assert found.clustered[0, 0] < found.covariance[0, 0]
    off = joint[:7] - step
    assert off @ np.linalg.solve(found.covariance, off) < 1.0
    (warning,) = covariance_warnings(P[:7, :7], found, gtsam.Pose3(), RematchConfig())[-1:]
    assert warning.kind is WarningKind.MASK_BIAS and "vehicle, -2.4" in warning.detail
    variable = AlignmentKeys(Trajectory(), E, D, {VEHICLE: gtsam.symbol("B", 0)})
    assert robust_covariance(P, TermSums.of(whole, 1.0), ErrorModel(0, 0, 1), variable).mask_biases_px == {}


def test_a_mask_bias_has_a_sigma_in_a_graph_that_holds_less_than_the_matches() -> None:
    """The factors of the matches were scaled down, or are another's: a sigma is above 0 all the same."""
    rows = random_rows(seed=1)
    sums, P = TermSums.of(TermRows.joined(rows), 1.0), marginal_of(rows, 0.002, 0.0)
    column = sums.claimed[:, COLUMN]
    assert column[COLUMN] - column @ P @ column < -1.0  # what the bias's information would be
    _, sigma = robust_covariance(P, sums, ErrorModel(0.0, 0.0, 1.0), KEYS).mask_biases_px[VEHICLE]
    assert sigma > 0.0


def test_errors_of_sides_are_found_in_the_residuals() -> None:
    rng, rows = np.random.default_rng(3), random_rows(30, 40, 12, seed=3)
    of_side = 2.0 * rng.normal(size=40 * SIDES)
    shown = []
    for each in rows:
        in_image = 0.8 * rng.normal(size=40 * SIDES)
        noise = 1.2 * rng.normal(size=len(each))
        r = of_side[each.sides] + in_image[each.sides] + noise
        shown.append(replace(each, r=r, weights=np.ones(len(each)), sigmas_px=np.ones(len(each))))
    errors = fit_errors(shown, RematchConfig())
    # sides and objects lose a share of their spread to the pose, which was not fitted here
    assert 2.0**2 * 0.7 < errors.side < 2.0**2 * 1.5 / 0.4
    assert errors.side_frame == pytest.approx(0.8**2, rel=0.15)
    assert errors.match == pytest.approx(1.2**2, rel=0.05)
    quiet = fit_errors([replace(each, r=0.01 * each.r) for each in shown], RematchConfig(side_sigma_px=1.5))
    assert (quiet.side, quiet.match) == (1.5**2, 1.0)


def test_a_marginal_that_is_too_sure_gives_a_warning() -> None:
    """One side of one object in a hundred images: its error does not average."""
    rng, shape = np.random.default_rng(5), random_rows(100, 4, 40, seed=5)
    seen = rng.normal(size=(4 * SIDES, COLUMNS))  # a side lies in every image alike
    rows = [replace(each, J=np.where(each.J != 0.0, seen[each.sides], 0.0)) for each in shape]
    P = marginal_of(rows, 1.0, 1.0)
    found = robust_covariance(
        P, total(TermSums.of(each, 1.0) for each in rows), ErrorModel(1.0, 0.0, 1.0), KEYS
    )
    times = times_too_sure(P[:7, :7], found.clustered)
    kinds = [w.kind for w in covariance_warnings(P[:7, :7], found, gtsam.Pose3(), RematchConfig())]
    assert times > 3.0 and WarningKind.OVERCONFIDENT_MARGINAL in kinds
    honest = covariance_warnings(found.clustered, found, gtsam.Pose3(), RematchConfig())
    assert WarningKind.OVERCONFIDENT_MARGINAL not in [w.kind for w in honest]


def test_classes_may_share_a_mask_bias() -> None:
    person, B = SemanticClass.PERSON, gtsam.symbol("B", 0)
    keys = AlignmentKeys(Trajectory(), E, 0.1, {VEHICLE: B, person: B, SemanticClass.POLE: 0.5})
    assert keys.lasting == (E, B)
    covariance = np.diag(np.arange(1.0, 8.0))
    covariance[0, 6] = covariance[6, 0] = 0.5
    P = keys.placed(covariance)
    columns = [*range(6), bias_column(VEHICLE), bias_column(person)]
    assert np.count_nonzero(np.diag(P)) == len(columns)
    np.testing.assert_array_equal(np.diag(P)[columns], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 7.0])
    assert P[0, bias_column(person)] == 0.5 and P[bias_column(VEHICLE), bias_column(person)] == 7.0


def test_ratios_of_covariances() -> None:
    P, C = np.diag([1.0, 4.0, 0.0]), np.diag([4.0, 64.0, 0.0])
    assert inflation(P, C) == pytest.approx((4.0 + 16.0) / 2.0) and times_too_sure(P, C) == pytest.approx(4.0)
    assert inflation(np.zeros((3, 3)), C) == 1.0 and inflation(np.full((3, 3), np.inf), C) == 1.0


# --- a street at one speed


@pytest.fixture(scope="module")
def steady() -> Street:
    return simulated_street(7, 16, "constant")


@pytest.fixture(scope="module")
def solution(steady: Street) -> RematchSolution:
    keys = AlignmentKeys(steady.trajectory(), E, D)
    terms = [steady.term(k, keys) for k in range(len(steady.images))]
    return solve_with_terms(*steady.whole(steady.start(1)), terms)


@pytest.mark.slow
def test_forward_against_time_offset_is_weak(steady: Street, solution: RematchSolution) -> None:
    weak = [w for w in solution.warnings if w.kind is WarningKind.WEAK_DIRECTION]
    assert len(weak) == 1 and weak[0].value > 2.0 and weak[0].limit == 1.0
    assert "cannot be distinguished from the image taken later" in weak[0].detail and "record a stop" in str(
        weak[0]
    )
    assert steady.nees(solution.values, solution.covariance) < 18.5  # 99 % of 7


def test_matches_that_count_in_full_are_too_sure(steady: Street, solution: RematchSolution) -> None:
    """A graph put together by hand, every match taken for independent."""
    keys = AlignmentKeys(steady.trajectory(), E, D)
    graph, _ = steady.whole(steady.start(1))
    found = [steady.term(k, keys).matched(solution.values, 4.0) for k in range(len(steady.images))]
    for each in found:
        if each.factor is not None:
            graph.add(each.factor)
    by_hand = calibration_covariance(graph, solution.values, found)
    kinds = {warning.kind for warning in by_hand.warnings}
    assert WarningKind.WEAK_DIRECTION in kinds and by_hand.weak_directions
    assert by_hand.times_too_sure > 2.0
    P = gtsam.Marginals(graph, solution.values).jointMarginalCovariance([E, D]).fullMatrix()
    np.testing.assert_allclose(by_hand.marginal, P, rtol=1e-6)
    # the scaled graph of the solution has the same covariance
    scaled = calibration_covariance(solution.graph, solution.values, solution.matches)
    ratios = np.diag(scaled.covariance) / np.diag(by_hand.covariance)
    assert ratios.min() > 0.8 and ratios.max() < 1.25
    assert scaled.times_too_sure < 0.8 * by_hand.times_too_sure


def test_places_of_level_edges_do_not_hang_on_where_the_world_begins(steady: Street) -> None:
    """As far away as the coordinates of a country are, squares of places would have no digit left."""
    keys = AlignmentKeys(steady.trajectory(), E, D)
    _, values = steady.whole(steady.start(1))
    far = gtsam.Values(values)
    for pose in filter(keys.trajectory.__contains__, values.keys()):
        wTb = values.atPose3(pose)
        far.update(pose, gtsam.Pose3(wTb.rotation(), wTb.translation() + np.array([5e5, 5.4e6, 400.0])))
    found = []
    for each in (values, far):
        sides, places = ObjectSides(), []
        for k in (0, 5):
            term = steady.term(k, keys)
            places.append(term.rows(term.matched(each, 4.0), sides, each).level.places)
        found.append(np.concatenate(places))
    assert len(found[0]) > 100 and np.abs(found[0]).max() < 200.0
    np.testing.assert_allclose(found[1], found[0], atol=1e-5)


def _graph_of(matches: Sequence[TermMatches]) -> gtsam.NonlinearFactorGraph:
    """The factors of matches alone."""
    graph = gtsam.NonlinearFactorGraph()
    for each in matches:
        if each.factor is not None:
            graph.add(each.factor)
    return graph


def test_refuses_a_graph_that_does_not_hold_just_the_factors_of_the_matches(
    solution: RematchSolution,
) -> None:
    graph, values, matches = solution.graph, solution.values, solution.matches
    whole = calibration_covariance(graph, values, matches)
    assert np.isfinite(whole.covariance).all()
    with pytest.raises(FactorError, match="factors missing"):
        calibration_covariance(gtsam.NonlinearFactorGraph(), values, matches)
    with pytest.raises(FactorError, match="further alignment factor"):
        calibration_covariance(graph, values, matches[2:])
    twice = gtsam.NonlinearFactorGraph(graph)
    twice.push_back(_graph_of(matches))
    with pytest.raises(FactorError, match="a factor twice"):
        calibration_covariance(twice, values, matches)
    with pytest.raises(FactorError, match="each pair once"):
        calibration_covariance(graph, values, [*matches, matches[0]])


def test_refuses_what_tells_nothing(steady: Street, solution: RematchSolution) -> None:
    with pytest.raises(EstimationError, match="no term with a factor"):
        calibration_covariance(solution.graph, solution.values, [])
    with pytest.raises(EstimationError, match="expected priors"):
        calibration_covariance(_graph_of(solution.matches), solution.values, solution.matches)
