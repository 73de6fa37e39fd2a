"""Rectified pictures and masks: places to 0.02 px, labels, and what lies beyond the raw image."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from sst_graph.cameras import (
    BrownConradyCamera,
    CameraModel,
    DoubleSphereCamera,
    FisheyeCamera,
    Rectification,
    rectified_camera,
)
from sst_graph.data.frame_parts import AheadReader, SeparateReader
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.data.rectified import RectifiedSource
from sst_graph.drive.preparation import image_features
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.mask_contour import ContourMap
from sst_graph.odometry.features import FeatureTracker, detect_corners, gray_of, trackable_area
from sst_graph.types import NO_PICTURE, CameraImage, Frame, PixelStretch, SemanticClass
from sst_graph.validation import checked_image

K = PinholeCamera(300.0, 305.0, 322.3, 238.6, 640, 480)
MODELS: list[CameraModel] = [
    BrownConradyCamera(K, (-0.3, 0.1, 0.001, -0.001, 0.0)),
    BrownConradyCamera(K, (0.15, 0.0, 0.0, 0.0)),
    FisheyeCamera(PinholeCamera(190.0, 190.0, 321.4, 240.2, 640, 480), (0.01, 0.0, 0.0, 0.0), 190.0),
    DoubleSphereCamera(PinholeCamera(190.0, 190.0, 321.4, 240.2, 640, 480), -0.2, 0.6),
]
OTHER, VEHICLE, IGNORE = (int(c) for c in (SemanticClass.OTHER, SemanticClass.VEHICLE, SemanticClass.IGNORE))


def drawn(model: CameraModel, value: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(h, w, 3) raw picture of a grey value at each ray: value (n, 2) -> (n,) of X/Z and Y/Z."""
    u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays, valid = model.unproject(np.column_stack([u.ravel(), v.ravel()]))
    front = valid & (np.nan_to_num(rays[:, 2]) > 0.1)
    grey = np.zeros(len(rays))
    grey[front] = value(rays[front, :2] / rays[front, 2:])
    return np.repeat(np.rint(grey).astype(np.uint8).reshape(*u.shape, 1), 3, axis=2)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_a_grid_of_points_at_sub_pixel(model: CameraModel) -> None:
    """Spots of light at known rays, drawn in the raw picture, are found where the pinhole projects them."""
    rectification = Rectification.of(model)
    camera = rectification.camera
    us, vs = np.meshgrid(
        np.linspace(30.37, camera.width - 30.21, 9), np.linspace(30.83, camera.height - 30.58, 7)
    )
    spots = np.column_stack([us.ravel(), vs.ravel()])
    whole = cv2.erode(rectification.valid.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
    spots = spots[whole[tuple(np.rint(spots[:, ::-1]).astype(int).T)]]
    sigma, tree = 0.02, cKDTree(spots)

    def light(slopes: np.ndarray) -> np.ndarray:
        pixels = slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        nearest, _ = tree.query(pixels)
        return np.asarray(250.0 * np.exp(-0.5 * (nearest / (sigma * camera.fx)) ** 2))

    picture = rectification.picture(drawn(model, light)).astype(np.float64)[..., 0]
    reach = 12
    step = np.arange(-reach, reach + 1)
    off = []
    for u, v in spots:
        column, row = round(u), round(v)
        part = picture[row - reach : row + reach + 1, column - reach : column + reach + 1]
        # Moments about the known place, in a window of Gaussian weight centred there: no bias by its border.
        window = np.exp(-0.5 * ((column + step[None] - u) ** 2 + (row + step[:, None] - v) ** 2) / 4.0**2)
        weight = part * window
        du = (weight * (column + step[None] - u)).sum() / weight.sum()
        dv = (weight * (row + step[:, None] - v)).sum() / weight.sum()
        # The window pulls towards the known place: by the product of two Gaussians.
        gain = 1.0 + (sigma * camera.fx) ** 2 / 4.0**2
        off.append([du * gain, dv * gain])
    assert len(off) > 40
    assert np.abs(off).max() < 0.02


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_the_default_camera_keeps_the_resolution_and_sees_what_the_lens_sees(model: CameraModel) -> None:
    camera = rectified_camera(model)
    assert camera.fx == pytest.approx(model.axis_scale * model.intrinsics.fx)
    edges = np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]])
    slopes = (edges[:, 0] - camera.cx) / camera.fx
    rays = np.column_stack([slopes, np.zeros(2), np.ones(2)])
    limit = np.tan(np.deg2rad(55.0))
    assert (np.abs(slopes) < limit + 0.01).all()
    if (np.abs(slopes) < limit - 0.01).all():
        uvs, _ = model.project(rays)
        np.testing.assert_allclose(uvs[:, 0], [0.0, model.width - 1.0], atol=1.0)


def test_a_pinhole_stays_what_it_is() -> None:
    model = BrownConradyCamera(K)
    assert rectified_camera(model) == K
    picture = np.random.default_rng(3).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    np.testing.assert_array_equal(Rectification.of(model).picture(picture), picture)


