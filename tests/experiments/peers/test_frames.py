"""Scans at the instants of their images, and jumps of range."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from stored import simulated

from sst_graph.batch import CalibrationConfig, prepare_drives
from sst_graph.data import open_source
from sst_graph.drive.preparation import prepare_drive
from sst_graph.experiments.peers.frames import peer_frames, range_jumps
from sst_graph.experiments.peers.mask_consistency import masks_of
from sst_graph.odometry.sweep import with_sweep
from sst_graph.simulator import SimulationConfig, write_drive
from sst_graph.types import SemanticClass

STREET = SimulationConfig(
    seed=3,
    frames=3,
    motion="constant",
    width=621,
    height=187,
    azimuth_limit_deg=60.0,
    time_offset_s=0.05,
    label_noise=0.0,
    moving_fraction=0.0,
)


@pytest.mark.slow
def test_points_stand_where_the_image_sees_them() -> None:
    """Labelled points fall on their class with the truth, clearly fewer without the motion of 43 cm."""
    source = simulated(STREET)
    drive = prepare_drives([source], CalibrationConfig(method="joint"))[0]
    shares = []
    for offset_s in (0.05, 0.0):
        hits = total = 0
        for frame in peer_frames(source, drive, offset_s, 3):
            poles = np.isin(frame.classes, (SemanticClass.VEHICLE, SemanticClass.POLE))
            inside, uvs = frame.pixels(source.truth.cTl, frame.lPs[poles])
            rows, columns = np.round(uvs[:, 1]).astype(int), np.round(uvs[:, 0]).astype(int)
            seen = frame.mask[rows.clip(0, 186), columns.clip(0, 620)]
            hits += np.count_nonzero(seen == frame.classes[poles][inside])
            total += len(inside)
        shares.append(hits / total)
    assert shares[0] > 0.95 and shares[0] > shares[1] + 0.02


def test_a_point_before_something_far_has_a_jump() -> None:
    azimuth = np.radians(np.arange(-20.0, 20.0, 0.5))
    distance = np.where(np.abs(azimuth) < np.radians(5.0), 10.0, 30.0)
    points = np.stack(
        [distance * np.cos(azimuth), distance * np.sin(azimuth), np.zeros_like(azimuth)], axis=1
    )
    jumps = range_jumps(points, np.zeros(len(points), np.uint16))
    near = np.flatnonzero(distance == 10.0)
    np.testing.assert_allclose(jumps[[near[0], near[-1]]], 20.0)
    others = np.delete(jumps, [near[0], near[-1]])
    np.testing.assert_allclose(others, 0.0, atol=1e-9)


def test_every_pixel_has_a_mask() -> None:
    source = simulated(STREET)
    drive = prepare_drives([source], CalibrationConfig(method="joint"))[0]
    (frame,) = peer_frames(source, drive, 0.05, 1)
    masks, sizes = masks_of(frame)
    assert sizes.sum() == masks.size and sizes[0] == 0 and (sizes[1:] > 0).all()
    assert frame.instances is not None
    vehicles = frame.mask == SemanticClass.VEHICLE
    for number in np.unique(masks[vehicles]):
        own = masks == number
        assert len(np.unique(frame.instances[own])) == 1 and (frame.mask[own] == SemanticClass.VEHICLE).all()


def test_frames_of_a_drive_on_disk_have_its_instances(tmp_path: Path) -> None:
    """Instances are read with a frame only, and a source whose scans are swept leaves them out."""
    write_drive(simulated(STREET), tmp_path)
    for picture in sorted(tmp_path.glob("sequences/*/image_2/*.png")):
        path = picture.parent.parent / "instance_2" / picture.name
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((187, 621), 26 * 256 + 7, np.uint16))
    source = open_source(str(tmp_path))
    config = CalibrationConfig(method="joint")
    swept = with_sweep(source, config.decide_sweep)
    drive = prepare_drive(swept, config.classes, config.prepare)
    (frame,) = peer_frames(swept, drive, 0.05, 1, source)
    assert frame.instances is not None and (frame.instances == 7).all()
