"""The simulated drive: its truth, its repeatability, its segmentation noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from sst_graph.errors import ConfigError
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.simulator.mesh import extended, merged
from sst_graph.simulator.vehicles import random_car
from sst_graph.types import CameraImage, GroundTruth, Scan, SemanticClass, Source

SMALL: dict[str, Any] = {
    "frames": 12,
    "width": 621,
    "height": 188,
    "motion": "no_stop",
    "azimuth_step_deg": 0.35,
    "rotation_error_deg": 3.0,
}


@cache
def drive(**changes: Any) -> SimulatedDrive:
    return simulate(SimulationConfig(**{**SMALL, **changes}))


def changed(source: SimulatedDrive, **changes: Any) -> SimulatedDrive:
    """The same street and motion with another offset, sweep or label noise."""
    config = replace(source.config, **changes)
    truth = GroundTruth(source.truth.cTl, config.time_offset_s)
    return replace(source, config=config, truth=truth)


def vehicle_agreement(source: SimulatedDrive, scan: Scan, image: CameraImage) -> tuple[int, float]:
    """Number of points of parked vehicles in the image, and the share of them on the vehicle mask.

    Points go to the image's instant by the true motion and the true extrinsic; those nearer than
    1.5 px to the mask's border are left out.
    """
    assert scan.instances is not None
    moving = [vehicle.instance for vehicle in source.street.moving]
    parked = (scan.classes == SemanticClass.VEHICLE) & ~np.isin(scan.instances, moving)
    stamp = scan.stamp_ns * 1e-9
    offsets = np.zeros(len(scan.points)) if scan.offsets_s is None else scan.offsets_s.astype(np.float64)
    wRl, w_t = source.street.ego.pose(stamp + offsets[parked])
    wPs = np.einsum("nij,nj->ni", wRl, scan.points[parked].astype(np.float64)) + w_t
    wTc = source.wTc(image.stamp_ns * 1e-9)
    uvs = source.camera.project((wPs - wTc.translation()) @ wTc.rotation().matrix())
    uvs = uvs[source.camera.in_image(np.nan_to_num(uvs, nan=-99.0))]
    u, v = np.rint(uvs).astype(int).T
    vehicle = (image.mask == SemanticClass.VEHICLE).astype(np.uint8)
    border = cv2.distanceTransform(vehicle, cv2.DIST_L2, 5) + cv2.distanceTransform(
        1 - vehicle, cv2.DIST_L2, 5
    )
    inner = border[v, u] > 2.0
    return int(inner.sum()), float(vehicle[v, u][inner].mean())


@pytest.mark.parametrize(
    ("motion", "changes"),
    [
        ("no_stop", {}),
        ("no_stop", {"rolling": True, "time_offset_s": 0.2}),
        ("turning", {"rolling": True, "time_offset_s": -0.3}),
        ("standing", {}),
    ],
)
def test_vehicle_points_fall_on_the_vehicle_mask(motion: str, changes: dict[str, Any]) -> None:
    source = changed(drive(motion=motion, vehicle_density=0.25), label_noise=0.0, **changes)
    results = []
    for index in (2, 6, 10):
        frame = source[index]
        assert frame.scan is not None and frame.image is not None
        results.append(vehicle_agreement(source, frame.scan, frame.image))
    counts, shares = zip(*results, strict=True)
    assert sum(counts) > 1000
    assert np.average(shares, weights=counts) >= 0.995


def test_a_wrong_time_offset_or_extrinsic_shows() -> None:
    """What the test above measures is sensitive to what it is there to find."""
    turning = drive(motion="turning", vehicle_density=0.25)
    source = changed(turning, label_noise=0.0, time_offset_s=-0.3)
    frame = source[9]
    assert frame.scan is not None and frame.image is not None
    assert vehicle_agreement(source, frame.scan, frame.image)[1] >= 0.995
    for truth in (
        GroundTruth(source.nominal, source.truth.time_offset_s),
        GroundTruth(source.truth.cTl.compose(gtsam.Pose3(gtsam.Rot3.Ry(0.03), np.zeros(3))), -0.3),
    ):
        assert vehicle_agreement(replace(source, truth=truth), frame.scan, frame.image)[1] < 0.985
    late = changed(source, time_offset_s=0.0)
    assert vehicle_agreement(late, frame.scan, frame.image)[1] < 0.985


def test_time_offset_sign_by_hand() -> None:
    """The image of a later world: with +1 frame of offset, image k is image k + 1 of no offset."""
    period = 1.0 / 9.65
    late, prompt = (
        changed(drive(motion="constant"), time_offset_s=x, label_noise=0.0) for x in (period, 0.0)
    )
    assert late.wTc(0.0).translation()[0] - prompt.wTc(0.0).translation()[0] == pytest.approx(
        8.5 * period, abs=0.02
    )
    image, same, next_one = late[4].image, prompt[4].image, prompt[5].image
    assert image is not None and same is not None and next_one is not None
    # Stamps stray by 0.2 ms, so the masks agree but for single pixels.
    assert (image.mask != next_one.mask).mean() < 0.005 < (image.mask != same.mask).mean()


def test_truth_differs_from_nominal_as_asked() -> None:
    source = drive(rotation_error_deg=2.0, translation_error_m=0.04, time_offset_s=-0.1)
    error = source.nominal.inverse() * source.truth.cTl
    angle = np.linalg.norm(error.rotation().Logmap(error.rotation()))
    assert np.rad2deg(angle) == pytest.approx(2.0)
    assert np.linalg.norm(error.translation()) == pytest.approx(0.04)
    assert source.truth.time_offset_s == -0.1


def test_frames_do_not_depend_on_their_order() -> None:
    first, second = (simulate(SimulationConfig(**SMALL, rolling=True)) for _ in range(2))
    backwards = [first[index] for index in (7, 3)][::-1]
    for one, two in zip(backwards, [second[index] for index in (3, 7)], strict=True):
        assert (
            one.scan is not None and two.scan is not None and one.image is not None and two.image is not None
        )
        assert one.scan.stamp_ns == two.scan.stamp_ns
        np.testing.assert_array_equal(one.scan.points, two.scan.points)
        np.testing.assert_array_equal(one.scan.classes, two.scan.classes)
        np.testing.assert_array_equal(one.image.pixels, two.image.pixels)
        np.testing.assert_array_equal(one.image.mask, two.image.mask)


def test_seeds_make_different_streets() -> None:
    one, two = drive(seed=0)[0], drive(seed=1)[0]
    assert one.image is not None and two.image is not None
    assert (one.image.mask != two.image.mask).mean() > 0.2
    assert (
        drive(seed=0).truth.cTl.rotation().matrix()[0, 0] != drive(seed=1).truth.cTl.rotation().matrix()[0, 0]
    )


def test_it_is_a_source() -> None:
    source: Source = drive()
    assert len(source) == 12 and source[-1].index == 11
    with pytest.raises(IndexError, match="frame 12"):
        source[12]
    frame = next(iter(source))
    assert frame.index == 0 and frame.scan is not None and frame.image is not None
    assert frame.scan.stamp_ns == frame.image.stamp_ns
    assert frame.image.pixels.shape == (188, 621, 3) and frame.image.mask.shape == (188, 621)


def test_scan_looks_like_an_hdl64() -> None:
    scan = changed(drive(), rolling=True, azimuth_step_deg=0.1728)[5].scan
    assert scan is not None and scan.rings is not None and scan.offsets_s is not None
    assert 80_000 < len(scan.points) < 133_000
    assert len(np.unique(scan.rings)) == 64 and (np.diff(scan.rings.astype(int)) >= 0).all()
    azimuth = np.mod(np.arctan2(scan.points[:, 1], scan.points[:, 0]), 2 * np.pi)
    rising = np.diff(azimuth)[np.diff(scan.rings.astype(int)) == 0]
    assert (rising > 0).mean() > 0.999
    # The laser faces forward at the stamp and turns clockwise from above.
    signed = np.mod(azimuth + np.pi, 2 * np.pi) - np.pi
    expected = -signed / (2 * np.pi) / 9.65
    assert np.abs(scan.offsets_s - expected).max() < 1e-4
    assert np.linalg.norm(scan.points, axis=1).max() < 91.0


def test_label_noise_grows_with_its_level() -> None:
    masks, labels = [], []
    for level in (0.0, 1.0, 2.0):
        frame = changed(drive(), label_noise=level)[5]
        assert frame.image is not None and frame.scan is not None
        masks.append(frame.image.mask)
        labels.append(frame.scan.classes)
    wrong_pixels = [(mask != masks[0]).mean() for mask in masks]
    wrong_points = [(label != labels[0]).mean() for label in labels]
    assert 0.002 < wrong_pixels[1] < wrong_pixels[2] < 0.2
    assert 0.005 < wrong_points[1] < wrong_points[2] < 0.1


@pytest.mark.parametrize("motion", ["mixed", "stop_and_go"])
def test_motion_has_a_stop_and_a_drive(motion: Any) -> None:
    source = simulate(SimulationConfig(frames=80, motion=motion, width=64, height=32))
    stamps = source.stamps_ns * 1e-9
    positions = np.stack([source.wTl(float(t)).translation() for t in stamps])
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(stamps)
    assert (speed < 1e-6).sum() >= 3 and speed.max() > 5.0
    assert np.abs(np.diff(speed) / np.diff(stamps)[1:]).max() < 8.0


def test_the_number_of_moving_vehicles_follows_the_configuration() -> None:
    assert not drive(moving_fraction=0.0).street.moving
    assert len(drive(moving_fraction=0.5).street.moving) >= 5


@pytest.mark.parametrize(
    ("name", "value"),
    [("motion", "flying"), ("frames", 0), ("time_offset_s", 0.7), ("label_noise", -1.0), ("width", 10)],
)
def test_bad_configurations_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        SimulationConfig(**{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 8192, "height": 4096}, r"width: found 8192, expected at most 2441.*\(10000000 px in all"),
        ({"frames": 10_000, "motion": "standing"}, r"frames: .* at most 9650 \(1000 s at frame_rate_hz\)"),
        ({"frames": 9000}, r"frames: found 9000, expected at most 5676.* \(5000 m at speed_mps"),
    ],
)
def test_drives_that_would_fill_the_memory_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SimulationConfig(**settings)


def test_a_mesh_is_extended_by_others_behind_its_own_faces() -> None:
    rng = np.random.default_rng(4)
    whole, one, two = (random_car(rng) for _ in range(3))
    pick = np.array([7, 2, 30])
    for more in ([], [one, two]):
        found, expected = extended(whole, pick, more), merged([whole.part(pick), *more])
        for name in ("triangles", "kinds", "materials", "colours", "textures"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
