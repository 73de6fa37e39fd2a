"""Data made wrong on purpose are named for what they are; data that are right are left alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stored import simulated

from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch.calibrate import prepare_drives, scan_hashes
from sst_graph.batch.causes import with_causes
from sst_graph.batch.method_estimate import guess_as_result
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.diagnosis import LabelFit, labels, other_camera, preflight
from sst_graph.diagnosis.cameras import image_size, uncalibrated
from sst_graph.diagnosis.causes import likely_causes
from sst_graph.diagnosis.clocks import stamps, two_clocks
from sst_graph.diagnosis.hypotheses import best_hypothesis
from sst_graph.diagnosis.labels import searched_classes
from sst_graph.diagnosis.poses import wrong_start
from sst_graph.diagnosis.repeats import repeats
from sst_graph.diagnosis.units import axes
from sst_graph.drive.input_statistics import InputStatistics, image_statistics, scan_statistics
from sst_graph.drive.preparation import Drive
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.mask_shift import contour_profiles, mask_shift
from sst_graph.inspect.reasons import short_reason
from sst_graph.metrics import FORWARD_R_OPTICAL
from sst_graph.odometry.sweep import SweepDecision, SweptSource, with_sweep
from sst_graph.result import FrameId, Status
from sst_graph.simulator import SimulationConfig
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import NO_PICTURE, Frame, Guess, PixelStretch, Scan, SemanticClass, Source
from studies.subtle_faults import SUBTLE_FAULTS, SUBTLE_NAMED, repeated_pictures
from studies.wrong_drives import INPUT_FAULTS, NAMED, shifted_masks

CLASSES = (SemanticClass.VEHICLE,)
BY_THEMSELVES = (
    "half-size images",
    "stamps in ms",
    "stamps in us",
    "stamps in ns",
    "clouds in mm",
    "clouds in cm",
    "clouds in feet",
    "Tr in mm",
    "labels permuted",
    "stamps a tenth",
    "image stamps doubled",
    "image stamps tenfold",
    "scan stamps halved",
    "scan stamps a tenth",
    "scans repeated",
    "images repeated",
    "only background",
    "masks shifted 3 px",
    "masks shifted 6 px",
)
"""Lies that are certain before anything is solved."""


def street(seed: int, frames: int) -> KeptDrive:
    config = SimulationConfig(
        seed=seed,
        frames=frames,
        width=621,
        height=188,
        azimuth_step_deg=0.35,
        azimuth_limit_deg=60.0,
        vehicle_density=0.25,
        motion="no_stop",
        speed_mps=7.0,
    )
    return KeptDrive.of(simulated(config), sweep="auto")


@cache
def drive() -> KeptDrive:
    return street(31, 10)


@cache
def other() -> KeptDrive:
    return street(32, 10)


@cache
def decision() -> SweepDecision:
    """What is decided of the drive's sweep."""
    return with_sweep(drive()).sweep_decision


def swept(data: KeptDrive) -> Source:
    """The data; where their scans are the drive's own, with what was decided of these."""

    def same(a: Scan | None, b: Scan | None) -> bool:
        return a is b or (
            a is not None
            and b is not None
            and (a.stamp_ns, id(a.points), id(a.classes)) == (b.stamp_ns, id(b.points), id(b.classes))
        )

    own = len(data) == len(drive()) and all(same(a.scan, b.scan) for a, b in zip(data, drive(), strict=True))
    return SweptSource(data, decision()) if own else data


NO_SWEEP = CalibrationConfig(decide_sweep=False)
"""Where it tells nothing: to decide it takes longer than all else."""


def causes(data: KeptDrive, config: CalibrationConfig | None = None) -> list[str]:
    drives = prepare_drives([swept(data)], config or CalibrationConfig())
    return [finding.sentence for finding in preflight(drives, Guess(data.nominal, 0.0), CLASSES)]


@pytest.mark.parametrize("right", [drive, other])
@pytest.mark.slow
def test_right_data_are_left_alone(right: Callable[[], KeptDrive]) -> None:
    assert causes(right()) == []