def test_the_share_of_the_raw_image_that_is_used() -> None:
    """All of a lens that bends little; of a narrower field that much; little of a lens that is not one."""
    K = PinholeCamera(500.0, 500.0, 319.5, 99.5, 640, 200)
    assert Rectification(BrownConradyCamera(K), K).used_share == 1.0
    half = PinholeCamera(500.0, 500.0, 159.5, 99.5, 320, 200)
    assert Rectification(BrownConradyCamera(K), half).used_share == pytest.approx(0.5, abs=0.02)
    assert Rectification.of(BrownConradyCamera(K, (-5.0, 0.0, 0.0, 0.0))).used_share < 0.3


def test_fields_that_no_pinhole_has() -> None:
    for wrong in (0.0, 190.0, np.nan):
        with pytest.raises(ConfigError, match="wider fields need several pinholes"):
            rectified_camera(MODELS[2], wrong)
    behind = FisheyeCamera(PinholeCamera(190.0, 190.0, 1200.0, 240.0, 640, 480), field_of_view_deg=100.0)
    with pytest.raises(DataError, match="around the optical axis"):
        rectified_camera(behind)


def test_labels_take_the_majority_of_the_bilinear_weights() -> None:
    """A pinhole twice as fine: the border between the raw columns 2 and 3 is at 2.5 of the raw image."""
    raw = PinholeCamera(40.0, 40.0, 3.0, 2.0, 8, 6)
    fine = PinholeCamera(160.0, 160.0, 12.0, 8.0, 29, 21)
    rectification = Rectification(BrownConradyCamera(raw), fine)
    mask = np.full((6, 8), OTHER, np.uint8)
    mask[:, 3:] = VEHICLE
    instances = np.where(mask == VEHICLE, 7, 0).astype(np.uint16)
    classes, numbers = rectification.labels(mask, instances)
    assert numbers is not None
    expected = np.arange(29) / 4.0 > 2.5
    np.testing.assert_array_equal(classes[10, np.arange(29) != 10] == VEHICLE, expected[np.arange(29) != 10])
    np.testing.assert_array_equal(numbers == 7, classes == VEHICLE)
    assert rectification.valid.all()


def test_what_has_no_source() -> None:
    """A pinhole that is wider than the lens."""
    lens = FisheyeCamera(PinholeCamera(100.0, 100.0, 49.5, 49.5, 100, 100), field_of_view_deg=50.0)
    wide = PinholeCamera(100.0, 100.0, 79.5, 79.5, 160, 160)
    rectification = Rectification(lens, wide)
    u, v = np.meshgrid(np.arange(160) - 79.5, np.arange(160) - 79.5)
    np.testing.assert_array_equal(rectification.valid, np.hypot(u, v) < 100.0 * np.tan(np.deg2rad(25.0)))
    image = CameraImage(
        5, np.full((100, 100), VEHICLE, np.uint8), np.full((100, 100, 3), 90, np.uint8),
        np.full((100, 100), 4, np.uint16),
    )  # fmt: skip
    found = rectification.image(image)
    assert found.valid is not None and found.instances is not None and found.stamp_ns == 5
    np.testing.assert_array_equal(found.mask, np.where(found.valid, VEHICLE, IGNORE))
    np.testing.assert_array_equal(found.instances, np.where(found.valid, 4, 0))
    assert (found.pixels == 90).all()
    assert not rectification.image(replace(image, pixels=NO_PICTURE)).has_picture
    checked = checked_image(found, wide)
    np.testing.assert_array_equal(checked.valid, found.valid)
    for wrong in (found.valid[:-1], found.valid.astype(np.uint8)):
        with pytest.raises(DataError, match="valid"):
            checked_image(replace(found, valid=wrong), wide)
    with pytest.raises(DataError, match="found a mask of 99x100 px, expected 100x100 px, the camera's"):
        rectification.labels(image.mask[:, 1:])


def test_the_border_of_the_valid_region_is_no_contour() -> None:
    """A vehicle that the border cuts: its own edges are contours, the cut is none, wherever the picture has
    an edge beside it."""
    mask = np.full((120, 200), OTHER, np.uint8)
    mask[40:80, 60:120] = VEHICLE
    mask[:, 120:] = IGNORE
    pixels = np.full((120, 200, 3), 90, np.uint8)
    pixels[mask == VEHICLE] = 220
    # A bright line that ends three pixels before the cut, as a window or a fold has.
    pixels[40:80, 117:] = 20
    contour = ContourMap.of(mask, SemanticClass.VEHICLE, pixels, valid=mask != IGNORE)
    assert contour is not None
    rows = np.arange(48.0, 73.0)
    for column in np.arange(114.0, 127.0, 0.5):
        feet = contour.look_up(np.column_stack([np.full(len(rows), column), rows]))
        at_cut = feet.feet[:, 0] > 112.0
        assert not feet.valid[at_cut].any()
    left = contour.look_up(np.column_stack([np.full(len(rows), 57.0), rows]))
    top = contour.look_up(np.column_stack([np.arange(70.0, 105.0), np.full(35, 37.0)]))
    assert left.valid.all() and top.valid.all()
    np.testing.assert_allclose(left.feet[:, 0], 59.5, atol=0.3)


