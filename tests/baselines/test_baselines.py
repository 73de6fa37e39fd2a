"""The paper's method, its static stage and SemAlign: on a small exact street, and on what cannot work."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated, written

from sst_graph.association.nearest import ClassView
from sst_graph.baselines.nearest_pixel_frames import (
    EXTRINSIC,
    MatchFrame,
    frame_pairs,
    match_frames,
    step_once,
)
from sst_graph.baselines.second_search import SecondSearch
from sst_graph.baselines.semalign import sampled_poses, truncated_distances
from sst_graph.baselines.sst_calib import (
    PaperConfig,
    PaperProblem,
    camera_motions,
    solve_static,
    velocity_at,
)
from sst_graph.batch import CalibrationConfig, calibrate, calibrate_prepared
from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.errors import ConfigError
from sst_graph.experiments.starts import errors_of
from sst_graph.factors import beta_regularizer
from sst_graph.metrics import calibration_errors
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Calibration, GroundTruth, SemanticClass

METHODS = ("paper", "static", "semalign")
OFFSET_S = 0.15
STREET = SimulationConfig(
    seed=3,
    frames=18,
    frame_rate_hz=5.0,
    width=480,
    height=145,
    motion="stop_and_go",
    time_offset_s=OFFSET_S,
    azimuth_limit_deg=45.0,
    label_noise=0.0,
    moving_fraction=0.0,
    vehicle_density=0.3,
    azimuth_step_deg=0.4,
)


@pytest.fixture(scope="module")
def street() -> Path:
    """A street on disk with exact labels: seven frames at rest, then an acceleration to 6 m/s."""
    return written(STREET)


@pytest.fixture(scope="module")
def truth(street: Path) -> GroundTruth:
    found = open_source(street).truth
    assert found is not None
    return found


@pytest.fixture(scope="module")
def drive(street: Path) -> Drive:
    return prepare_drive(open_source(street), (SemanticClass.VEHICLE,))


def config_of(method: str) -> CalibrationConfig:
    return dataclasses.replace(CalibrationConfig(), method=method)


def off_start(truth: GroundTruth) -> gtsam.Pose3:
    """The true pose, wrong by 2.3 deg and 3 cm."""
    turn = np.radians([-1.5, 1.0, 1.4])
    return gtsam.Pose3(
        gtsam.Rot3.Expmap(turn) * truth.cTl.rotation(), truth.cTl.translation() + np.array([0.03, 0, 0])
    )


@pytest.mark.slow
def test_the_paper_comes_nearer_in_rotation_and_time(drive: Drive, truth: GroundTruth) -> None:
    start = off_start(truth)
    result = calibrate_prepared([drive], start, config_of("paper"))
    errors, before = errors_of(result, truth), calibration_errors(start, 0.0, truth)
    assert errors.qad_deg < 0.5 * before.qad_deg
    assert errors.time_offset_s is not None and abs(errors.time_offset_s) < 0.6 * OFFSET_S
    assert result.method == "paper" and result.diagnostics["moving_frames"] >= 8
    assert 2 <= result.diagnostics["standstill_frames"] <= 7
    assert {frame.drive for frame in result.frames_used} == {drive.name}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["static", "semalign"])
def test_space_alone_leaves_the_offset_open(drive: Drive, truth: GroundTruth, method: str) -> None:
    start = off_start(truth)
    result = calibrate_prepared([drive], start, config_of(method), initial_time_offset_s=0.02)
    assert errors_of(result, truth).qad_deg < 0.6 * calibration_errors(start, 0.0, truth).qad_deg
    assert result.time_offset_s == 0.02
    assert result.status != "ok" and any("time offset is known to 1000" in r for r in result.reasons)
    assert np.sqrt(result.covariance[6, 6]) == pytest.approx(1.0, rel=0.01)
    standing = {frame.frame for frame in result.frames_used}
    assert standing and max(standing) <= 7


def test_one_step_at_a_time_brings_the_delay(drive: Drive, truth: GroundTruth) -> None:
    """From the true pose, held by beta, every step moves the offset towards the truth."""
    pairs = [pair for pair in frame_pairs([drive]) if pair.image.index >= 10]
    frames = match_frames(pairs, [drive], (SemanticClass.VEHICLE,), 0.02, 0)
    at = Calibration(truth.cTl, 0.0)
    motions = camera_motions([drive], at, [None])[0]
    frames = [f.moving_at(velocity_at(motions, f.pair.image_position)) for f in frames]
    beta = beta_regularizer(EXTRINSIC, truth.cTl, 1e6, 1e9)
    for _ in range(5):
        moved = step_once(frames, at, 5.0, beta, offset_free=True)
        assert at.time_offset_s < moved.time_offset_s < 1.2 * OFFSET_S
        assert np.abs(truth.cTl.localCoordinates(moved.cTl)).max() < 0.05
        at = moved


def test_the_single_directional_loss_leaves_the_pixels_out(drive: Drive, truth: GroundTruth) -> None:
    """As many steps as the static stage makes, by hand with w_l = 0."""
    config = PaperConfig(static_frames=2, bidirectional=False)
    problem = PaperProblem([drive], (SemanticClass.VEHICLE,), config)
    start = Calibration(off_start(truth), 0.0)
    found = solve_static(problem, start)
    at = start
    for _ in range(60):
        at = step_once(found.frames, at, 0.0)
    assert found.calibration.cTl.equals(at.cTl, 1e-9)
    both = PaperProblem([drive], (SemanticClass.VEHICLE,), dataclasses.replace(config, bidirectional=True))
    assert not solve_static(both, start).calibration.cTl.equals(at.cTl, 1e-3)


def test_velocities_are_those_of_the_street(drive: Drive, truth: GroundTruth) -> None:
    at = Calibration(truth.cTl, OFFSET_S)
    first = camera_motions([drive], at, [None])
    motions = camera_motions([drive], at, first)[0]
    source = simulated(STREET)
    stamps = source.stamps_ns * 1e-9
    for k in range(10, STREET.frames):
        step = source.wTc(stamps[k - 1]).between(source.wTc(stamps[k])).translation()
        true_speed = np.linalg.norm(step) / (stamps[k] - stamps[k - 1])
        assert np.linalg.norm(velocity_at(motions, k)) == pytest.approx(true_speed, rel=0.1, abs=0.1)


def test_without_a_guess_there_is_no_estimate(drive: Drive) -> None:
    for method in METHODS:
        result = calibrate_prepared([drive], None, config_of(method))
        assert result.status == "unobservable" and "needs a guess" in result.reasons[0]


def test_a_camera_that_sees_no_point(drive: Drive, truth: GroundTruth) -> None:
    behind = gtsam.Pose3(gtsam.Rot3.Ry(np.pi) * truth.cTl.rotation(), truth.cTl.translation())
    for method in METHODS:
        result = calibrate_prepared([drive], behind, config_of(method))
        assert result.status == "unobservable"
        # The paper finds no depth either, and so no standing frame.
        missing = "no standing frame" if method == "paper" else "no labelled point of any frame"
        assert missing in result.reasons[0]
        assert result.T_camera_lidar.equals(behind, 1e-12)


@pytest.mark.slow
def test_the_paper_reports_missing_motion(drive: Drive, truth: GroundTruth) -> None:
    still = dataclasses.replace(
        drive, scans=drive.scans[:5], images=drive.images[:5], image_pairs=drive.image_pairs[:4]
    )
    result = calibrate_prepared([still], truth.cTl, config_of("paper"))
    assert result.status != "ok" and result.time_offset_s == 0.0
    assert any("joint stage was left out" in reason for reason in result.reasons)
    assert np.sqrt(result.covariance[6, 6]) > 0.9


@pytest.mark.slow
def test_without_a_stop(drive: Drive, truth: GroundTruth) -> None:
    moving = dataclasses.replace(
        drive, scans=drive.scans[11:], images=drive.images[11:], image_pairs=drive.image_pairs[11:]
    )
    paper = calibrate_prepared([moving], truth.cTl, config_of("paper"))
    assert paper.status == "unobservable" and "no standing frame" in paper.reasons[0]
    static = calibrate_prepared([moving], truth.cTl, config_of("static"))
    assert static.status != "ok" and any("no frame is known to stand" in r for r in static.reasons)


def test_time_offset_per_drive_needs_method_joint(street: Path) -> None:
    settings = dataclasses.replace(config_of("paper"), time_offset_per_drive=True)
    with pytest.raises(ConfigError, match="time_offset_per_drive needs method joint, found paper"):
        calibrate(open_source(street), gtsam.Pose3(), settings)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_methods_from_the_command_line(street: Path, tmp_path: Path, method: str) -> None:
    out = tmp_path / "result"
    code = main(["calibrate", str(street), "--method", method, "--frames", "0:4", "--out", str(out)])
    result = read_result(out / "calibration.json")
    assert (code, result.method) == (3, method)
    assert result.status != "ok" and result.reasons and len(list(out.glob("*.png"))) >= 1
    assert result.frames_used and result.config["paper"]["lambda_r"] == 1e9


@pytest.mark.parametrize("method", METHODS)
def test_no_vehicle_in_any_frame(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    shutil.copytree(street, tmp_path / "bare")
    for labels in (tmp_path / "bare").rglob("*.label"):
        numbers = np.fromfile(labels, "<u4") & 0xFFFF
        labels.write_bytes(np.where(np.isin(numbers, [10, 18]), 0, numbers).astype("<u4").tobytes())
    options = ["--method", method, "--frames", "0:4", "--out", str(tmp_path / "result")]
    assert main(["calibrate", str(tmp_path / "bare"), *options]) == 3
    *_, reason = capsys.readouterr().err.splitlines()
    assert reason.startswith("sst-graph: unobservable: no ")
    assert read_result(tmp_path / "result" / "calibration.json").status == "unobservable"


def test_one_frame_is_not_enough_for_the_paper(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--frames", "0:1", "--out", str(tmp_path / "result")]
    assert main(["calibrate", str(street), "--method", "paper", *options]) == 3
    assert "unobservable: no standing frame" in capsys.readouterr().err


def test_samples_stay_in_their_box() -> None:
    guess = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, 0.1), np.array([1.0, 2.0, 3.0]))
    poses = sampled_poses(guess, seed=0)
    assert poses[0].equals(guess, 1e-12)
    turns = [gtsam.Rot3.Logmap(p.rotation() * guess.rotation().inverse()) for p in poses]
    shifts = [p.translation() - guess.translation() for p in poses]
    assert 9.5 < np.degrees(np.abs(turns).max()) <= 10.0
    assert 0.095 < np.abs(shifts).max() <= 0.1


def test_truncated_distances_by_hand(drive: Drive) -> None:
    """A point 30 px left of the mask, one on it, one behind the camera: (20 + 0 + 20) / 3 at 20 px."""
    mask = np.zeros((drive.camera.height, drive.camera.width), np.uint8)
    camera, row = drive.camera, round(drive.camera.cy)
    mask[:, 300:] = SemanticClass.VEHICLE
    u = np.array([270.0, 310.0, 310.0])
    z = np.array([10.0, 10.0, -10.0])
    lPs = np.column_stack([(u - camera.cx) / camera.fx, np.full(3, (row - camera.cy) / camera.fy), [1, 1, 1]])
    rng = np.random.default_rng(0)
    view = ClassView.of(camera, lPs * z[:, None], 0.0, mask == SemanticClass.VEHICLE, 0.1, rng)
    assert view is not None
    frame = MatchFrame(frame_pairs([drive])[0], "drive", (view,), np.zeros(6))
    found = truncated_distances(frame, [gtsam.Pose3()], 20.0)
    np.testing.assert_allclose(found, [40.0 / 3.0])


@pytest.mark.parametrize(
    ("scores", "reasons"),
    [((0.05, 0.12, 0.13), 0), ((0.05, 0.10, 0.13), 1), ((0.12, 0.11, 0.115), 1), ((0.0, -0.1, -0.05), 2)],
)
def test_a_second_search(scores: tuple[float, float, float], reasons: int) -> None:
    assert len(SecondSearch(*scores).reasons) == reasons