@pytest.mark.parametrize("fault", BY_THEMSELVES)
@pytest.mark.slow
def test_a_fault_is_named_before_anything_is_solved(fault: str) -> None:
    # The sweep shows in the stamps; clouds in mm are tried for numbers that are far too large.
    config = CalibrationConfig() if "stamps" in fault or fault == "clouds in mm" else NO_SWEEP
    found = causes(INPUT_FAULTS[fault](drive(), other()), config)
    assert any(NAMED[fault] in sentence for sentence in found), found


@pytest.mark.parametrize("fault", SUBTLE_NAMED)
def test_frames_that_hold_earlier_ones_are_named(fault: str) -> None:
    found = causes(SUBTLE_FAULTS[fault](drive()), NO_SWEEP)
    assert any(SUBTLE_NAMED[fault] in sentence for sentence in found), found


def test_a_doubled_picture_now_and_then_is_left_to_the_robust_matching() -> None:
    assert causes(repeated_pictures(drive(), every=5)) == []


@pytest.mark.parametrize(
    ("step_m", "said"),
    [
        (0.07, ()),  # a quarter of the points are equal in two scans by chance
        (0.25, ("the coordinates of the clouds are rounded to steps of 0.25 m (",)),
        (1.0, ("the coordinates of the clouds are whole metres (",)),
        (2.0, ("the coordinates of the clouds are rounded to steps of 2 m (",)),
    ],
)
def test_coarsely_rounded_clouds_are_not_taken_for_scans_laid_over_each_other(
    step_m: float, said: tuple[str, ...]
) -> None:
    def rounded(scan: Scan) -> Scan:
        return replace(scan, points=(np.round(scan.points / step_m) * step_m).astype(np.float32))

    found = causes(drive().with_scans(rounded), NO_SWEEP)
    assert len(found) == len(said) and all(map(str.startswith, found, said)), found


def test_points_equal_by_chance_of_rounding_are_no_earlier_scan() -> None:
    """Three scans in one cloud are named in any case; with points of 5 cm the same share tells nothing."""
    accumulated = SUBTLE_FAULTS["three scans in one cloud"](drive())
    (one,) = prepare_drives([swept(accumulated)], NO_SWEEP)
    assert one.statistics is not None and repeats(one) is not None
    coarse = [replace(s, step=0.006 * s.median_range) for s in one.statistics.scans]
    assert repeats(replace(one, statistics=replace(one.statistics, scans=tuple(coarse)))) is None


@pytest.mark.parametrize("share", [1.0, 0.97])
def test_labels_of_nothing_but_vehicles_are_named(share: float) -> None:
    """All points of one class: the scenes may well be the same."""

    def all_vehicle(classes: np.ndarray) -> np.ndarray:
        few = np.random.default_rng(0).random(classes.shape) < share
        return np.where(few, np.uint8(SemanticClass.VEHICLE), classes).astype(np.uint8)

    points = drive().with_scans(lambda s: replace(s, classes=all_vehicle(s.classes)))
    masks = drive().with_images(lambda i: replace(i, mask=all_vehicle(i.mask)))
    for data, what in ((points, "point"), (masks, "mask's pixel")):
        found = [
            s for s in causes(data, NO_SWEEP) if s.startswith(f"nearly every {what} is labelled vehicle")
        ]
        assert found and "% of all, " in found[0] and "% ground" in found[0]


def test_a_forest_is_all_vegetation() -> None:
    vegetation = np.uint8(SemanticClass.VEGETATION)
    forest = drive().with_scans(lambda s: replace(s, classes=np.full_like(s.classes, vegetation)))
    forest = forest.with_images(lambda i: replace(i, mask=np.full_like(i.mask, vegetation)))
    (one,) = prepare_drives([swept(forest)], NO_SWEEP)
    assert searched_classes([one], (SemanticClass.VEGETATION, SemanticClass.VEHICLE)) is None