def test_no_corner_at_the_border_of_the_valid_region() -> None:
    lens = FisheyeCamera(PinholeCamera(200.0, 200.0, 99.5, 99.5, 200, 200), field_of_view_deg=50.0)
    wide = PinholeCamera(200.0, 200.0, 149.5, 149.5, 300, 300)
    texture = np.random.default_rng(4).integers(0, 256, (25, 25, 1)).astype(np.uint8)
    pixels = np.tile(np.kron(texture, np.ones((8, 8, 1), np.uint8)), (1, 1, 3))
    image = Rectification(lens, wide).image(CameraImage(0, np.full((200, 200), IGNORE, np.uint8), pixels))
    corners = detect_corners(gray_of(image), trackable_area(image))
    radius = 200.0 * np.tan(np.deg2rad(25.0))
    distances = np.hypot(*(corners - 149.5).T)
    assert len(corners) > 20 and distances.max() < radius - 7.0
    assert (
        np.hypot(*(detect_corners(gray_of(image), np.full((300, 300), 255, np.uint8)) - 149.5).T).max()
        > radius
    )
    tracker = FeatureTracker()
    tracker.add(image)
    tracks = tracker.add(replace(image, stamp_ns=10**8))
    assert tracks is not None and len(tracks) == len(corners)


def test_a_rectified_source_streams_and_passes_on_what_its_source_says() -> None:
    model = MODELS[0]
    rectification = Rectification.of(model)
    images = [
        CameraImage(k, np.full((480, 640), OTHER, np.uint8), np.full((480, 640, 3), k, np.uint8))
        for k in range(3)
    ]
    frames = [*(Frame(k, None, image) for k, image in enumerate(images)), Frame(3, None, None)]
    source = RectifiedSource(KeptDrive("drive", K, None, None, frames, "clockwise"), rectification)
    assert len(source) == 4 and source.name == "drive" and source.camera == rectification.camera
    assert source.sweep == "clockwise" and getattr(source, "truth_is_reference", False) is False
    assert isinstance(source, SeparateReader)
    size = (source.camera.height, source.camera.width)
    for frame in source:
        if frame.image is not None:
            assert frame.image.mask.shape == size and (frame.image.pixels == frame.index).all()
    assert source[3].image is None and source.read_image(3) is None and source.read_scan(1) is None
    ahead = AheadReader(source)
    assert ahead.look(1) is None and ahead.frame(1) == source[1]
    with pytest.raises(IndexError):
        source[4]


def test_stretch_of_a_fisheye_by_its_angles() -> None:
    """Equidistant: r = f theta there, f tan(theta) here: 1 / cos^2 along the radius, tan / theta across."""
    model = FisheyeCamera(PinholeCamera(190.0, 190.0, 321.4, 240.2, 640, 480), field_of_view_deg=190.0)
    rectification = Rectification.of(model)
    camera = rectification.camera
    angles = np.deg2rad([[5.0, 0.0], [50.0, 10.0], [40.0, 100.0], [30.0, 220.0]])
    theta, way = angles.T
    radial = np.column_stack([np.cos(way), np.sin(way)])
    uvs = camera.fx * np.tan(theta)[:, None] * radial + [camera.cx, camera.cy]
    along = rectification.stretch.across(uvs, radial)
    across = rectification.stretch.across(uvs, radial @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    np.testing.assert_allclose(along, 1.0 / np.cos(theta) ** 2, rtol=0.03)
    np.testing.assert_allclose(across, np.tan(theta) / theta, rtol=0.03)


def test_stretch_goes_with_the_image_and_its_contours() -> None:
    rectification = Rectification.of(MODELS[2])
    raw = np.full((480, 640), OTHER, np.uint8)
    raw[200:300, 250:400] = VEHICLE
    image = rectification.image(CameraImage(0, raw, NO_PICTURE))
    assert image.stretch is rectification.stretch
    checked = checked_image(image, rectification.camera, "here")
    features = image_features(0, checked, [SemanticClass.VEHICLE])
    for one in (features, pickle.loads(pickle.dumps(features))):
        contour = one.contours[SemanticClass.VEHICLE]
        assert isinstance(contour, ContourMap) and contour.stretch == rectification.stretch
    # Where pixels were made smaller, the pixels here limit what is seen.
    shrunk = PixelStretch(np.full((2, 2, 3), 0.25, np.float32), 32)
    np.testing.assert_array_equal(shrunk.across(np.ones((1, 2)), np.array([[1.0, 0.0]])), 1.0)
