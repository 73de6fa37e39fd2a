"""The halves of a drive by edges: they agree on a drive as it is, and contradict each other after a knock, or
where the pictures of one are late."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from stored import simulated
from streets import LENS_STREET

from sst_graph import CalibrationConfig
from sst_graph.batch.by_edges.halves import halves_reasons
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.outer_loop import JointProblem
from sst_graph.graph.state import State
from sst_graph.simulator import SimulationConfig
from sst_graph.types import CameraImage, Guess
from studies.subtle_faults import knocked, with_numbered_images

STREET = SimulationConfig(
    seed=504,
    frames=20,
    width=828,
    height=250,
    motion="no_stop",
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.25,
    time_offset_s=0.05,
)
COVARIANCE = np.diag(np.square([*np.radians([0.12] * 3), 0.015, 0.015, 0.015, 0.005]))
"""(7, 7) as edges claim it on this street at its usual size."""


@cache
def street() -> KeptDrive:
    return KeptDrive.of(simulated(STREET), sweep="known")


def problem_of(drive: KeptDrive) -> tuple[JointProblem, State]:
    """The drive with its edges, and the estimate of its second half: the truth after the knock."""
    assert drive.truth is not None and drive.truth.time_offset_s is not None
    config = CalibrationConfig(method="edges")
    guess = Guess(drive.truth.cTl, drive.truth.time_offset_s)
    calibration = CalibrationProblem.of(prepare_drives([drive], config), guess, config)
    joint = calibration.joint()
    problem = replace(joint, drives=[thinned(each, 600) for each in joint.drives])
    return problem, State(drive.truth.cTl, (drive.truth.time_offset_s,))


@pytest.mark.slow
def test_halves_of_a_drive_as_it_is_agree() -> None:
    assert halves_reasons(*problem_of(street()), COVARIANCE) == ()


@pytest.mark.slow
def test_a_knock_is_named_though_the_estimate_fits_one_half() -> None:
    problem, state = problem_of(knocked(street(), 3.0))
    (reason,) = halves_reasons(problem, state, COVARIANCE)
    assert "frames 0 to 9 and those from 10 on contradict each other" in reason
    assert "(pitch)" in reason and "mount was moved" in reason
    # The second half's pose says the same of the first.
    turned = gtsam.Pose3(gtsam.Rot3.Ry(np.radians(-3.0)), np.zeros(3))
    (other,) = halves_reasons(problem, replace(state, cTl=state.cTl * turned), COVARIANCE)
    assert "(pitch)" in other


def late_from(drive: KeptDrive, first: int) -> KeptDrive:
    """From some frame on each picture is the one before, as where the camera's driver holds one back."""
    images = [frame.image for frame in drive.frames]

    def late(k: int, image: CameraImage) -> CameraImage:
        before = images[k - 1] if k >= first else image
        return image if before is None else replace(before, stamp_ns=image.stamp_ns)

    return with_numbered_images(drive, late)


@pytest.mark.slow
def test_pictures_that_are_late_in_one_half_are_named_as_such() -> None:
    """What motion says of the time offset is of the first half, and must not hold the second one there."""
    problem, state = problem_of(late_from(street(), 10))
    known = replace(problem, prior=KnownCalibration(state, COVARIANCE))
    (reason,) = halves_reasons(known, state, COVARIANCE)
    assert "the later ones differ in time offset by -10" in reason or "time offset by -9" in reason
    assert "check whether an image or a scan was lost or a clock was set, and calibrate" in reason


@pytest.mark.slow
def test_what_is_known_of_a_drive_as_it_is_contradicts_neither_half() -> None:
    problem, state = problem_of(street())
    known = replace(problem, prior=KnownCalibration(state, COVARIANCE))
    assert halves_reasons(known, state, COVARIANCE) == ()


@pytest.mark.slow
def test_short_drives_are_not_judged() -> None:
    """Six scans a half, though a knock is between them."""
    short = KeptDrive.of(simulated(LENS_STREET), sweep="known")
    problem, state = problem_of(knocked(short, 3.0))
    assert halves_reasons(problem, state, COVARIANCE) == ()