@pytest.mark.parametrize(
    ("late_s", "known_s", "reported"), [(3600.0, 0.0, True), (3600.0, -3600.0, False), (3.0, 0.0, False)]
)
def test_images_of_another_time(late_s: float, known_s: float, reported: bool) -> None:
    """Stamps of another time zone; with the offset in the start they are fine."""
    late = drive().with_images(lambda i: replace(i, stamp_ns=i.stamp_ns + round(late_s * 1e9)))
    drives = prepare_drives([swept(late)], CalibrationConfig())
    found = [one.sentence for one in preflight(drives, Guess(late.nominal, known_s), CLASSES)]
    named = [sentence for sentence in found if sentence.startswith("no image is of the time of the scans (")]
    assert bool(named) == reported and all("images from 3600.0" in sentence for sentence in named)


@pytest.mark.parametrize(("scale", "reported"), [(16, True), (8, False)])
def test_black_pictures_are_named_where_pictures_are_used(scale: int, reported: bool) -> None:
    """12 bits kept in 16 are read as a sixteenth of what they are."""
    dark = drive().with_images(lambda i: replace(i, pixels=i.pixels // scale))
    drives = prepare_drives([swept(dark)], CalibrationConfig())
    found = [one.sentence for one in preflight(drives, Guess(dark.nominal, 0.0), ())]
    sentence = (
        "the pictures are black (no value above 15 of 255 in 10 pictures): make them brighter, 16 times"
    )
    assert (bool(found) and found[0].startswith(sentence)) == reported
    assert not any("black" in sentence for sentence in causes(dark))


@pytest.mark.slow
def test_scans_that_are_given_twice_make_no_result_surer() -> None:
    for end, count in ((5, 0), (6, 1)):
        given = [replace(drive(), frames=drive().frames[part]) for part in (slice(0, end), slice(5, 10))]
        drives = prepare_drives(given, CalibrationConfig())
        found = [finding.evidence for finding in preflight(drives, Guess(drive().nominal, 0.0), CLASSES)]
        assert len(found) == count
        hashes = [scan_hashes([each]) for each in drives]
        assert [len(own) for own in hashes] == [end, 5] and len({*hashes[0], *hashes[1]}) == end + 5 - count
        assert all(sentence.startswith(f"{drive().name} has 1 scan of ") for sentence in found)


def test_frames_without_content_are_no_repeated_ones() -> None:
    """Missing pictures are all alike, and so are scans without points; no sensor is frozen."""
    none = np.uint8(SemanticClass.IGNORE)
    blind = drive().with_images(lambda i: replace(i, pixels=NO_PICTURE, mask=np.full_like(i.mask, none)))
    empty = drive().with_scans(lambda s: Scan(s.stamp_ns, s.points[:0], s.classes[:0]))
    assert not any("repeated" in sentence for sentence in (*causes(blind), *causes(empty)))
    assert causes(blind)[0].startswith("no mask's pixel has a label (vehicle cannot be aligned)")


@cache
def prepared() -> Drive:
    (one,) = prepare_drives([swept(drive())], CalibrationConfig())
    return one


def test_a_shift_in_time_is_judged_by_scans_that_meet_an_image() -> None:
    """Of scans from all over the drive two or three would, and so few agree somewhere by chance."""
    slow = drive().with_scans(lambda s: replace(s, stamp_ns=4 * s.stamp_ns))
    slow = slow.with_images(lambda i: replace(i, stamp_ns=4 * i.stamp_ns))
    (given,) = prepare_drives([slow], NO_SWEEP)
    tried: dict[float, int] = {}

    def fit(changed: Drive, guess: Guess) -> LabelFit | None:
        images = np.array(changed.image_stamps_ns) * 1e-9 + guess.time_offset_s
        apart = [np.abs(images - scan.stamp_ns * 1e-9).min() for scan in changed.scans]
        if guess.time_offset_s != 0.0:
            tried[round(guess.time_offset_s, 1)] = len(apart)
            assert max(apart) <= changed.image_period_s
        return None

    assert best_hypothesis(given, Guess(None, 0.0), fit, None) is None
    # 10 scans 0.4 s apart, of which those within a period of an image remain.
    assert tried == {0.9: 8, -0.9: 8, 1.8: 6, -1.8: 6, 2.7: 4, -2.7: 4}


@pytest.mark.parametrize(("turn_s", "reported"), [(0.1, False), (0.2, False), (1.0, True)])
def test_scans_as_measured_of_a_turn_that_no_scanner_needs(turn_s: float, reported: bool) -> None:
    """Stamps ten times too far apart: what was measured in a tenth of a second seems to take a whole one."""
    for sense, fraction in (("clockwise", -1.0), ("counterclockwise", 1.0)):
        decision = SweepDecision(sense, SweepTiming(fraction, np.pi, turn_s))  # type: ignore[arg-type]
        found = stamps(replace(prepared(), sweep=decision))
        assert (found is not None and "run too fast" in found.cause) == reported
    # Compensated clouds of a drive of which every tenth scan was kept.
    sparse = replace(prepared(), sweep=SweepDecision("compensated", SweepTiming(0.0, np.pi, turn_s)))
    assert stamps(sparse) is None


@pytest.mark.parametrize(
    ("speeds", "words"),
    [
        (np.full(20, 15.0), None),
        (np.linspace(20.0, 5.0, 20), None),  # 8 m/s^2: hard braking
        (np.linspace(28.0, 0.5, 20), None),  # 14 m/s^2: a simulated drive may brake so
        (np.linspace(48.0, 0.5, 20), "accelerations of 25 m/s2"),
        (np.full(20, 65.0), "a speed of 65 m/s"),
        (np.where(np.arange(20) == 7, 90.0, 15.0), None),  # one failed registration
    ],
)
def test_no_vehicle_drives_like_that(speeds: np.ndarray, words: str | None) -> None:
    motions = tuple(
        replace(
            prepared().lidar_motions[0],
            from_ns=k * 100_000_000,
            to_ns=(k + 1) * 100_000_000,
            aTb=gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * speed, 0.0, 0.0])),
            ok=True,
        )
        for k, speed in enumerate(speeds)
    )
    found = stamps(replace(prepared(), lidar_motions=motions))
    if words is None:
        assert found is None
    else:
        assert found is not None and words in found.evidence and "run too slowly" in found.cause


