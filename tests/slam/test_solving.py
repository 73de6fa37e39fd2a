"""Terms in every solver: from 2 deg, 7.5 cm and 30 ms off, under priors that tell nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from alignment_streets import WIDE, D, E, Street, X, isam2_params, simulated_street

from sst_graph import AlignmentKeys, AlignmentTerm, Trajectory, open_source, solve_with_terms
from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.errors import DataError, EstimationError
from sst_graph.factors import time_offset_prior
from sst_graph.odometry import RegisteredScan, scan_to_scan
from sst_graph.slam.align import VEHICLES, features_of
from sst_graph.slam.alignment_term import TermConfig, TermMatches, TermState
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.incremental_terms import IncrementalTerms, Solver
from sst_graph.slam.solving import RematchSolution, match_all
from sst_graph.slam.term_warnings import WarningKind, last_warnings
from sst_graph.types import SemanticClass

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
STOP, PARKED = DATA / "kitti_2011_09_26_stop", DATA / "kitti_2011_09_26_parked"
B = gtsam.symbol("B", 0)
KITTI_TRUTH = (np.radians(0.1), 0.01, 0.002)
"""What the published calibration itself is good to [rad, m, s]."""


def terms_of(street: Street) -> list[AlignmentTerm]:
    keys = AlignmentKeys(street.trajectory(), E, D)
    return [street.term(k, keys) for k in range(len(street.images))]


@pytest.fixture(scope="module")
def street() -> Street:
    return simulated_street(5)


@pytest.fixture(scope="module")
def solution(street: Street) -> RematchSolution:
    graph, values = street.whole(street.start(1))
    return solve_with_terms(graph, values, terms_of(street))


def solver_of(kind: str, lag_s: float) -> Solver:
    if kind == "isam2":
        return gtsam.ISAM2(isam2_params())
    return gtsam.IncrementalFixedLagSmoother(lag_s, isam2_params())


# --- Levenberg-Marquardt


@pytest.mark.slow
def test_levenberg_marquardt_comes_to_the_truth(street: Street, solution: RematchSolution) -> None:
    rotation_deg, translation_m, time_offset_s = street.errors(solution.values)
    assert solution.converged
    assert rotation_deg < 0.1 and translation_m < 0.02 and time_offset_s < 0.002
    assert street.nees(solution.values, solution.covariance) < 14.0


def test_the_marginals_of_the_graph_have_the_same_size(street: Street, solution: RematchSolution) -> None:
    marginals = gtsam.Marginals(solution.graph, solution.values)
    P = marginals.jointMarginalCovariance([E, D]).fullMatrix()
    assert street.nees(solution.values, P) < 14.0
    ratios = np.diag(P) / np.diag(solution.covariance)
    assert ratios.min() > 0.3 and ratios.max() < 4.0
    # without errors that matches share the graph would be several times as sure
    graph, values = street.whole(street.start(1))
    bare = solve_with_terms(graph, values, terms_of(street), RematchConfig(side_sigma_px=0.0))
    larger = np.diag(solution.covariance) / np.diag(bare.covariance)
    assert larger.min() > 1.0 and np.exp(np.log(larger).mean()) > 2.0


def test_wide_priors_give_a_warning_and_narrow_ones_do_not(street: Street, solution: RematchSolution) -> None:
    (warning,) = solution.warnings
    assert warning.kind is WarningKind.WIDE_UNCERTAINTY and warning.unit == "px"
    assert warning.value > warning.limit == pytest.approx(120.0)
    graph, values = street.whole(street.start(1), (0.03, 0.05, 0.03))
    narrow = solve_with_terms(graph, values, terms_of(street))
    assert narrow.warnings == () and narrow.converged


@pytest.mark.slow
def test_only_what_the_other_factors_know_counts_as_far(street: Street) -> None:
    """Values may begin far from what a narrow prior says; matches that contradict it are named."""
    far, sigmas = street.start(1), (0.005, 0.02, 0.005)
    _, away = street.whole(far)
    graph, _ = street.whole((street.cTl, street.time_offset_s), sigmas)
    assert solve_with_terms(graph, away, terms_of(street)).warnings == ()
    graph, values = street.whole(far, sigmas)
    found = solve_with_terms(graph, values, terms_of(street)).warnings
    assert WarningKind.FAR_FROM_START in [warning.kind for warning in found]


def test_the_predicted_sigma_is_that_of_the_pixels(street: Street) -> None:
    _, values = street.whole((street.cTl, street.time_offset_s))
    matches = terms_of(street)[8].matched(values, 5.0)
    sigma = 1e-3
    covariance = np.zeros((7, 7))
    covariance[2, 2] = sigma**2
    predicted = matches.predicted_sigma_px(values, covariance)
    moved = gtsam.Values(values)
    moved.update(E, street.cTl.retract(np.array([0.0, 0.0, sigma, 0.0, 0.0, 0.0])))
    assert matches.moved_px(values) == 0.0
    assert matches.moved_px(moved) == pytest.approx(predicted, rel=0.02)


# --- iSAM2 and smoother


@pytest.mark.parametrize("kind", ["isam2", "smoother"])
@pytest.mark.slow
def test_incremental_solvers_come_to_the_truth(street: Street, kind: str) -> None:
    found = street.frame_by_frame(solver_of(kind, 1.25), street.start(1))
    rotation_deg, translation_m, time_offset_s = street.errors(found.values)
    assert found.converged and found.kernel_px == 4.0
    assert rotation_deg < 0.1 and translation_m < 0.02
    # A smoother of 1.25 s knows the offset to 8 ms.
    assert time_offset_s < (0.002 if kind == "isam2" else 0.003)
    assert street.nees(found.values, found.covariance) < 14.0
    assert found.values.exists(X(0)) == (kind == "isam2")


@pytest.mark.slow
def test_isam2_holds_each_factor_once(street: Street) -> None:
    solver = gtsam.ISAM2(isam2_params())
    street.frame_by_frame(solver, street.start(2))
    graph = solver.getFactorsUnsafe()
    custom = [i for i in range(graph.size()) if isinstance(graph.at(i), gtsam.CustomFactor)]
    # one factor a term, and none of the proximal priors: odometry, first pose, priors of E and D
    assert len(custom) == len(street.images) - 1
    assert graph.nrFactors() == len(custom) + len(street.motions) + 3


def test_wide_priors_give_a_warning_at_the_first_matches(street: Street) -> None:
    trajectory = Trajectory()
    keys = AlignmentKeys(trajectory, E, D)
    terms, warnings = IncrementalTerms(gtsam.ISAM2(isam2_params()), keys), []
    for k in range(3):
        trajectory.append(X(k), street.stamps_ns[k])
        warnings.append(terms.update(*street.new_at(k, street.start(1)), [street.term(k, keys)]).warnings)
    kinds = [[warning.kind for warning in each] for each in warnings]
    assert kinds[0] == [] and WarningKind.WIDE_UNCERTAINTY in kinds[1] and kinds[2] == []
    # the end says it again, as Levenberg-Marquardt does
    assert WarningKind.WIDE_UNCERTAINTY in [warning.kind for warning in terms.converge().warnings]


def test_the_end_begins_with_a_wide_kernel_again(street: Street) -> None:
    """The first images have narrowed it; the second call has nothing new to begin for."""
    trajectory = Trajectory()
    keys = AlignmentKeys(trajectory, E, D)
    terms = IncrementalTerms(gtsam.ISAM2(isam2_params()), keys)
    for k in range(12):
        trajectory.append(X(k), street.stamps_ns[k])
        update = terms.update(*street.new_at(k, street.start(1)), [street.term(k, keys)])
    assert update.kernel_px == RematchConfig().last_px
    assert terms.converge(1).kernel_px > 20.0
    assert terms.converge().converged and terms.converge(1).converged


@pytest.mark.slow
def test_a_solver_that_does_not_relinearize_is_named(street: Street) -> None:
    """gtsam's own defaults leave an extrinsic that is less than 0.1 rad off where it began."""
    found = street.frame_by_frame(gtsam.ISAM2(), street.start(1))
    (warning,) = [w for w in found.warnings if w.kind is WarningKind.FAR_LINEARIZATION]
    assert warning.value > warning.limit and "relinearizeSkip = 1" in str(warning)
    assert "smoother" not in str(warning)
    found = street.frame_by_frame(gtsam.ISAM2(isam2_params()), street.start(1))
    assert WarningKind.FAR_LINEARIZATION not in [w.kind for w in found.warnings]


