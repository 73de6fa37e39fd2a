"""Parts of the data that contradict each other: drives of two rigs, a knock, a lost image, sliding masks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated
from streets import TRACKED_STREET, picked_frames

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.calibrate import calibrate_prepared, prepare_drives
from sst_graph.batch.contradictions import compare_drives, find_contradictions
from sst_graph.batch.motion_factor import MAX_DISAGREEMENT_CHI2, fuse_motion, with_motion
from sst_graph.batch.part_solver import Part, PartSolver, SolvedPart
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.config import with_overrides
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.contradiction import PartEstimate
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.graph.outer_loop import JointConfig, solve_joint
from sst_graph.graph.state import State
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import FloatArray, Frame, Guess, Source

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
STOP = DATA / "kitti_2011_09_26_stop"
CONFIG = with_overrides(CalibrationConfig(), ["search.enabled=false"])
STREET = SimulationConfig(
    seed=101,
    frames=24,
    width=621,
    height=188,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.3,
    vehicle_density=0.25,
    moving_fraction=0.0,
    motion="no_stop",
    speed_mps=5.0,
)


@cache
def street(motion: str = "no_stop", frames: int = 24) -> SimulatedDrive:
    return simulated(replace(STREET, motion=motion, frames=frames))


@cache
def frames_of(motion: str = "no_stop", frames: int = 24) -> tuple[Frame, ...]:
    return tuple(street(motion, frames))


def edited(source: Source, frames: Sequence[Frame], name: str = "edited") -> KeptDrive:
    """Frames of a drive that were changed, as a source with a name of its own."""
    return KeptDrive(name, source.camera, source.nominal, source.truth, frames)


def knocked(frames: Sequence[Frame], first: int, degrees: float) -> list[Frame]:
    """From a frame on the LiDAR is turned about its own y axis."""
    R = gtsam.Rot3.Ry(np.radians(degrees)).matrix()
    return [
        replace(frame, scan=replace(frame.scan, points=(frame.scan.points @ R.T).astype(np.float32)))
        if frame.index >= first and frame.scan is not None
        else frame
        for frame in frames
    ]


def without_image(frames: Sequence[Frame], lost: int) -> list[Frame]:
    """An image is lost and the numbering goes on: those after it carry the stamps before their own."""
    found = list(frames[:lost])
    for frame, later in zip(frames[lost:], [*frames[lost + 1 :], None], strict=True):
        image = None
        if later is not None and later.image is not None and frame.image is not None:
            image = replace(later.image, stamp_ns=frame.image.stamp_ns)
        found.append(replace(frame, image=image))
    return found


def sliding(frames: Sequence[Frame], pixels: int) -> list[Frame]:
    """The masks drift to the right over the drive."""
    found = []
    for k, frame in enumerate(frames):
        assert frame.image is not None
        shift = round(pixels * k / (len(frames) - 1))
        found.append(
            replace(frame, image=replace(frame.image, mask=np.roll(frame.image.mask, shift, axis=1)))
        )
    return found


def calibrated(sources: Sequence[Source], config: CalibrationConfig = CONFIG) -> CalibrationResult:
    return calibrate_prepared(
        prepare_drives(sources, config),
        street().truth.cTl,
        config,
        initial_time_offset_s=STREET.time_offset_s,
    )


@cache
def prepared() -> list[Drive]:
    """Twelve frames of a clean drive."""
    clean = simulated(TRACKED_STREET)
    return prepare_drives([edited(clean, [clean[k] for k in range(12)])], CONFIG)


def parts_of(drives: Sequence[Drive]) -> PartSolver:
    """Ready to be solved, about the truth."""
    truth, time_offset_s = simulated(TRACKED_STREET).truth.cTl, TRACKED_STREET.time_offset_s
    problem = CalibrationProblem.of(drives, Guess(truth, time_offset_s), CONFIG)
    return PartSolver(problem, State(truth, (time_offset_s,)))


def first_frame_after(result: CalibrationResult) -> int:
    """Of the only step within a drive that a result names, which is also in its reasons."""
    (step,) = result.diagnostics["contradictions"]["within"]
    (reason,) = [reason for reason in result.reasons if "contradict each other" in reason]
    assert f"those from {step['frames'][0]} on" in reason
    return int(step["frames"][0])


@pytest.mark.slow
def test_a_clean_drive_contradicts_nothing() -> None:
    result = calibrated([edited(street(), frames_of())])
    assert result.diagnostics["contradictions"] == {"within": [], "between": {}}
    assert not [reason for reason in result.reasons if "contradict" in reason]


@pytest.mark.slow
@pytest.mark.parametrize(("first", "degrees"), [(12, 2.0), (9, -0.7), (12, 0.4)])
def test_a_mount_knocked_while_moving(first: int, degrees: float) -> None:
    result = calibrated([edited(street(), knocked(frames_of(), first, degrees))])
    assert result.status == "not_converged"
    assert abs(first_frame_after(result) - first) <= 3
    (reason,) = [reason for reason in result.reasons if "contradict each other" in reason]
    assert "(pitch)" in reason and "the mount was moved" in reason
    (step,) = result.diagnostics["contradictions"]["within"]
    assert np.linalg.norm(step["step"][:3]) == pytest.approx(np.radians(abs(degrees)), rel=0.3)


@pytest.mark.slow
def test_a_mount_knocked_while_standing() -> None:
    source, frames = street("standing", 12), frames_of("standing", 12)
    result = calibrated([edited(source, knocked(frames, 6, 2.0))])
    assert result.status == "not_converged"
    assert abs(first_frame_after(result) - 6) <= 3


@pytest.mark.slow
def test_an_image_lost_while_the_numbering_goes_on() -> None:
    result = calibrated([edited(street(), without_image(frames_of(), 12))])
    assert result.status == "not_converged"
    assert abs(first_frame_after(result) - 12) <= 3
    (reason,) = [reason for reason in result.reasons if "contradict each other" in reason]
    assert "an image or a scan was lost" in reason
    (step,) = result.diagnostics["contradictions"]["within"]
    assert step["step"][6] == pytest.approx(street().config.period_s, abs=0.04)


@pytest.mark.slow
def test_an_image_lost_early() -> None:
    """Four scans before it: their outlines are too far from the estimate's for a kernel, and other runs that
    hold them beside right ones have more clusters."""
    result = calibrated([edited(street(), without_image(frames_of(), 4))])
    assert result.status == "not_converged"
    assert abs(first_frame_after(result) - 4) <= 1
    assert "an image or a scan was lost" in result.reasons[0]
    found = 1e-3 * float(re.search(r"time offset by ([+-]\d+) ms", result.reasons[0])[1])  # type: ignore[index]
    assert found == pytest.approx(0.1, abs=0.01)


@pytest.mark.slow
def test_masks_that_slide() -> None:
    result = calibrated([edited(street(), sliding(frames_of(), 10))])
    assert result.status == "not_converged"
    assert any("the masks slide" in reason for reason in result.reasons)


@pytest.mark.slow
def test_no_check_no_contradiction() -> None:
    config = with_overrides(CONFIG, ["check_contradictions=false"])
    result = calibrated([edited(street(), knocked(frames_of(), 12, 2.0))], config)
    assert not [reason for reason in result.reasons if "contradict each other" in reason]


@pytest.mark.slow
@pytest.mark.parametrize(("own_offsets", "degrees"), [("false", 1.1), ("true", 1.1), ("false", 4.0)])
def test_drives_of_two_rigs(own_offsets: str, degrees: float) -> None:
    """One estimate for two mounts may say what it wants of lens and ranges: that they are two comes first."""
    config = with_overrides(CONFIG, [f"time_offset_per_drive={own_offsets}"])
    frames = frames_of()
    two = [edited(street(), frames[:12], "a"), edited(street(), knocked(frames[12:], 0, degrees), "b")]
    result = calibrated(two, config)
    assert result.status == "not_converged"
    (reason,) = [reason for reason in result.reasons if "contradicts" in reason]
    assert reason.startswith(f"drive 'b' contradicts drive 'a': it differs in rotation by {degrees:.0f}.")
    assert reason == result.reasons[0]
    assert "(pitch)" in reason


@pytest.mark.slow
def test_drives_of_one_rig() -> None:
    frames = frames_of()
    clean = calibrated([edited(street(), frames[:12], "a"), edited(street(), frames[12:], "b")])
    assert set(clean.diagnostics["contradictions"]["between"]) == {"b"}
    assert not [reason for reason in clean.reasons if "contradict" in reason]


@pytest.mark.slow
def test_the_offset_of_every_drive_counts() -> None:
    """A standing drive cannot tell its own time offset, whichever drive comes first."""
    config = with_overrides(CONFIG, ["time_offset_per_drive=true"])
    moving = edited(street(), frames_of()[:12], "moving")
    standing = edited(street("standing", 12), frames_of("standing", 12)[:4], "standing")
    for order in ([moving, standing], [standing, moving]):
        result = calibrated(order, config)
        assert result.status != "ok"
        (weak,) = [weak for weak in result.weak_directions if weak.sentence.startswith("drive 'standing'")]
        assert "time offset" in weak.sentence and abs(weak.vector[6]) > 0.9
        assert any("drive 'standing'" in reason for reason in result.reasons)
        offsets = {offset.drive: offset.sigma_s for offset in result.drive_offsets}
        assert offsets["standing"] > 3.0 * CONFIG.observability.time_offset_s > offsets["moving"]


@pytest.mark.slow
def test_parts_have_the_tracks_of_their_scans() -> None:
    drives = prepared()
    parts, scans = parts_of(drives), (3, 4, 5, 6, 10, 11)
    motion = parts.problem.motions[0].part(scans)
    assert motion.objects is not None
    own = motion.objects
    for (scan, c, n), track in own.items():
        assert parts.problem.objects[0][scans[scan], c, n] == track
    assert len(own) == sum(scan in scans for scan, _, _ in parts.problem.objects[0])
    assert [scan.index for scan in drives[0].part(scans).scans] == list(scans)
    solved = parts.solve(Part(0, scans))
    assert solved is not None
    support = parts.support(Part(0, scans), solved.state)
    assert support.shape == (6,) and (support > 0.0).all()


@pytest.mark.slow
def test_a_part_without_common_labels_has_no_estimate() -> None:
    drives = prepared()
    blank = replace(drives[0], images=tuple(replace(image, contours={}) for image in drives[0].images))
    parts = parts_of([blank])
    assert parts.solve(Part(0, (0, 1, 2, 3))) is None
    assert find_contradictions(parts).sentences == ()


def turned_scans(drive: Drive, scans: Sequence[int], degrees: float) -> Drive:
    """The edges of some scans as a LiDAR sees them that is turned about its y axis."""
    R = gtsam.Rot3.Ry(np.radians(degrees)).matrix()
    found = list(drive.scans)
    for k in scans:
        edges = {
            c: replace(each, lPs=each.lPs @ R.T, outward=each.outward @ R.T)
            for c, each in drive.scans[k].boundaries.items()
        }
        found[k] = replace(drive.scans[k], boundaries=edges)
    return replace(drive, scans=tuple(found))


TURN_DEG = 20.0
SIGMAS = np.array([0.001] * 3 + [0.01] * 3 + [0.003])
SURE = np.diag(np.array([0.01] * 3 + [1.0] * 3 + [0.01]) ** 2)


def labels_and_stretch(drive: Drive) -> tuple[PartSolver, JointEstimate, SolvedPart]:
    """Labels that know little, and a stretch that claims to be turned from them, whatever its scans show."""
    parts = parts_of([drive])
    joint = replace(parts.problem.joint(), config=JointConfig())
    solution = solve_joint(joint, parts.reference, (5.0, 3.0))
    labels = known_to(JointEstimate.of(solution, parts.problem.objects), SIGMAS)
    away = np.zeros(7)
    away[1] = -np.radians(TURN_DEG)
    state = replace(solution.state, cTl=solution.state.cTl.retract(away[:6]))
    return parts, labels, SolvedPart(Part(0, (4, 5, 6, 7)), state, PartEstimate(away, np.diag(SIGMAS**2)))


@pytest.mark.slow
def test_motion_that_contradicts_a_stretch_is_left_out() -> None:
    (drive,) = prepared()
    parts, labels, differs = labels_and_stretch(turned_scans(drive, range(4, 8), TURN_DEG))
    agrees = SolvedPart(Part(0, (0, 1, 2, 3)), labels.solution.state, PartEstimate(np.zeros(7), SURE))
    for stretches, used in (([agrees], True), ([agrees, differs], False)):
        found = fuse_motion(parts.problem, labels, stretches)
        assert bool(found.diagnostics.get("fused")) is used
        assert (found.estimate is labels) is not used
        assert bool(found.remarks) is not used
    assert "frames 4 to 7" in found.remarks[0]


@pytest.mark.slow
def test_a_stretch_with_an_optimum_that_agrees_contradicts_no_motion() -> None:
    """The same claim; but the scans of the stretch support what the motion says."""
    (drive,) = prepared()
    parts, labels, differs = labels_and_stretch(drive)
    found = fuse_motion(parts.problem, labels, [differs])
    assert found.diagnostics["fused"] and not found.remarks
    # Where they do not, no other optimum counts, and nor does one that the part has no match at.
    turned = parts_of([turned_scans(drive, range(4, 8), TURN_DEG)])
    assert turned.estimates(differs, labels.solution.state) == (differs,)
    assert len(parts.estimates(differs, labels.solution.state)) == 2


def known_to(labels: JointEstimate, sigmas: FloatArray) -> JointEstimate:
    """The estimate with these deviations (7,) of extrinsic and time offset."""
    covariance = labels.covariance.copy()
    covariance[:7], covariance[:, :7] = 0.0, 0.0
    covariance[:7, :7] = np.diag(sigmas**2)
    return replace(labels, covariance=covariance)


def test_motion_is_left_out_where_what_misleads_it_is_estimated() -> None:
    parts = parts_of(prepared())
    joint = replace(parts.problem.joint(), config=JointConfig())
    labels = JointEstimate.of(solve_joint(joint, parts.reference, (5.0, 3.0)), parts.problem.objects)
    labels = known_to(labels, np.array([0.001] * 3 + [0.01] * 3 + [0.003]))
    for estimate, used in (((), True), (("k1",), True), (("cx",), True), (("k1", "skew"), False)):
        config = replace(CONFIG, method="joint", assumptions=AssumptionConfig(estimate=estimate))
        found = with_motion(replace(parts.problem, config=config), labels, [])
        assert bool(found.diagnostics.get("fused")) is used and not found.reasons
        assert (found.estimate is labels) is not used


@pytest.mark.slow
def test_motion_that_does_not_fit_itself_contradicts_nothing() -> None:
    (drive,) = prepared()
    chi2s = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        astray = [
            replace(pair, direction=replace(pair.direction, rotation=turned(pair.direction.rotation, rng)))
            for pair in drive.image_pairs
        ]
        parts = parts_of([replace(drive, image_pairs=tuple(astray))])
        joint = replace(parts.problem.joint(), config=JointConfig())
        labels = JointEstimate.of(solve_joint(joint, parts.reference, (5.0, 3.0)), parts.problem.objects)
        found = fuse_motion(parts.problem, labels, [])
        assert found.estimate is labels and not found.reasons
        assert "times worse than their noise" in found.remarks[0]
        chi2s.append(found.diagnostics["chi2_of_7"])
    assert max(chi2s) > MAX_DISAGREEMENT_CHI2


def turned(rotation: gtsam.Rot3, rng: np.random.Generator) -> gtsam.Rot3:
    """By 0.3 deg (one sigma) about each axis."""
    return rotation.compose(gtsam.Rot3.Expmap(np.radians(0.3) * rng.standard_normal(3)))


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not STOP.is_dir(), reason="no ../shared")
def test_a_knock_on_a_real_drive() -> None:
    source = open_source(STOP)
    frames = knocked(list(source), 30, 2.0)
    result = calibrate_prepared(prepare_drives([edited(source, frames)], CONFIG), source.nominal, CONFIG)
    assert result.status == "not_converged"
    assert abs(first_frame_after(result) - 30) <= 3


def test_only_the_drive_that_is_wrong_is_named() -> None:
    """Each right one contradicts the mean of the others, too, where the wrong one is among these."""
    covariance = np.diag([*np.radians([0.02] * 3), *[0.003] * 3, 0.001]) ** 2
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(7), covariance, 4)
    drives = {k: PartEstimate(step, covariance) for k, step in enumerate(steps)}
    every, apart = compare_drives(drives, 1e-3)
    assert set(every) == set(drives) and not apart
    for wrong in ([2], [1, 3]):
        turned = {
            k: replace(one, step=one.step + np.radians(0.5 * (k + 1)) * np.eye(7)[0] * (k in wrong))
            for k, one in drives.items()
        }
        assert sorted(compare_drives(turned, 1e-3)[1]) == wrong


@pytest.mark.slow
@pytest.mark.parametrize("clock_set", [False, True])
def test_labels_tell_a_camera_that_paused_from_a_clock_that_was_set(clock_set: bool) -> None:
    fast = simulate(replace(STREET, frames=84, frame_rate_hz=28.95))
    source = edited(fast, picked_frames(fast, 28, 20, clock_set))
    config = with_overrides(CONFIG, ["decide_sweep=false"])
    drives = prepare_drives([source], config)
    result = calibrate_prepared(drives, fast.truth.cTl, config, initial_time_offset_s=STREET.time_offset_s)
    (sentence,) = [reason for reason in result.reasons if "jumped by +35 ms" in reason]
    assert "at frame 20 the image stamps" in sentence
    if clock_set:
        assert result.status == "not_converged" and "check_stamps=false" in sentence
    else:
        assert result.status == "ok" and "by the labels the time offset is the same" in sentence
        error_s = result.time_offset_s - STREET.time_offset_s
        assert abs(error_s) < 3.0 * np.sqrt(result.covariance[6, 6]) < 0.01