@pytest.mark.parametrize(
    ("steps_m", "named"),
    [
        (np.tile([0.0, 1.4], 10), True),  # each scan twice
        (np.where(np.arange(20) % 5 == 3, 0.01, 0.7), True),  # every fifth
        (np.where(np.arange(20) == 7, 0.0, 0.7), False),  # one failed registration
        (np.abs(np.linspace(0.7, -0.7, 20)), False),  # to a stop, and on
        (np.tile([0.0, 0.03], 10), False),  # noise of a standing vehicle
        (np.tile([0.5, 0.9], 10), False),  # stamps that jitter
    ],
)
def test_scans_that_stand_still_between_others_are_repeated_ones(steps_m: np.ndarray, named: bool) -> None:
    """Of one turn, though no point is the same to the last bit."""
    motion = prepared().lidar_motions[0]
    motions = tuple(
        replace(
            motion,
            from_ns=k * 100_000_000,
            to_ns=(k + 1) * 100_000_000,
            aTb=gtsam.Pose3(gtsam.Rot3(), np.array([step, 0.0, 0.0])),
            ok=True,
        )
        for k, step in enumerate(steps_m)
    )
    found = preflight([replace(prepared(), lidar_motions=motions)], Guess(None, 0.0), ())
    said = [finding.sentence for finding in found]
    assert any("scans are repeated" in sentence for sentence in said) == named, said
    assert not named or said[0].startswith("scans are repeated (a sensor that is slower than its frames)")


@pytest.mark.parametrize("timeless", [(0,), (3, 4), ()])
def test_scans_without_times_among_scans_with_times(timeless: tuple[int, ...]) -> None:
    """Whether they lack the field, or all of its values are 0."""
    statistics = prepared().statistics
    assert statistics is not None
    scans = [replace(scan, sweep_s=0.0 if k in timeless else 0.1) for k, scan in enumerate(statistics.scans)]
    said = preflight(
        [replace(prepared(), statistics=replace(statistics, scans=tuple(scans)))], Guess(None, 0.0), ()
    )
    found = [finding.evidence for finding in said if "times of their points" in finding.cause]
    some = "1 of 10 scans have none" if len(timeless) == 1 else "2 of 10 scans have none"
    assert found == ([f"{some}, or all of them equal"] if timeless else [])


