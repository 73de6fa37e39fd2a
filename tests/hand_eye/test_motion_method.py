"""Method motion: exact motions give the calibration back, poor ones say what they leave open."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from moving_drives import OFFSET_S, TRUE, jumping, made_drive, resting, straight, weaving
from stored import written
from streets import standing_street

from sst_graph.batch import CalibrationConfig, calibrate, calibrate_prepared
from sst_graph.batch.method_estimate import jump_sentence, jumps_in
from sst_graph.batch.motion_factor import offsets_held_by_motion
from sst_graph.cli import main
from sst_graph.config import with_overrides
from sst_graph.data import open_source
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.experiments.starts import errors_of
from sst_graph.graph.state import State, difference
from sst_graph.hand_eye.graph import NoiseScales, camera_steps, hand_eye_terms, lidar_paths, pair_motions
from sst_graph.hand_eye.initialization import motion_starts
from sst_graph.hand_eye.solution import MotionSolution, alternative, solve_motion
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Guess


def off(degrees: float) -> gtsam.Pose3:
    return TRUE.retract(np.concatenate([np.radians(degrees) * np.array([0.6, -0.6, 0.5]), [0.1, -0.1, 0.1]]))


def error_of(solution: MotionSolution) -> np.ndarray:
    return difference(State(TRUE, (OFFSET_S,)), solution.state)


@pytest.mark.parametrize("guess", [None, off(20.0)])
def test_without_noise_all_seven_come_back(guess: gtsam.Pose3 | None) -> None:
    solution = solve_motion([made_drive(weaving, noise=0.0)], Guess(guess))[0]
    error = error_of(solution)
    assert solution.converged
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    # The camera's motion has no scale: across the road only, and less well, is the lever arm seen.
    assert np.abs(error[3:6]).max() < 0.1 and abs(error[6]) < 1e-3


def test_stamps_without_a_common_time_are_named() -> None:
    with pytest.raises(EstimationError, match=r"no time offset within 0.5 s of 3600 s .*compare the stamps"):
        solve_motion([made_drive(weaving, noise=0.0)], Guess(None, 3600.0))


@pytest.mark.slow
def test_covariance_fits_the_errors() -> None:
    """NEES of rotation and offset over drives whose noise is as modelled."""
    config = 0.06
    nees = []
    for seed in range(10):
        solution = solve_motion([made_drive(weaving, 40, seed)], Guess(off(5.0), 0.1), config)[0]
        error, some = error_of(solution), [0, 1, 2, 6]
        nees.append(error[some] @ np.linalg.solve(solution.covariance[np.ix_(some, some)], error[some]))
    assert 0.7 < np.mean(nees) < 8.0
    assert max(nees) < 20.0


def swinging(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: 4 m/s, turning to and fro twice a second."""
    yaw = 0.05 * np.sin(4.0 * np.pi * t) + 0.02 * np.sin(1.7 * t)
    rotation = gtsam.Rot3.RzRyRx(0.02 * np.sin(5.0 * t), 0.03 * np.sin(3.1 * t), yaw)
    return gtsam.Pose3(rotation, np.array([4.0 * t, 0.0, 0.0]))


def test_an_offset_that_leaves_few_pairs_gains_nothing_by_them() -> None:
    """Six pairs that fit badly against eleven that fit better, under more noise than odometry states."""
    drive = made_drive(swinging, 14, 3, noise=3.0)
    best, *others = solve_motion([drive], Guess(TRUE), 0.7)
    assert abs(error_of(best)[6]) < 3e-3
    assert all(other.cost > best.cost + 20.0 for other in others)


