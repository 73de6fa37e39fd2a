"""Assumptions in the tracker: considered, tested, estimated."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gtsam
import numpy as np
import pytest
from linear_systems import system_of
from numpy.typing import NDArray
from stored import simulated
from streets import TRACKED_STREET

from sst_graph import Tracker, TrackerConfig
from sst_graph.assumptions import ASSUMPTIONS, held_at_zero
from sst_graph.batch.assumption_tests import with_test_results
from sst_graph.config import with_overrides
from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.covariance.considered import AssumptionConfig, considered_by_matches
from sst_graph.covariance.level_edges import MOMENTS, LevelSums
from sst_graph.covariance.sums import ScoreSums
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import ImageFeatures, prepare_drive
from sst_graph.errors import ConfigError
from sst_graph.experiments.wrong_drives import with_distortion, with_principal_point
from sst_graph.fit import mask_biases_px
from sst_graph.graph.building import joint_graph
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.outer_loop import JointProblem, solve_joint
from sst_graph.graph.state import State, nuisance_key
from sst_graph.objects.tracks import object_tracks
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.track_update import current_update
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.tracker.window.window import Window
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
K1 = -0.3


def _config(*settings: str) -> TrackerConfig:
    """Settings of a tracker that trusts its guess and does not wait for frames that confirm it."""
    own = ["calibration.search.enabled=false", "start_scans=10", "alarm.enabled=false"]
    return with_overrides(TrackerConfig(), [*own, *settings])


@pytest.fixture(scope="module")
def street() -> KeptDrive:
    """The first frames of the street that trackers are tried on."""
    drive = simulated(TRACKED_STREET)
    frames = tuple(drive[position] for position in range(24))
    return KeptDrive(drive.name, drive.camera, drive.nominal, drive.truth, frames, drive.sweep)


@pytest.fixture(scope="module")
def distorted(street: KeptDrive) -> KeptDrive:
    """The same through a lens with radial distortion."""
    return with_distortion(street, K1)


def _tracked(drive: KeptDrive, *settings: str, optimize: bool = True) -> Tracker:
    assert drive.truth is not None
    tracker = Tracker(drive.camera, _config(*settings), drive.truth.cTl, 0.03)
    for frame in drive:
        tracker.add(frame)
    if optimize:
        tracker.optimize()
    return tracker


@pytest.fixture(scope="module")
def optimized(street: KeptDrive) -> Tracker:
    """The street's tracker at its end, with all frames in the window."""
    return _tracked(street)


@pytest.fixture(scope="module")
def estimating(distorted: KeptDrive) -> Tracker:
    """The distorted street's tracker at its end, with the distortion as a variable."""
    return _tracked(distorted, 'calibration.assumptions.estimate=["k1"]')


@pytest.fixture(scope="module")
def leaving(distorted: KeptDrive) -> Tracker:
    """The same while it runs; most frames have left its window."""
    return _tracked(distorted, 'calibration.assumptions.estimate=["k1"]', "window=12", optimize=False)


def _state(tracker: Tracker) -> State:
    """The state at which all matches of a tracker's window were made."""
    assert tracker.estimate.smoother is not None
    points = [entry.linear.information.point for entry in tracker.estimate.smoother.entries.values()]
    assert all(point.cTl.equals(points[0].cTl, 0.0) for point in points)
    state = points[0].state(tracker.matcher.classes)
    seen = [(point.tracks, point.object_biases_px.tolist()) for point in points]
    biases = {(0, track): bias for own in seen for track, bias in zip(*own, strict=True)}
    return dataclasses.replace(state, object_biases_px={**state.object_biases_px, **biases})


@pytest.mark.slow
def test_matches_of_a_moving_window_stay_in_the_world_of_the_drive(leaving: Tracker) -> None:
    assert leaving.estimate.smoother is not None
    entries = leaving.estimate.smoother.entries
    first = min(entries)
    assert first > 0
    for number, entry in entries.items():
        assert entry.pair.wTl is not None and entry.pair.wTl.equals(leaving.inputs.window.poses[number], 1e-9)
    assert np.linalg.norm(leaving.inputs.window.poses[first].translation()) > 1.0
    # Level edges have left the window, too, and what stays of their errors counts.
    level = leaving.estimate.smoother.sums.scores.level
    assert np.linalg.eigvalsh(level.variance())[-1] > 0.0


