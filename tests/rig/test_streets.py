"""Rigs on simulated streets: two cameras of one LiDAR, with and without what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from rigs import stereo
from stored import stored
from streets import CROWDED_STREET as STREET
from streets import HALF_SIZE

from sst_graph import CalibrationConfig, calibrate
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.factors import FactorError
from sst_graph.odometry.sweep.decision import SweepDecision
from sst_graph.rig import KnownPose, KnownRig, RigMarginal, RigResult, calibrate_rig
from sst_graph.rig.adjustment import adjusted
from sst_graph.rig.calibrate import _NO_OFFSET, _NO_POSE, calibrate_rig_prepared, prepare_rig
from sst_graph.simulator import SimulatedDrive, simulate
from sst_graph.simulator.rig import beside, stereo_pose, with_mounts
from sst_graph.types import CameraImage, Guess, Scan, SemanticClass

NAMES = ("left", "right")


@cache
def rig() -> Mapping[str, SimulatedDrive]:
    return stereo(STREET)


@cache
def drives():
    return stored(
        (STREET, "stereo"), lambda: prepare_rig({n: [d] for n, d in rig().items()}, CalibrationConfig())
    )


@cache
def solved(known: KnownRig | None = None) -> RigResult:
    guesses = {name: Guess(drive.nominal) for name, drive in rig().items()}
    return calibrate_rig_prepared(drives(), guesses, CalibrationConfig(), known or KnownRig())


def _errors(marginal: RigMarginal) -> np.ndarray:
    """(14,) of both cameras."""
    parts = []
    estimates = zip(rig().values(), marginal.extrinsics, marginal.time_offsets_s, strict=True)
    for drive, cTl, time_offset_s in estimates:
        step = gtsam.Pose3.Logmap(cTl.between(drive.truth.cTl))
        parts.append(np.append(step, drive.config.time_offset_s - time_offset_s))
    return np.concatenate(parts)


def _true_pose() -> gtsam.Pose3:
    left, right = (rig()[name].truth.cTl for name in NAMES)
    return right * left.inverse()


class Counting:
    """A source that counts what is read of it."""

    def __init__(self, source: SimulatedDrive) -> None:
        self.source, self.scans, self.images = source, 0, 0

    def __getattr__(self, name: str):
        return getattr(self.source, name)

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, position: int):
        raise AssertionError("scan and image are to be read apart")

    def __iter__(self):
        raise AssertionError("scan and image are to be read apart")

    def read_scan(self, position: int) -> Scan:
        self.scans += 1
        return self.source.read_scan(position)

    def read_image(self, position: int) -> CameraImage:
        self.images += 1
        return self.source.read_image(position)


@pytest.mark.slow
def test_the_images_of_a_further_camera_are_read_and_not_its_scans() -> None:
    few = replace(STREET, frames=6)
    drive = simulate(few)
    further = Counting(with_mounts(drive, {"right": beside(drive, stereo_pose())}, "left")["right"])
    found = prepare_rig({"left": [drive], "right": [further]}, CalibrationConfig(method="joint"))
    left, right = found["left"][0], found["right"][0]
    assert further.images == 6 and further.scans == 2  # the first and the last, for their stamps
    assert right.lidar_motions is left.lidar_motions
    assert [a.boundaries is b.boundaries for a, b in zip(left.scans, right.scans, strict=True)] == [True] * 6
    assert not np.array_equal(left.images[3].mask, right.images[3].mask)
    assert right.statistics is not None and len(right.statistics.images) == 6


@pytest.mark.slow
def test_each_camera_is_as_good_as_alone() -> None:
    """Without anything known, the calibration of a camera is that of the camera by itself."""
    result = solved()
    assert result.status == "ok" and list(result.cameras) == list(NAMES)
    kept = KeptDrive.of(rig()["right"])
    alone = calibrate(kept, kept.nominal, CalibrationConfig(method="joint"))
    own = result["right"]
    assert own.T_camera_lidar.equals(alone.T_camera_lidar, 1e-9)
    np.testing.assert_allclose(own.covariance, alone.covariance, rtol=1e-9)
    assert own.status == alone.status and own.camera_name == "right"


@pytest.mark.slow
def test_errors_within_the_joint_covariance() -> None:
    """NEES of all fourteen, and of the pose between the cameras, below their 99.9 % quantiles."""
    result = solved()
    errors = _errors(result.marginal())
    assert errors @ np.linalg.solve(result.covariance, errors) < 36.1
    pose = result.relative_pose("right", "left")
    step = np.asarray(gtsam.Pose3.Logmap(pose.T_camera_reference.between(_true_pose())))
    assert step @ np.linalg.solve(pose.covariance, step) < 22.5
    assert abs(pose.time_offset_s) < 3.3 * pose.time_offset_sigma_s


@pytest.mark.slow
def test_the_cameras_err_alike() -> None:
    """Both see the same objects by the same points: their translations are positively correlated, and what is
    in common cancels in the pose between them."""
    result = solved()
    assert result.diagnostics["sides_in_common"] > 20
    sigmas = np.sqrt(np.diag(result.covariance))
    correlation = result.covariance / np.outer(sigmas, sigmas)
    assert correlation[:7, 7:].diagonal().mean() > 0.05
    apart = result.covariance.copy()
    apart[:7, 7:] = apart[7:, :7] = 0.0
    independent = replace(result.marginal(), covariance=apart).relative_pose("right", "left")
    pose = result.relative_pose("right", "left")
    assert np.trace(pose.covariance) < np.trace(independent.covariance)


@pytest.mark.slow
def test_a_known_pose_improves_the_weaker_camera() -> None:
    marginal = solved().marginal()
    known = KnownRig((KnownPose("right", "left", _true_pose()),), one_trigger=True)
    after = adjusted(marginal, known)
    sizes = [np.trace(m.of_camera(name)[:6, :6]) for m in (marginal, after) for name in NAMES]
    before_weaker, after_weaker = max(sizes[:2]), max(sizes[2:])
    assert after_weaker < 0.8 * before_weaker
    errors = _errors(after)
    for k in range(2):
        own = errors[7 * k : 7 * k + 7]
        assert own @ np.linalg.solve(after.of_camera(NAMES[k]), own) < 24.4  # 99.9 % of 7


@pytest.mark.slow
def test_a_wrong_known_pose_is_named() -> None:
    """Left and right mixed up: the estimates stay what they are, and nothing is ok."""
    wrong = KnownRig((KnownPose("right", "left", _true_pose().inverse()),))
    result = solved(wrong)
    assert result.status == "not_converged"
    assert "known pose of right in left contradicts the estimates" in result.reasons[0]
    for name in NAMES:
        assert result[name].status == "not_converged" and result[name].reasons[0] == result.reasons[0]
        assert result[name].T_camera_lidar.equals(solved()[name].T_camera_lidar, 1e-9)
    assert not result.diagnostics["known_poses"][0]["used"]


@pytest.mark.slow
def test_a_camera_without_masks_has_its_pose_from_the_other() -> None:
    """It has no estimate of its own; the known pose and the common trigger give it one, and ok."""
    blind = [replace(drives()["right"][0], images=_without_masks())]
    guesses = {name: Guess(drive.nominal) for name, drive in rig().items()}
    both = {"left": drives()["left"], "right": blind}
    known = KnownRig((KnownPose("right", "left", _true_pose()),), one_trigger=True)
    result = calibrate_rig_prepared(both, guesses, CalibrationConfig(), known)
    right = result["right"]
    assert result["left"].status == "ok" and right.status == "ok"
    assert right.reasons[0].startswith("its own images give no estimate")
    assert right.fit is None and result["left"].fit is not None
    assert right.T_camera_lidar.equals(_true_pose() * result["left"].T_camera_lidar, 1e-6)
    unknown = calibrate_rig_prepared(both, guesses, CalibrationConfig(), KnownRig())
    assert unknown["right"].status == "unobservable" and unknown["left"].status == "ok"
    assert unknown.status == "unobservable"
    assert unknown["right"].reasons[0].startswith("no frame in which LiDAR and camera both show")
    # No record with such images helps: the advice is to mend these, or to say what is known of the rig.
    advice = {direction.advice for direction in unknown["right"].weak_directions}
    assert advice == {_NO_POSE, _NO_OFFSET}
    free = calibrate_rig_prepared(both, guesses, CalibrationConfig(), KnownRig(known.poses))["right"]
    assert [direction.advice for direction in free.weak_directions] == [_NO_OFFSET]


@pytest.mark.slow
def test_cameras_that_are_all_doubtful_keep_their_own_covariances() -> None:
    """The scans do not show their sweep, so neither camera is ok, and none knows better than the other."""
    crawling = {
        name: [replace(drive, sweep=SweepDecision("undecided", drive.sweep.timing, others=both_turns()))]
        for name, (drive,) in drives().items()
    }
    guesses = {name: Guess(drive.nominal) for name, drive in rig().items()}
    known = KnownRig((KnownPose("right", "left", _true_pose()),), one_trigger=True)
    result = calibrate_rig_prepared(crawling, guesses, CalibrationConfig(), known)
    for name in NAMES:
        assert result[name].status == "unobservable" and "enough motion" in result[name].reasons[0]
        assert max(result[name].sigmas().rotation_deg) < 1.0


def both_turns():
    """As measured, turning either way."""
    timing = drives()["left"][0].sweep.timing
    return tuple(replace(timing, fraction=fraction) for fraction in (-1.0, 1.0))


def _without_masks():
    return tuple(
        replace(image, contours={}, mask=np.full_like(image.mask, SemanticClass.IGNORE))
        for image in drives()["right"][0].images
    )


@pytest.mark.slow
def test_a_start_beyond_the_search_is_found_by_the_other_camera() -> None:
    """The guess of the right camera is 60 deg off: solved again from where the known pose puts it."""
    turned = gtsam.Pose3(gtsam.Rot3.Ry(np.radians(60.0)), np.zeros(3))
    right = rig()["right"].nominal
    guesses = {"left": Guess(rig()["left"].nominal), "right": Guess(turned * right)}
    known = KnownRig((KnownPose("right", "left", _true_pose()),))
    result = calibrate_rig_prepared(drives(), guesses, CalibrationConfig(), known)
    error = gtsam.Pose3.Logmap(result["right"].T_camera_lidar.between(rig()["right"].truth.cTl))
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3
    assert result.diagnostics["known_poses"][0]["used"]


@pytest.mark.parametrize(
    ("overrides", "found"),
    [
        (["method=motion"], "need method joint or edges, found motion"),
        (["time_offset_per_drive=true"], "one time offset"),
    ],
)
def test_settings_that_a_rig_has_not(overrides: list[str], found: str) -> None:
    config = with_overrides(CalibrationConfig(), overrides)
    with pytest.raises(ConfigError, match=found):
        calibrate_rig(dict(rig()), config=config)


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({"cameras": None}, "cameras: found None, expected a dict"),
        ({"cameras": [1, 2]}, "cameras: found a list"),
        ({"cameras": {"left": 7}}, "frames to calibrate"),
        ({"cameras": {7: None}}, "name of a camera: found 7"),
        ({"initial": gtsam.Pose3()}, "initial: found a Pose3"),
        ({"initial": {"lift": None}}, "initial: found a guess of 'lift', expected of left, right"),
        ({"initial": {"left": 7}}, "initial: found a int"),
        ({"initial_time_offsets_s": {"left": "1"}}, "initial time offset: found a str"),
        ({"config": {}}, "config: found a dict"),
        ({"known": 7}, "known: found 7"),
    ],
)
def test_what_is_no_rig_is_refused(given: dict, found: str) -> None:
    with pytest.raises((SstGraphError, FactorError), match=found):
        calibrate_rig(**{"cameras": dict(rig()), **given})


@pytest.mark.slow
def test_cameras_that_are_faster_than_the_lidar() -> None:
    """Several images of each scan show a boundary point: it is one error that the cameras have in common."""
    street = replace(HALF_SIZE, seed=3, frames=12, frame_rate_hz=30.0, time_offset_s=0.03, motion="no_stop")
    cameras, guesses = {}, {}
    for name, drive in stereo(street).items():
        kept, guesses[name] = KeptDrive.of(drive), Guess(drive.truth.cTl, 0.03)
        frames = [one if k % 3 == 0 else replace(one, scan=None) for k, one in enumerate(kept.frames)]
        cameras[name] = [replace(kept, frames=tuple(frames))]
    config = CalibrationConfig(use_motion="never")
    prepared = prepare_rig(cameras, config)
    assert all(drive.has_dense_images for own in prepared.values() for drive in own)
    found = calibrate_rig_prepared(prepared, guesses, config, KnownRig())
    sigmas = np.sqrt(np.diag(found.covariance))
    assert 0.1 < (found.covariance / np.outer(sigmas, sigmas))[0, 7] < 1.0


@pytest.mark.slow
def test_cameras_with_other_scans() -> None:
    """One scan fewer, and scans of other stamps."""
    drive = simulate(replace(STREET, frames=2))
    for other in (replace(STREET, frames=1), replace(STREET, frames=2, seed=1)):
        with pytest.raises(DataError, match="expected the 2 scans of"):
            prepare_rig({"left": [drive], "right": [simulate(other)]}, CalibrationConfig())


def test_different_numbers_of_drives() -> None:
    drive = rig()["left"]
    with pytest.raises(ConfigError, match="different numbers of drives"):
        calibrate_rig({"left": [drive, drive], "right": [rig()["right"]]})


def test_a_known_pose_of_another_camera() -> None:
    known = KnownRig((KnownPose("rear", "left", gtsam.Pose3()),))
    with pytest.raises(ConfigError, match="'rear': expected one of left, right"):
        calibrate_rig(dict(rig()), known=known)