def rocking(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: 5 m/s, pitching at 1.3 Hz and, less, at 3.1 Hz, which 10 Hz just shows."""
    pitch = 0.003 * np.sin(2.0 * np.pi * 1.3 * t) + 0.0013 * np.sin(2.0 * np.pi * 3.1 * t + 1.0)
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, pitch, 0.05 * t), np.array([5.0 * t, 0.1 * t**2, 0.0]))


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_fast_motion_between_scans_is_in_the_covariance(seed: int) -> None:
    """All images are as far from their scans: the offset makes up for what is smoothed away between them."""
    solution = solve_motion([made_drive(rocking, 60, seed)], Guess(TRUE, OFFSET_S))[0]
    error_s, sigma_s = error_of(solution)[6], np.sqrt(solution.covariance[6, 6])
    assert 1e-3 < abs(error_s) < 2.0 * sigma_s < 4e-3


@pytest.mark.slow
def test_few_pairs_do_not_widen_the_covariance_without_need() -> None:
    """Twelve frames have eleven pairs, but 55 residuals: few clusters are not few residuals."""
    nees, some = [], [0, 1, 2, 6]
    for seed in range(10):
        solution = solve_motion([made_drive(weaving, 12, seed)], Guess(TRUE, OFFSET_S))[0]
        error = error_of(solution)
        nees.append(error[some] @ np.linalg.solve(solution.covariance[np.ix_(some, some)], error[some]))
    assert 0.45 < np.mean(nees) / len(some) < 1.6


def test_a_straight_road_leaves_the_roll_and_the_offset_open() -> None:
    drive = made_drive(straight)
    result = calibrate_prepared([drive], off(3.0), _config())
    assert result.status == "unobservable"
    sigmas = result.sigmas()
    # About the LiDAR's x axis it drives along; the other two axes are seen by the direction of travel.
    assert sigmas.rotation_deg[0] > 5.0 and max(sigmas.rotation_deg[1:]) < 0.1
    assert sigmas.time_offset_ms > 50.0 and min(sigmas.translation_cm) > 20.0
    said = " ".join(result.reasons)
    assert "time offset" in said and "record turns" in said and "the LiDAR's x axis" in said
    error = difference(State(TRUE, (OFFSET_S,)), State(result.T_camera_lidar, (result.time_offset_s,)))
    assert error @ np.linalg.solve(result.covariance, error) < 20.0


def gentle(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: 3 m/s, weaving on level ground."""
    return gtsam.Pose3(gtsam.Rot3.Rz(0.2 * np.sin(0.9 * t)), np.array([3.0 * t, 0.0, 0.0]))


@pytest.mark.parametrize("lidar_noise", [0.2, 1.0])
@pytest.mark.slow
def test_noise_of_the_lidar_does_not_draw_the_offset_to_its_stamps(lidar_noise: float) -> None:
    """Between two stamps it is averaged: what that gains is taken off, and no more where it is small."""
    errors = []
    for seed in range(10):
        drive = made_drive(gentle, 30, seed, lidar_noise=lidar_noise)
        errors.append(1e3 * error_of(solve_motion([drive], Guess(TRUE, OFFSET_S))[0])[6])
    assert abs(np.mean(errors)) < 1.0


@pytest.mark.parametrize("clock_set", [False, True])
def test_motion_tells_a_camera_that_paused_from_a_clock_that_was_set(clock_set: bool) -> None:
    """Twice; the motions between two parts belong to neither."""
    drive = made_drive(weaving, 90, image_clock=jumping(90, (30, 60), clock_set))
    jumps = jumps_in(drive)
    assert [round(1e3 * jump.seconds) for jump in jumps] == [34, 34]
    held = offsets_held_by_motion([drive], State(TRUE, (OFFSET_S,)), CalibrationConfig())
    sentences = [] if clock_set else [jump_sentence(drive, jump) for jump in jumps]
    assert [*held] == sentences
    assert all("by the motion the time offset is the same" in remark for remark in held.values())
    assert not offsets_held_by_motion(
        [drive], State(TRUE, (OFFSET_S,)), CalibrationConfig(check_stamps=False)
    )


@pytest.mark.parametrize("first", [25, 65])
def test_a_scanner_that_paused_is_told_from_a_clock_that_was_set(first: int) -> None:
    """Also away from the middle of the drive."""
    held = []
    for clock_set in (False, True):
        drive = made_drive(weaving, 90, scan_clock=jumping(90, (first,), clock_set))
        (jump,) = jumps_in(drive)
        assert jump.sensor == "scan" and jump.seconds == pytest.approx(0.034)
        held.append(offsets_held_by_motion([drive], State(TRUE, (OFFSET_S,)), CalibrationConfig()))
    assert len(held[0]) == 1 and not held[1]


def test_noise_is_no_turning() -> None:
    """On a straight road the LiDAR's noise alone must tell no offset, wherever between stamps it falls."""
    found = [solve_motion([made_drive(straight, seed=seed)], Guess(TRUE, OFFSET_S))[0] for seed in range(2)]
    assert min(np.sqrt(s.covariance[6, 6]) for s in found) > 0.03


@pytest.mark.slow
def test_noise_that_the_odometry_does_not_know_of_tells_no_roll() -> None:
    """On a straight road a LiDAR that sees itself swerve, and the camera does not, tells no roll."""
    shares = []
    for seed in range(8):
        solution = solve_motion([made_drive(straight, seed=seed, yaw_noise=5.0)], Guess(TRUE, OFFSET_S))[0]
        shares.append(error_of(solution)[0] / np.sqrt(solution.covariance[0, 0]))
    assert np.sqrt(np.mean(np.square(shares))) < 2.5 and np.abs(shares).max() < 3.5


def test_standing_tells_nothing() -> None:
    result = calibrate_prepared([made_drive(resting)], off(3.0), _config())
    assert result.status == "unobservable"
    assert max(result.sigmas().rotation_deg) > 20.0 and result.sigmas().time_offset_ms > 30.0


def test_too_few_frames() -> None:
    result = calibrate_prepared([made_drive(weaving, frames=4)], off(3.0), _config())
    assert result.status == "unobservable" and "pairs of camera and LiDAR motion" in result.reasons[0]
    assert result.T_camera_lidar.equals(off(3.0), 1e-12)


@pytest.mark.slow
def test_two_drives_are_better_than_one() -> None:
    one, two = made_drive(weaving, seed=1), made_drive(weaving, seed=2)
    alone, both = (solve_motion(drives, Guess(TRUE, 0.1))[0] for drives in ([one], [one, two]))
    assert len(both.terms) == 2 * len(alone.terms)
    assert both.covariance[6, 6] < 0.8 * alone.covariance[6, 6]


def test_outliers_count_little() -> None:
    drive = made_drive(weaving)
    pairs = list(drive.image_pairs)
    for k in range(0, len(pairs), 8):  # every eighth image pair saw a bus instead of the street
        motion = dataclasses.replace(
            pairs[k].direction,
            rotation=pairs[k].direction.rotation * gtsam.Rot3.Rx(0.02),
            direction=np.array([1.0, 0, 0]),
        )
        pairs[k] = dataclasses.replace(pairs[k], direction=motion)
    spoilt = dataclasses.replace(drive, image_pairs=tuple(pairs))
    error = error_of(solve_motion([spoilt], Guess(None))[0])
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3 and abs(error[6]) < 3e-3


def test_noise_scales_follow_the_residuals() -> None:
    state = State(TRUE, (OFFSET_S,))
    scales = []
    for noise in (1.0, 3.0):
        drive = made_drive(weaving, frames=120, noise=noise)
        pairs = pair_motions(camera_steps([drive]), lidar_paths([drive]), OFFSET_S)
        scales.append(hand_eye_terms(pairs, state)[1])
    assert scales[0].rotation == pytest.approx(1.0, abs=0.25)
    assert scales[1].rotation == pytest.approx(3.0, abs=0.75)
    assert scales[1].direction > 2.0 * scales[0].direction > 0.0
    assert NoiseScales() == NoiseScales(1.0, 1.0)


def test_odometry_far_worse_than_its_noise_is_a_reason() -> None:
    """Its covariance is scaled to fit; errors that are so large are not white, as it assumes."""
    poor, fair = (
        calibrate_prepared([made_drive(weaving, noise=noise)], TRUE, _config()) for noise in (8.0, 2.0)
    )
    assert poor.status == "not_converged" and "times worse than their noise" in " ".join(poor.reasons)
    assert "times worse" not in " ".join(fair.reasons)


def test_start_without_a_guess() -> None:
    drive = made_drive(weaving)
    starts = motion_starts(camera_steps([drive]), lidar_paths([drive]), Guess(None))
    best = starts[0]
    assert abs(best.time_offset_s - OFFSET_S) <= 0.02
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(best.cRl.between(TRUE.rotation())))) < 2.0
    assert all(a.cost <= b.cost for a, b in pairwise(starts))