@pytest.mark.slow
def test_what_the_tracker_considers_is_what_the_batch_does(optimized: Tracker) -> None:
    """The batch's function on the window's own matches, at the tracker's state."""
    assert optimized.estimate.smoother is not None
    entries = dict(sorted(optimized.estimate.smoother.entries.items()))
    assert list(entries) == list(range(len(entries))) and not optimized.estimate.smoother.sums.recent
    pairs, state = [entry.pair for entry in entries.values()], _state(optimized)
    guess = State(
        optimized.initializer.guess.cTl or gtsam.Pose3(), (optimized.initializer.guess.time_offset_s,)
    )
    graph, values = joint_graph(pairs, state, optimized.matcher.graph, guess)
    robust = robust_covariance(
        system_of(graph, values), values, pairs, state, [optimized.inputs.window.objects_of(list(entries))[0]]
    )
    plain = considered_by_matches(
        robust, pairs, values, state, optimized.setup.config.calibration.assumptions
    )
    expected = with_test_results(plain, optimized.estimate.findings)
    found = optimized.estimate.considered()
    assert dict(found.sigmas) == dict(expected.sigmas) and set(found.sigmas) == set(ASSUMPTIONS)
    scale = np.sqrt(np.diag(optimized.estimate.covariance)[:7])
    for name, step in expected.sensitivities.items():
        size = np.linalg.norm(step / scale)
        np.testing.assert_allclose(found.sensitivities[name] / scale, step / scale, atol=1e-3 * size)
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance(7))), np.sqrt(np.diag(expected.covariance(7))), rtol=1e-3
    )
    total = optimized.estimate.covariance[:7, :7] + expected.covariance(7)
    np.testing.assert_allclose(np.diag(optimized.estimate.reported_covariance()), np.diag(total), rtol=1e-3)


N, HELD = 9, 3