@pytest.mark.slow
def test_a_smoother_is_told_what_its_parameters_do_not_change(street: Street) -> None:
    solver = gtsam.IncrementalFixedLagSmoother(1.25, gtsam.ISAM2Params())
    found = street.frame_by_frame(solver, street.start(1))
    (warning,) = [w for w in found.warnings if w.kind is WarningKind.FAR_LINEARIZATION]
    assert "relinearizeSkip = 1" in str(warning) and "longer lag" in str(warning)


@pytest.mark.parametrize("lag_s", [3.0, 100.0])
def test_a_smoother_linearizes_no_more_what_a_marginalized_factor_holds(lag_s: float) -> None:
    """The fact of gtsam that the warning states: E on poses that all say another one."""
    solver = gtsam.IncrementalFixedLagSmoother(lag_s, isam2_params())
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    for k in range(8):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            values.insert(E, gtsam.Pose3())
            graph.add(gtsam.PriorFactorPose3(E, gtsam.Pose3(), noise))
        values.insert(X(k), gtsam.Pose3())
        graph.add(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(), noise))
        seen = gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * k, 0.0, 0.0]))
        graph.add(gtsam.BetweenFactorPose3(X(k), E, seen, noise))
        solver.update(graph, values, {X(k): float(k), E: float(k)})
        solver.update()
    behind_m = solver.calculateEstimatePose3(E).x() - solver.getLinearizationPoint().atPose3(E).x()
    assert (behind_m > 0.1) == (lag_s < 8.0)