def test_an_alternative_is_another_solution_that_fits_alike() -> None:
    best = solve_motion([made_drive(weaving)], Guess(TRUE, OFFSET_S))[0]
    elsewhere = dataclasses.replace(
        best, state=State(best.state.cTl, (OFFSET_S - 0.1,)), cost=best.cost + 1.0
    )
    worse = dataclasses.replace(elsewhere, cost=best.cost + 50.0)
    assert alternative([best, best]) is None
    assert alternative([best, worse]) is None
    assert alternative([best, elsewhere]) is elsewhere


def _config(**changes: object) -> CalibrationConfig:
    return dataclasses.replace(CalibrationConfig(), method="motion", **changes)


@pytest.fixture(scope="module")
def street() -> Path:
    """A street of turns on disk, in small pictures."""
    config = SimulationConfig(
        seed=4,
        frames=20,
        width=621,
        height=188,
        motion="turning",
        azimuth_limit_deg=45.0,
        azimuth_step_deg=0.4,
        vehicle_density=0.3,
        time_offset_s=0.08,
    )
    return written(config)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["dataset", "none"])
def test_from_the_command_line(street: Path, tmp_path: Path, start: str) -> None:
    out = tmp_path / "result"
    code = main(["calibrate", str(street), "--method", "motion", "--init", start, "--out", str(out)])
    result = read_result(out / "calibration.json")
    truth = open_source(street).truth
    assert truth is not None
    errors = errors_of(result, truth)
    # Height and sideways shift stay open on a plane road: never a confident wrong number.
    assert (code, result.status, result.method) == (3, "unobservable", "motion")
    assert errors.qad_deg < 0.6 and errors.time_offset_s is not None and abs(errors.time_offset_s) < 0.006
    assert errors.nees is not None and errors.nees.joint < 25.0
    assert len(result.frames_used) >= 12 and "method joint" in " ".join(result.reasons)


@pytest.mark.slow
def test_the_joint_method_uses_the_motion(street: Path) -> None:
    source = open_source(street, frames="0:12")
    # Labels that determine the offset to 11 ms, not to 3: the motion alone determines it to 32 ms.
    weak = ["search.enabled=false", "noise.side_sigma_px=10"]
    settings = with_overrides(CalibrationConfig(), weak)
    labels_alone = calibrate(source, source.nominal, dataclasses.replace(settings, use_motion="never"))
    with_motion = calibrate(source, source.nominal, dataclasses.replace(settings, use_motion="auto"))
    assert with_motion.diagnostics["motion"]["fused"] is True and not labels_alone.diagnostics["motion"]
    assert with_motion.covariance[6, 6] < labels_alone.covariance[6, 6]
    truth = source.truth
    assert truth is not None and truth.time_offset_s is not None
    assert abs(with_motion.time_offset_s - truth.time_offset_s) < 4.0 * np.sqrt(with_motion.covariance[6, 6])


def test_one_clock_only() -> None:
    settings = dataclasses.replace(CalibrationConfig(), use_motion="always", time_offset_per_drive=True)
    with pytest.raises(ConfigError, match="use_motion"):
        calibrate(standing_street(), None, settings)
