"""Drives held in memory, and such as are wrong on purpose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.wrong_drives import with_line_delay
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate


@pytest.fixture(scope="module")
def street() -> SimulatedDrive:
    return simulate(
        SimulationConfig(
            seed=5, frames=2, width=320, height=96, azimuth_step_deg=1.0, motion="constant", label_noise=0.0
        )
    )


def test_a_kept_drive_has_the_sweep_of_its_source(street: SimulatedDrive) -> None:
    assert KeptDrive.of(street).sweep == street.sweep == "known"
    assert KeptDrive.of(street, sweep="auto").sweep == "auto"


def test_frames_stay_and_changes_leave_the_drive_alone(street: SimulatedDrive) -> None:
    drive = KeptDrive.of(street)
    later = drive.with_scans(lambda s: dataclasses.replace(s, stamp_ns=s.stamp_ns + 7))
    assert len(drive) == len(later) == 2
    for before, after, original in zip(drive, later, street, strict=True):
        assert before.scan is not None and after.scan is not None and original.scan is not None
        assert after.scan.stamp_ns == before.scan.stamp_ns + 7 == original.scan.stamp_ns + 7
        assert after.image is before.image


def test_lower_rows_are_exposed_later(street: SimulatedDrive) -> None:
    drive, size = KeptDrive.of(street), 1e-3
    rolling = with_line_delay(street, drive, size)
    band = slice(88, 96)  # the last of twelve, in the middle of which row 91.5 lies
    late_s = size * (91.5 - 47.5)
    config = dataclasses.replace(street.config, time_offset_s=street.config.time_offset_s + late_s)
    then = dataclasses.replace(street, config=config).image(1)
    own, seen = drive[1].image, rolling[1].image
    assert own is not None and seen is not None
    np.testing.assert_array_equal(seen.mask[band], then.mask[band])
    np.testing.assert_array_equal(seen.pixels[band], then.pixels[band])
    assert (seen.pixels[band] != own.pixels[band]).any()