def test_single_stamps_that_are_off_are_no_second_clock() -> None:
    """A lost image with the numbering going on, a late frame now and then: the intervals agree otherwise."""
    late = [0, 0, 0, 80, 0, 100, 100, 100, 100, 100]
    images = tuple(
        replace(image, stamp_ns=image.stamp_ns + 1_000_000 * ms)
        for image, ms in zip(prepared().images, late, strict=True)
    )
    assert two_clocks(replace(prepared(), images=images)) is None


@pytest.mark.slow
def test_masks_of_another_size_are_refused() -> None:
    with pytest.raises(DataError, match="a mask of 310x94 px, expected 621x188 px"):
        causes(INPUT_FAULTS["half-size masks"](drive(), other()))


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["Tr inverted", "y flipped", "clouds in vehicle axes"])
def test_what_would_make_the_labels_agree_names_the_cause(fault: str) -> None:
    wrong = INPUT_FAULTS[fault](drive(), other())
    result = calibrate(wrong, wrong.nominal)
    assert result.status != "ok"
    assert NAMED[fault] in result.reasons[0]


def test_the_best_change_is_named_and_not_the_first_that_fits() -> None:
    """Of a street whose intrinsics have half the focal length: an inverted start fits well by chance."""
    right = prepared().camera

    def fit(one: Drive, guess: Guess) -> LabelFit:
        if one.camera.fx > 1.5 * right.fx:
            return LabelFit(CTL, guess.time_offset_s, 0.68, 0.86)
        if guess.cTl is not None and guess.cTl.equals(CTL.inverse(), 1e-9):
            return LabelFit(CTL, guess.time_offset_s, 0.53, 0.78)
        return LabelFit(CTL, guess.time_offset_s, 0.22, 0.47)

    found = best_hypothesis(prepared(), Guess(CTL), fit, fit(prepared(), Guess(CTL)))
    assert found is not None and NAMED["half the focal length"] in found.cause


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["masks of another drive", "clouds in camera axes"])
def test_checks_that_run_only_where_a_result_is_not_ok(fault: str) -> None:
    """Neither is certain by itself: masks may be coarse, and a scanner may be mounted on its side."""
    wrong = INPUT_FAULTS[fault](drive(), other())
    assert causes(wrong) == []
    result = calibrate(wrong, wrong.nominal)
    assert result.status != "ok" and NAMED[fault] in result.reasons[0]


def test_clouds_in_the_cameras_axes_are_named_with_the_start_that_goes_with_them() -> None:
    """That of a scanner mounted on its side differs from it by a turn about the vertical."""
    (wrong,) = prepare_drives([INPUT_FAULTS["clouds in camera axes"](drive(), other())], NO_SWEEP)
    side = gtsam.Pose3(gtsam.Rot3.Ry(-np.pi / 2.0), np.zeros(3))
    for start in (None, drive().nominal, gtsam.Pose3()):
        found = axes(wrong, start)
        assert found is not None and "(" not in found.evidence
        assert short_reason(found.sentence).startswith(
            "the clouds are in the camera's axes: give clouds in the"
        )
    assert axes(wrong, side) is None and axes(prepared(), drive().nominal) is None