# --- one term


def test_a_term_moves_to_the_poses_of_its_time(street: Street) -> None:
    keys = AlignmentKeys(street.trajectory(), E, D)
    term = street.term(4, keys)
    _, values = street.whole((street.cTl, street.time_offset_s))
    period_s = 1e-9 * (street.stamps_ns[5] - street.stamps_ns[4])
    matches = term.matched(values, 5.0)
    assert matches.state is TermState.MATCHED and matches.factor is not None and matches.place is not None
    assert (matches.place.between.X_a, matches.place.between.X_b) == (X(4), X(5))
    assert matches.left_interval_s(values) == 0.0
    values.update(D, np.array([street.time_offset_s + 2.0 * period_s]))
    assert matches.left_interval_s(values) == pytest.approx(street.time_offset_s + period_s, abs=2e-3)
    again = term.matched(values, 5.0)
    assert again.place is not None and (again.place.between.X_a, again.place.between.X_b) == (X(6), X(7))
    assert again.left_interval_s(values) == 0.0


def test_poses_that_lie_far_apart_are_said(street: Street) -> None:
    _, values = street.whole((street.cTl, street.time_offset_s))
    for every, expected in ((2, False), (4, True)):
        frames = range(0, len(street.stamps_ns), every)
        trajectory = Trajectory([X(k) for k in frames], [street.stamps_ns[k] for k in frames])
        matches = street.term(4, AlignmentKeys(trajectory, E, D)).matched(values, 5.0)
        found = last_warnings([matches], values, np.zeros((7, 7)), RematchConfig())
        assert (WarningKind.LONG_INTERVAL in {each.kind for each in found}) == expected


def test_the_scan_nearest_in_true_time_is_taken(street: Street) -> None:
    term = street.term(4, AlignmentKeys(street.trajectory(), E, D))
    _, values = street.whole((street.cTl, street.time_offset_s))
    for shift, expected in ((0.0, (4, 5)), (0.1, (5, 6)), (-0.1, (3, 4))):
        values.update(D, np.array([street.time_offset_s + shift]))
        place = term.place(values)
        assert not isinstance(place, TermMatches)
        assert place.between.X_s in {X(k) for k in expected}


@pytest.mark.parametrize(
    ("time_offset_s", "state", "sign"),
    [(100.0, TermState.AFTER_TRAJECTORY, 1.0), (-100.0, TermState.BEFORE_TRAJECTORY, -1.0)],
)
def test_an_image_beyond_the_trajectory_is_reported(
    street: Street, time_offset_s: float, state: TermState, sign: float
) -> None:
    term = street.term(4, AlignmentKeys(street.trajectory(), E, D))
    _, values = street.whole((street.cTl, time_offset_s))
    matches = term.matched(values, 5.0)
    assert matches.state is state and matches.factor is None
    assert sign * matches.outside_s > 90.0
    assert "ms" in str(matches)


def test_missing_poses_are_reported(street: Street) -> None:
    _, values = street.whole((street.cTl, street.time_offset_s))
    other = Trajectory([X(k) for k in range(24)], [stamp + 20_000_000 for stamp in street.stamps_ns])
    term = street.term(4, AlignmentKeys(other, E, D))
    matches = term.matched(values, 5.0)
    assert matches.state is TermState.NO_SCAN_POSE and matches.pose_away_s == pytest.approx(0.02)
    assert "the nearest is 20 ms away" in str(matches)
    with pytest.raises(EstimationError, match="the nearest pose is 20 ms from a scan"):
        match_all([term], values, 5.0, 1.0)
    values.erase(X(5))
    term = street.term(4, AlignmentKeys(street.trajectory(), E, D))
    assert term.matched(values, 5.0).state is TermState.POSE_MISSING
    for k in (2, 3, 4, 6):
        values.erase(X(k))
    missing = term.matched(values, 5.0)
    assert missing.state is TermState.POSE_MISSING and "scan's stamp" in str(missing)