def _holding(seed: int, tracks: tuple[int, ...] = ()) -> tuple[Gaussian, FloatArray]:
    """A Gaussian with held parameters, and its rows."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((40, N + len(tracks) + HELD))
    point = Point(gtsam.Pose3(), 0.1, np.zeros(2), tracks, np.zeros(len(tracks)))
    return Gaussian(point, A.T @ A, rng.standard_normal(A.shape[1])), A


def test_held_parameters_are_conditioned_on_and_follow_everything() -> None:
    """Solved for as if they were unknowns, they agree with the dense problem after each operation."""
    gaussian, _ = _holding(1, (4, 7))
    assert gaussian.held == HELD
    n = gaussian.point.size
    np.testing.assert_array_equal(gaussian.without_held().information, gaussian.information[:n, :n])
    covariance, mean = (
        np.linalg.inv(gaussian.information),
        np.linalg.solve(gaussian.information, gaussian.vector),
    )
    smaller, T = gaussian.without([4])
    kept = [*range(N), N + 1, *range(n, n + HELD)]
    np.testing.assert_allclose(np.linalg.inv(smaller.information), covariance[np.ix_(kept, kept)], atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(smaller.information, smaller.vector), mean[kept], atol=1e-9)
    np.testing.assert_allclose(T @ gaussian.vector, smaller.vector, atol=1e-12)
    walk = np.linspace(0.1, 0.5, 7)
    after = gaussian.drifted(walk)
    expected = covariance + np.diag([*walk, *np.zeros(n + HELD - 7)])
    np.testing.assert_allclose(np.linalg.inv(after.information), expected, atol=1e-8)
    step = np.linspace(-0.01, 0.01, n)
    step[:6] = 0.0
    moved = gaussian.at(gaussian.point.moved(step))
    away = np.append(step, np.zeros(HELD))
    np.testing.assert_allclose(np.linalg.solve(moved.information, moved.vector), mean - away, atol=1e-9)
    wider = gaussian.with_objects({9: 0}, 0.5)
    assert wider.held == HELD and wider.point.tracks == (4, 7, 9)
    again, _ = wider.without([9])
    np.testing.assert_allclose(again.information, gaussian.information, atol=1e-9)
    np.testing.assert_allclose(again.vector, gaussian.vector, atol=1e-9)


def test_gaussians_without_held_parameters_ignore_those_of_others() -> None:
    whole, _ = _holding(2, (4,))
    own = whole.without_held()
    assert own.plus(whole).held == 0
    np.testing.assert_allclose(own.plus(whole).information, 2.0 * own.information)
    nothing = own.holding(HELD)
    np.testing.assert_allclose(nothing.plus(whole).information[N + 1 :], whole.information[N + 1 :])
    np.testing.assert_allclose(nothing.vector_with([whole]), nothing.plus(whole).vector)
    np.testing.assert_allclose(nothing.information_with([whole]), nothing.plus(whole).information)
    np.testing.assert_allclose(own.information_with([whole]), own.plus(whole).information)


def test_new_unknowns_come_before_what_is_held() -> None:
    sums, rng = RunningSums.empty(4, held=2), np.random.default_rng(3)
    A = rng.standard_normal((9, 6))
    H = A.T @ A
    sums.scores = ScoreSums(
        H, H, H, np.array([5]), A[:1], LevelSums(A[1:2], np.ones((1, MOMENTS)), H, np.eye(3))
    )
    sums.grow(5)
    there, grown = [0, 1, 2, 3, 5, 6], sums.scores
    for M in (grown.independent, grown.side_frames, grown.closed, grown.level.closed):
        np.testing.assert_array_equal(M[np.ix_(there, there)], H)
        assert not M[4].any()
    for rows, old in ((grown.scores, A[0]), (grown.level.scores, A[1])):
        assert rows[0].tolist() == np.insert(old, 4, 0.0).tolist()
    assert sums.objects.closed.shape == (5, 5)


def test_time_counts_from_the_first_image_whatever_is_kept(street: KeptDrive) -> None:
    window = Window(street.camera, 3)
    for number in range(5):
        mask = np.zeros((2, 2), np.uint8)
        window.add_image(ImageFeatures(number, 1_000_000_000 + number * 100_000_000, mask, {}))
    window.forget_images(0, 0, 2)
    assert window.images[0].stamp_ns == 1_300_000_000
    assert window.drive()[0].origin_ns == 1_000_000_000


def test_a_clean_street_contradicts_nothing(optimized: Tracker) -> None:
    update = current_update(optimized)
    assert update.contradictions == () and update.status == "ok" and update.estimated == {}
    diagnostics = optimized.result("a/00").diagnostics
    bias_px = float(optimized.estimate.point.biases_px[0])
    assert mask_biases_px(diagnostics, "a/00") == {SemanticClass.VEHICLE: bias_px} and bias_px != 0.0
    report = diagnostics["assumptions"]
    assert list(report) == list(ASSUMPTIONS)
    tested = {name for name, entry in report.items() if "estimate" in entry}
    assert tested == {name for name, assumption in ASSUMPTIONS.items() if assumption.by_matches}
    assert not any(entry.get("contradicted") for entry in report.values())


def test_a_wrong_principal_point_is_named(street: KeptDrive) -> None:
    drive = with_principal_point(street, 20.0, 0.0)
    # A dozen vehicles in half-size pictures determine it to 16 px at most: the threshold is one.
    tracker = _tracked(drive, "calibration.assumptions.threshold=1.0", optimize=False)
    update = current_update(tracker)
    assert update.status == "contradicted" and "principal point cx" in update.contradictions[0]
    assert update.to_dict()["contradictions"] == list(update.contradictions)
    result = tracker.result()
    assert result.status == "not_converged" and result.reasons[0] == update.contradictions[0]
    found = tracker.estimate.findings[0]
    assert found.contradicted and found.score > 1.0
    assert 10.0 < found.value < 30.0  # one step from where matches are near
    # Not tested: nothing is found, and no more is considered than beforehand.
    tracker.estimate.findings = ()
    assert current_update(tracker).contradictions == () and current_update(tracker).status != "contradicted"
    assert tracker.estimate.considered().sigmas["cx"] == ASSUMPTIONS["cx"].sigma
    assert np.all(current_update(tracker).sigmas < update.sigmas)


@pytest.mark.slow
def test_what_is_estimated_agrees_with_the_batch(
    street: KeptDrive, distorted: KeptDrive, optimized: Tracker, estimating: Tracker
) -> None:
    """And it is the answer of the street without distortion."""
    update = current_update(estimating)
    assert update.contradictions == (), update
    value, sigma = update.estimated["k1"]
    assert abs(value - K1) < 3.0 * sigma and sigma < 0.05
    assert held_at_zero(("k1",)) == tuple(estimating.estimate.considered().sigmas)
    # The batch, with the same variable, from the same start.
    config = estimating.setup.config.estimating.calibration
    drive = prepare_drive(distorted, config.classes, config.prepare)
    assert distorted.truth is not None
    tracks = object_tracks(drive)
    joint = dataclasses.replace(
        config.joint,
        graph=dataclasses.replace(config.noise, lower_edges=estimating.matcher.graph.lower_edges),
    )
    start = State(distorted.truth.cTl, (0.03,))
    solution = solve_joint(JointProblem([drive], motions_of([drive], [tracks]), joint), start)
    robust = robust_covariance(solution.system, solution.values, solution.pairs, solution.state, [tracks])
    state, column = solution.state, robust.unknowns.column(nuisance_key("k1"))
    turn = gtsam.Pose3.Logmap(update.T_camera_lidar.between(state.cTl))
    step = np.array([*turn, state.time_offset_s(0) - update.time_offset_s, state.nuisances["k1"] - value])
    sigmas = np.sqrt(np.diag(robust.matrix)[[*range(7), column]])
    assert np.abs(step / sigmas).max() < 1.0, np.round(step / sigmas, 2)
    own = np.sqrt(np.diag(estimating.estimate.covariance)[:7])
    np.testing.assert_allclose([*own, sigma], sigmas, rtol=0.3)
    # Without distortion.
    clean = current_update(optimized)
    back = gtsam.Pose3.Logmap(update.T_camera_lidar.between(clean.T_camera_lidar))
    assert np.abs(back / update.sigmas[:6]).max() < 3.0


def test_a_checkpoint_holds_what_is_estimated(leaving: Tracker, distorted: KeptDrive, tmp_path: Path) -> None:
    assert leaving.estimate.smoother is not None and leaving.estimate.smoother.sums.recent
    leaving.save(tmp_path / "tracker")
    again = Tracker.load(tmp_path / "tracker")
    assert current_update(again).to_dict() == current_update(leaving).to_dict()
    assert current_update(again).to_dict()["estimated"]["k1"]["value"] == pytest.approx(K1, abs=0.1)
    last = distorted[len(distorted) - 1]
    assert last.scan is not None and last.image is not None
    later = [dataclasses.replace(one, stamp_ns=one.stamp_ns + 100_000_000) for one in (last.image, last.scan)]
    for tracker in (leaving, again):
        tracker.add_image(later[0])  # type: ignore[arg-type]
        tracker.add_scan(later[1])  # type: ignore[arg-type]
    assert current_update(again).to_dict() == current_update(leaving).to_dict()


def test_the_marginal_is_of_extrinsic_and_offset_alone(leaving: Tracker) -> None:
    """What is estimated beside them is marginalized out."""
    marginal = leaving.marginal()
    covariance = np.linalg.inv(marginal.information)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(covariance / scale, leaving.estimate.reported_covariance() / scale, atol=1e-6)


def shifted(sigma: float) -> AssumptionConfig:
    return with_overrides(AssumptionConfig(), [f"cx={sigma}", f"cy={sigma}"])


def test_the_principal_point_turns_the_camera(optimized: Tracker) -> None:
    """With the principal point 1 px to the right, the answer turns back as a turn that moves all points by 1
    px."""
    camera, cTl = optimized.setup.camera, optimized.estimate.point.cTl
    step = optimized.estimate.considered().sensitivities["cx"]
    turned = np.asarray(cTl.AdjointMap() @ step[:6])  # a step of the camera
    assert turned[1] == pytest.approx(-1.0 / camera.fx, rel=0.3), turned * camera.fx
    assert abs(turned[0]) < 0.3 / camera.fx


@pytest.mark.parametrize("sigma", [-0.1, float("nan"), float("inf")])
def test_a_sigma_out_of_range_is_refused(sigma: float) -> None:
    with pytest.raises(ConfigError, match="cx: found"):
        shifted(sigma)