def test_without_the_search_for_causes_only_the_reasons_remain() -> None:
    wrong = INPUT_FAULTS["Tr inverted"](drive(), other())
    result = calibrate(swept(wrong), wrong.nominal, CalibrationConfig(find_causes=False))
    assert result.status != "ok" and not any("inverted" in reason for reason in result.reasons)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A mask of ten boxes and a picture in which each box has a colour and a texture of its own."""
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (200, 640, 3)).astype(np.uint8), (0, 0), 3.0)
    mask = np.zeros((200, 640), np.uint8)
    for left in range(20, 600, 60):
        top, side = int(rng.integers(40, 100)), int(rng.integers(25, 40))
        box = np.s_[top : top + side, left : left + side]
        mask[box] = SemanticClass.VEHICLE
        picture[box] = (0.3 * picture[box] + rng.integers(0, 180, 3)).astype(np.uint8)
    return mask, picture


@pytest.mark.parametrize(("right", "down"), [(0, 0), (3, 0), (-5, 2), (0, -6)])
def test_a_common_shift_is_measured(right: int, down: int) -> None:
    mask, picture = scene(1)
    moved = np.roll(mask, (down, right), (0, 1))
    found = mask_shift(contour_profiles(moved, picture, SemanticClass.VEHICLE))
    assert found is not None and found.within_reach
    assert abs(found.right_px - right) < 4.0 * found.sigma_px[0] < 1.6
    assert abs(found.down_px - down) < 4.0 * found.sigma_px[1] < 1.6


@pytest.mark.parametrize(("right", "named"), [(0, False), (2, True), (-3, True)])
def test_masks_beside_their_pictures_are_named_from_two_pixels_on(right: int, named: bool) -> None:
    scenes = [scene(seed) for seed in range(4)]
    profiles = [
        profile
        for mask, picture in scenes
        for profile in contour_profiles(np.roll(mask, right, 1), picture, SemanticClass.VEHICLE)
    ]
    found = labels.shifted_masks(mask_shift(profiles))
    assert (found is not None) is named
    if found is not None:
        assert ("right" if right > 0 else "left") in found.sentence


def test_blank_pictures_determine_no_shift() -> None:
    mask, picture = scene(1)
    assert mask_shift(contour_profiles(mask, np.zeros_like(picture), SemanticClass.VEHICLE)) is None


def test_shifted_masks_keep_what_left_the_picture_out() -> None:
    moved = shifted_masks(drive(), 6, 0)
    assert moved[0].image is not None
    assert (moved[0].image.mask[:, :6] == SemanticClass.IGNORE).all()


@pytest.mark.parametrize("crop", [0.0, 0.2, 0.4])
def test_a_crop_is_no_other_size(crop: float) -> None:
    """The upper part cut off, the principal point moved with it."""
    height = round(375 * (1.0 - crop))
    camera = PinholeCamera(721.0, 721.0, 609.6, 172.9 - 375 * crop, 1242, height)
    assert image_size(camera) is None


@pytest.mark.parametrize("middle", [(621.0, 187.5), (620.5, 187.0), (621.0, 187.0)])
def test_a_principal_point_of_a_data_sheet(middle: tuple[float, float]) -> None:
    finding = uncalibrated(PinholeCamera(721.0, 721.0, *middle, 1242, 375))
    assert finding is not None and "turns the result by 0.079 deg" in finding.evidence
    assert uncalibrated(PinholeCamera(721.0, 721.0, middle[0], 183.0, 1242, 375)) is None


def test_it_is_a_remark_unless_it_is_said_how_far_it_may_be_off() -> None:
    """The status stays, and other reasons stay before it."""
    drives = prepare_drives([swept(drive())], CalibrationConfig())
    guess = Guess(drive().nominal, 0.0)
    found = guess_as_result(drives, guess, CalibrationConfig(), "first")
    middle = PinholeCamera(721.0, 721.0, 621.0, 187.5, 1242, 375)
    result = replace(found, camera=middle, status="ok", frames_used=(FrameId("street", 0),))

    def reasons(**assumptions: object) -> tuple[str, ...]:
        config = CalibrationConfig(method="edges", assumptions=AssumptionConfig(**assumptions))
        said = with_causes(result, drives, guess, config)
        assert said.status == "ok" and said.reasons[0] == "first"
        return said.reasons[1:]

    (remark,) = reasons()
    assert remark.startswith("the principal point is the middle of the picture")
    assert reasons(cy=8.0) == reasons(estimate=("cx=5",)) == ()
    # A pinhole to which the pictures of a lens were rectified is centred by its maker, this package.
    drives = [replace(prepared, statistics=_rectified(prepared.statistics)) for prepared in drives]
    assert reasons() == ()


@pytest.mark.slow
def test_frames_without_labels_are_named_where_the_result_is_not_ok() -> None:
    def bare(frame: Frame) -> Frame:
        assert frame.scan is not None
        nothing = np.full_like(frame.scan.classes, SemanticClass.IGNORE)
        return replace(frame, scan=replace(frame.scan, classes=nothing))

    guess = Guess(drive().nominal, 0.0)

    def reasons(labelled: int, status: Status = "unobservable", **settings: Any) -> tuple[str, ...]:
        config = CalibrationConfig(find_causes=False, **{"method": "joint", **settings})
        frames = tuple(frame if k < labelled else bare(frame) for k, frame in enumerate(drive()))
        drives = prepare_drives([swept(replace(drive(), frames=frames))], config)
        found = replace(guess_as_result(drives, guess, config, "first"), reasons=("first", "second"))
        return with_causes(replace(found, status=status), drives, guess, config).reasons

    words = "only 3 of 10 frames have labels of both sensors (the other 7 are not used): --method both"
    first, named, second = reasons(3)
    assert (first, second) == ("first", "second") and named.startswith(words)
    assert reasons(3, status="ok") == reasons(10) == ("first", "second")
    assert reasons(3, time_offset_per_drive=True) == ("first", "second")


def _rectified(statistics: InputStatistics | None) -> InputStatistics:
    """The same of pictures that a lens took."""
    assert statistics is not None
    stretch = PixelStretch(np.ones((2, 2, 3), np.float32), 32)
    images = [frame.image for frame in drive() if frame.image is not None]
    taken = (image_statistics(k, replace(image, stretch=stretch), False) for k, image in enumerate(images))
    return replace(statistics, images=tuple(taken))


def test_clouds_that_do_not_name_the_laser_of_a_point_are_remarked_on() -> None:
    """Where labels or edges rely on rings, and only where most scans lack them."""
    guess = Guess(drive().nominal, 0.0)

    def reasons(nameless: int, method: str = "joint") -> tuple[str, ...]:
        scans = [
            replace(frame.scan, rings=None) if frame.scan is not None and k < nameless else frame.scan
            for k, frame in enumerate(drive())
        ]
        statistics = InputStatistics(
            tuple(scan_statistics(k, s, False) for k, s in enumerate(scans) if s), ()
        )
        drives = [replace(prepared, statistics=statistics) for prepared in known]
        config = CalibrationConfig(method=method, find_causes=False)
        result = replace(guess_as_result(drives, guess, config, "first"), status="ok")
        said = with_causes(replace(result, frames_used=(FrameId("street", 0),)), drives, guess, config)
        assert said.status == "ok"
        return said.reasons[1:]

    known = prepare_drives([swept(drive())], CalibrationConfig())
    (remark,) = reasons(10)
    assert "10 of 10 scans have no field 'ring'" in remark
    assert short_reason(remark).endswith(
        "give the clouds with the field 'ring', or as the LiDAR's driver stores them"
    )
    assert reasons(10, "edges") == (remark,)
    assert reasons(10, "motion") == reasons(2) == reasons(0) == ()


@pytest.mark.parametrize(("scale", "name"), [(0.5, "half"), (2.0, "twice"), (0.25, "about 0.26 times")])
def test_pictures_of_another_size(scale: float, name: str) -> None:
    camera = PinholeCamera(721.0, 721.0, 609.6, 172.9, round(1242 * scale), round(375 * scale))
    finding = image_size(camera)
    assert finding is not None and f"the pictures are {name} the size" in finding.cause
    short = short_reason(finding.sentence)
    assert short.endswith("give pictures and masks at full size"), short  # the remedy is whole
    # The principal point determines the ratio to some per cent only.
    ratio = re.search(r"\(about ([0-9.]+)\)", finding.check)
    assert ratio is not None and abs(float(ratio[1]) / scale - 1.0) < 0.05


CTL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.05, -0.08, -0.27]))


def test_a_result_a_baseline_from_the_start_is_another_camera() -> None:
    covariance = np.eye(7) * 0.01**2
    right = gtsam.Pose3(gtsam.Rot3(), np.array([-0.54, 0.0, 0.0])) * CTL
    finding = other_camera(CTL, right, covariance)
    assert finding is not None and "54 cm to the right" in finding.cause
    # Pictures may be right where masks alone are exchanged: only those were compared.
    assert finding.cause.startswith("the masks (or the pictures with them) are those of another camera")
    by_edges = other_camera(CTL, right, covariance, by_labels=False)
    assert by_edges is not None and by_edges.cause.startswith("the pictures are those of another camera")
    forward = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.54])) * CTL
    assert other_camera(CTL, forward, covariance) is None
    assert other_camera(CTL, right, np.eye(7) * 0.2**2) is None
    assert other_camera(None, right, covariance) is None


@pytest.mark.parametrize(
    ("degrees", "words"),
    [(True, "radians that were taken as degrees"), (False, "degrees that were taken as radians")],
)
@pytest.mark.parametrize("sequence", ["xyz", "ZYX"])
def test_angles_in_the_wrong_unit(degrees: bool, words: str, sequence: str) -> None:
    """Roll, pitch and yaw of a rig as designed, misread; the true one is a degree off the design."""
    angles = Rotation.from_matrix(CTL.rotation().matrix()).as_euler(sequence, degrees=not degrees)
    misread = gtsam.Rot3(Rotation.from_euler(sequence, angles, degrees=degrees).as_matrix())
    true = CTL.retract(np.array([0.01, -0.015, 0.01, 0.0, 0.0, 0.0]))
    found = wrong_start(gtsam.Pose3(misread, CTL.translation()), LabelFit(true, 0.0, 0.6, 0.8))
    assert found is not None and words in found.cause


def test_the_start_of_a_camera_link() -> None:
    """It is near the identity, as are a rig's angles in radians that were taken as degrees."""
    link = gtsam.Pose3(FORWARD_R_OPTICAL, np.zeros(3)) * CTL
    for step in (np.zeros(6), np.array([0.01, -0.015, 0.01, 0.0, 0.0, 0.0])):
        found = wrong_start(link, LabelFit(CTL.retract(step), 0.0, 0.6, 0.8))
        assert found is not None and "that of the camera's link" in found.cause