def test_stamps_that_were_seconds_are_those_of_the_scans(street: Street) -> None:
    """A pose's stamp in seconds, as a double or a text with six decimals, is some hundred nanoseconds off."""
    base_ns = 1_700_000_000_123_456_789
    _, values = street.whole((street.cTl, street.time_offset_s))
    scans = [replace(scan, stamp_ns=base_ns + scan.stamp_ns) for scan in street.scans[2:7]]
    image = replace(street.images[4], stamp_ns=base_ns + street.images[4].stamp_ns)
    whole = [base_ns + stamp for stamp in street.stamps_ns]
    found = []
    for stamps in (whole, [int(1e9 * (1e-9 * ns)) for ns in whole], [ns // 1000 * 1000 for ns in whole]):
        keys = AlignmentKeys(Trajectory([X(k) for k in range(24)], stamps), E, D)
        matches = AlignmentTerm(scans, image, street.camera, keys).matched(values, 5.0)
        assert matches.factor is not None
        found.append((len(matches), matches.factor.error(values)))
    assert found[0][0] == found[1][0] == found[2][0]
    assert [error for _, error in found] == pytest.approx([found[0][1]] * 3, rel=1e-4)
    with pytest.raises(DataError, match="a pose"):
        Trajectory().nearest_s(0.5)  # type: ignore[arg-type]
    assert Trajectory().nearest_s(5) == float("inf") and Trajectory().position(5) is None


def test_few_matches_are_reported(street: Street) -> None:
    term = street.term(4, AlignmentKeys(street.trajectory(), E, D))
    term = replace(term, config=TermConfig(min_matches=10_000))
    _, values = street.whole((street.cTl, street.time_offset_s))
    assert term.matched(values, 5.0).state is TermState.FEW_MATCHES


def test_keys_may_be_constants_a_double_or_of_a_body(street: Street) -> None:
    """The offset as a double, the poses those of a body: the same estimate."""
    bTl = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([0.8, -0.3, 1.7]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(len(street.scans)):
        _, starts = street.new_at(k, street.start(1))
        wTb = starts.atPose3(X(k)) * bTl.inverse()
        values.insert(X(k), wTb)
        graph.add(gtsam.PriorFactorPose3(X(k), wTb, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    cTl, time_offset_s = street.start(1)
    values.insert(E, cTl)
    values.insert(D, time_offset_s)
    graph.add(gtsam.PriorFactorPose3(E, cTl, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    graph.add(time_offset_prior(D, time_offset_s, 1.0, double=True))
    keys = AlignmentKeys(street.trajectory(), E, D, bTl=bTl)
    terms = [street.term(k, keys) for k in range(len(street.images))]
    found = solve_with_terms(graph, values, terms).values
    assert street.cTl.equals(found.atPose3(E), 0.02)
    assert found.atDouble(D) == pytest.approx(street.time_offset_s, abs=0.005)


def test_a_known_extrinsic_leaves_the_offset(street: Street) -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(len(street.scans)):
        _, starts = street.new_at(k, street.start(1))
        values.insert(X(k), starts.atPose3(X(k)))
        graph.add(
            gtsam.PriorFactorPose3(X(k), starts.atPose3(X(k)), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))
        )
    values.insert(D, np.array([street.time_offset_s + 0.03]))
    graph.add(time_offset_prior(D, street.time_offset_s + 0.03, 1.0))
    keys = AlignmentKeys(street.trajectory(), street.cTl, D)
    solution = solve_with_terms(graph, values, [street.term(k, keys) for k in range(len(street.images))])
    assert solution.values.atVector(D)[0] == pytest.approx(street.time_offset_s, abs=0.005)
    assert np.count_nonzero(solution.covariance) == 1 and 0.0 < solution.covariance[6, 6] < 0.01**2


def test_refuses_what_is_no_term(street: Street) -> None:
    graph, values = street.whole(street.start(1))
    with pytest.raises(EstimationError, match="no term"):
        solve_with_terms(graph, values, [])
    far = replace(street, time_offset_s=500.0).whole((street.cTl, 500.0))
    with pytest.raises(EstimationError, match=r"no factor in 24 terms .* lies after the last pose"):
        solve_with_terms(*far, terms_of(street))
    with pytest.raises(DataError, match="a stamp after 5 ns"):
        Trajectory([X(0), X(1)], [5, 5])
    with pytest.raises(DataError, match="2 keys, 1 stamp"):
        Trajectory([X(0), X(1)], [5])
    keys = AlignmentKeys(street.trajectory(), E, D)
    with pytest.raises(DataError, match="no scan"):
        AlignmentTerm([], street.images[0], street.camera, keys)


# --- real drives


def real(path: Path) -> Street:
    source = open_source(path, image_shift=1)
    config = PrepareConfig(use_visual_odometry=False)
    drive = prepare_drive(source, [SemanticClass.VEHICLE], config, with_lower_edges=False)
    assert source.truth is not None and source.truth.time_offset_s is not None
    truth = source.truth.cTl, source.truth.time_offset_s
    return Street(drive.camera, drive.scans, drive.images, drive.lidar_motions, *truth)


def as_documented(path: Path) -> Street:
    """By the code of docs/graph/slam.md: odometry from scan to scan."""
    source = open_source(path)
    frames = [(each.scan, each.image) for each in source if each.scan is not None and each.image is not None]
    features = [features_of(scan, image, VEHICLES, source.camera) for scan, image in frames]
    motions = scan_to_scan([RegisteredScan(scan) for scan, _ in frames])
    assert source.truth is not None
    scans, images = zip(*features, strict=True)
    return Street(source.camera, scans, images, tuple(motions), source.truth.cTl, 0.0)


@pytest.fixture(scope="module")
def stop() -> Street:
    return real(STOP)


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not STOP.is_dir(), reason="no ../shared")
@pytest.mark.parametrize("kind", ["lm", "isam2", "smoother"])
def test_a_real_drive(stop: Street, kind: str) -> None:
    """2 deg, 7.5 cm, 30 ms off under priors of 1 rad, 1 m, 1 s: within 0.25 deg, 2 cm, 15 ms."""
    start = stop.start(0)
    if kind == "lm":
        solution = solve_with_terms(*stop.whole(start, WIDE), terms_of(stop))
        values, covariance = solution.values, solution.covariance
    else:
        found = stop.frame_by_frame(solver_of(kind, 4.05), start)
        values, covariance = found.values, found.covariance
    rotation_deg, translation_m, time_offset_s = stop.errors(values)
    assert rotation_deg < 0.25 and translation_m < 0.02 and time_offset_s < 0.015
    assert stop.nees(values, covariance, KITTI_TRUTH) < 14.0
    sigmas = np.sqrt(np.diag(covariance))
    assert (sigmas[:3] < np.radians(0.5)).all() and (sigmas[3:6] < 0.05).all() and sigmas[6] < 0.02


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not STOP.is_dir(), reason="no ../shared")
@pytest.mark.parametrize("seed", [0, 1])
def test_a_real_drive_whose_first_images_mislead(seed: int) -> None:
    """At one speed its first 24 images say 100 ms as well as 0; all 60 tell them apart."""
    drive = as_documented(STOP)
    start = drive.start(seed)[0], drive.time_offset_s - 0.03
    found = drive.frame_by_frame(solver_of("isam2", 0.0), start)
    rotation_deg, translation_m, time_offset_s = drive.errors(found.values)
    assert rotation_deg < 0.25 and translation_m < 0.02 and time_offset_s < 0.015


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not PARKED.is_dir(), reason="no ../shared")
@pytest.mark.parametrize("with_bias", [False, True])
def test_a_drive_at_one_speed_gives_a_warning_and_its_covariance_holds(with_bias: bool) -> None:
    """Nothing separates forward from later there: 20 to 45 cm off, and known to be."""
    drive = real(PARKED)
    keys = AlignmentKeys(drive.trajectory(), E, D, {SemanticClass.VEHICLE: B} if with_bias else {})
    graph, values = drive.whole(drive.start(0), WIDE)
    if with_bias:
        graph.add(time_offset_prior(B, 0.0, 3.0))
        values.insert(B, np.zeros(1))
    terms = [drive.term(k, keys) for k in range(len(drive.images))]
    solution = solve_with_terms(graph, values, terms)
    weak = [w for w in solution.warnings if w.kind is WarningKind.WEAK_DIRECTION]
    assert weak and "cannot be distinguished from the image taken later" in weak[0].detail
    off = np.append(
        drive.cTl.localCoordinates(solution.values.atPose3(E)),
        solution.values.atVector(D)[0] - drive.time_offset_s,
    )
    assert np.abs(off[[3, 6]] / np.sqrt(np.diag(solution.covariance)[[3, 6]])).max() < 3.0
    assert drive.nees(solution.values, solution.covariance, KITTI_TRUTH) < 18.5  # 99 % of 7
