"""Streets through a lens: pictures and labels lie where the model says, and calibrate like a pinhole's."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from streets import CROWDED_STREET

from sst_graph.batch import calibrate_prepared, prepare_drives
from sst_graph.batch.config import CalibrationConfig
from sst_graph.cameras import BrownConradyCamera, CameraModel, FisheyeCamera, Rectification
from sst_graph.data.rectified import RectifiedSource
from sst_graph.experiments.starts import errors_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass, Source
from studies.simulators.lens import LensDrive

STREET = SimulationConfig(
    seed=3,
    frames=3,
    width=621,
    height=188,
    motion="standing",
    time_offset_s=0.0,
    azimuth_step_deg=0.35,
    vehicle_density=0.3,
)


def lens(name: str) -> CameraModel:
    camera = simulate(STREET).camera
    if name == "barrel":
        return BrownConradyCamera(camera, (-0.3, 0.1, 0.0, 0.0, 0.0))
    focal = camera.width / np.deg2rad(190.0)
    return FisheyeCamera(
        PinholeCamera(focal, focal, 310.0, 93.5, camera.width, camera.height), field_of_view_deg=190.0
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_points_of_vehicles_fall_on_their_mask(name: str) -> None:
    """Exact labels, by the true extrinsic and the model; of the fisheye also far to its sides."""
    drive = simulate(replace(STREET, label_noise=0.0, beam_divergence_mrad=0.0))
    model = lens(name)
    frame = LensDrive(drive, model)[0]
    assert frame.scan is not None and frame.image is not None
    lPs = frame.scan.points[frame.scan.classes == SemanticClass.VEHICLE].astype(np.float64)
    cTl = drive.truth.cTl
    uvs, seen = model.project(lPs @ cTl.rotation().matrix().T + cTl.translation())
    uvs = uvs[seen]
    uvs = uvs[model.intrinsics.in_image(uvs)]
    u, v = np.rint(uvs).astype(int).T
    vehicle = (frame.image.mask == SemanticClass.VEHICLE).astype(np.uint8)
    border = cv2.distanceTransform(vehicle, cv2.DIST_L2, 5) + cv2.distanceTransform(
        1 - vehicle, cv2.DIST_L2, 5
    )
    inner = border[v, u] > 2.0
    assert inner.sum() > 150
    assert vehicle[v, u][inner].mean() > 0.97
    if name == "fisheye":
        rays, _ = model.unproject(uvs)
        assert (np.rad2deg(np.arccos(rays[:, 2])) > 60.0).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_a_rectified_street_is_the_pinholes(name: str) -> None:
    """Exact labels: the rectified mask is that of the rectified camera but for its contours."""
    drive = simulate(replace(STREET, label_noise=0.0))
    rectification = Rectification.of(lens(name))
    ours = rectification.image(LensDrive(drive, rectification.model).read_image(1)).mask
    theirs = replace(drive, camera=rectification.camera).image(1).mask
    apart = (ours != theirs) & rectification.valid
    inside = (theirs == SemanticClass.VEHICLE).astype(np.uint8)
    # Away from the contour by the pixel that the lens is coarser, nothing differs on vehicles.
    core = cv2.erode(inside, np.ones((9, 9), np.uint8)) > 0
    assert core.sum() > 50 and not apart[core].any()
    # And no systematic growth: as many pixels of vehicles on the whole.
    assert (ours == SemanticClass.VEHICLE).sum() == pytest.approx(inside.sum(), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most_deg"), [("barrel", 0.3), ("fisheye", 0.5)])
def test_a_street_through_a_lens_calibrates(name: str, most_deg: float) -> None:
    """From 1.5 degrees and 5 cm off, half the usual size: a pixel of the fisheye is 0.3 degrees wide."""
    drive = simulate(CROWDED_STREET)
    rectification = Rectification.of(lens(name))
    source: Source = RectifiedSource(LensDrive(drive, rectification.model), rectification)
    config = CalibrationConfig()
    result = calibrate_prepared(prepare_drives([source], config), drive.nominal, config)
    errors = errors_of(result, drive.truth)
    assert errors.qad_deg < most_deg, errors
    assert errors.atd_m < 0.05, errors