def test_a_start_is_wrong_where_both_halves_of_the_drive_agree_elsewhere() -> None:
    behind = CTL * gtsam.Pose3(gtsam.Rot3.Rz(np.pi), np.zeros(3))
    found = LabelFit(behind, 0.0, 0.3, 0.65)
    aside = replace(found, cTl=behind * gtsam.Pose3(gtsam.Rot3.Rx(np.radians(20.0)), np.zeros(3)))
    (whole,) = prepare_drives([swept(drive())], NO_SWEEP)

    long = replace(whole, scans=(*whole.scans, *whole.scans))

    def cause(of: Drive, *found_in_turn: LabelFit | None) -> str:
        answers = list(found_in_turn)

        def fit(_: Drive, guess: Guess) -> LabelFit | None:
            return answers.pop(0) if guess.cTl is None and answers else None

        (one,) = likely_causes([of], Guess(CTL, 0.0), fit)
        assert not answers
        return f"{one.cause}: {one.evidence}"

    assert "the start (Tr) is wrong" in cause(long, found, found, found)
    assert "180 deg away" in cause(long, found, found, found)
    for halves in ([aside], [found, aside], [found, None]):
        assert "the same scene" in cause(long, found, *halves)
    assert "the same scene" in cause(long, replace(found, explained=0.2))
    assert "the same scene" in cause(long, None)
    # Halves of a short drive show too little: it has to agree well.
    assert "the same scene" in cause(whole, found)
    assert "the start (Tr) is wrong" in cause(whole, replace(found, explained=0.5))
    assert wrong_start(CTL, replace(found, cTl=CTL)) is None and wrong_start(CTL, None) is None
