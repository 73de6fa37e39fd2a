"""A simulated drive written as a bag is read back as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stored import simulated

from sst_graph import open_source
from sst_graph.errors import ConfigError, SstGraphError
from sst_graph.simulator import SimulationConfig, write_bag
from sst_graph.simulator.bag import EPOCH_NS, MASK

STREET = SimulationConfig(frames=2, width=320, height=96, azimuth_limit_deg=50.0, azimuth_step_deg=0.5)


def test_a_bag_holds_the_drive(tmp_path: Path) -> None:
    drive = simulated(STREET)
    found = open_source(write_bag(drive, tmp_path / "bag"), mask_topic=MASK)
    assert found.camera == drive.camera
    assert found.nominal is not None and found.nominal.equals(drive.nominal, 1e-9)
    for expected, frame in zip(drive, found, strict=True):
        scan, image = frame.scan, frame.image
        assert scan is not None and image is not None
        assert expected.scan is not None and expected.image is not None
        assert scan.stamp_ns == image.stamp_ns == EPOCH_NS + expected.scan.stamp_ns
        for name in ("points", "classes", "instances", "rings"):
            np.testing.assert_array_equal(getattr(scan, name), getattr(expected.scan, name), name)
        np.testing.assert_array_equal(image.pixels, expected.image.pixels)
        np.testing.assert_array_equal(image.mask, expected.image.mask)


def test_a_folder_that_is_there_is_kept(tmp_path: Path) -> None:
    (tmp_path / "street").mkdir()
    with pytest.raises(ConfigError, match=r"street: found a file or folder, expected the name of a new one"):
        write_bag(simulated(STREET), tmp_path / "street")


def test_without_labels_there_is_no_mask_and_no_class(tmp_path: Path) -> None:
    write_bag(simulated(STREET), tmp_path / "bag", labels=False)
    with pytest.raises(SstGraphError, match=MASK):
        open_source(tmp_path / "bag", mask_topic=MASK)
    (frame, *_) = open_source(tmp_path / "bag")
    assert frame.scan is not None and not frame.scan.has_labels
    assert frame.image is not None and not frame.image.has_mask
