"""How each camera's calibration fits its labels at the answer of the rig."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache

import gtsam
import numpy as np
import pytest
from rigs import stereo
from stored import stored

from sst_graph import CalibrationConfig
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.drive.preparation import Drive
from sst_graph.fit import Fit, FitQuality
from sst_graph.initialization.global_search import SearchConfig
from sst_graph.report import ReportInputs, report_html
from sst_graph.report.drawn_frame import DriveReader
from sst_graph.report.overlay import project_points
from sst_graph.result import CalibrationResult
from sst_graph.rig import KnownPose, KnownRig, RigResult
from sst_graph.rig.calibrate import calibrate_rig_prepared, prepare_rig
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.simulator.rig import stereo_pose
from sst_graph.types import Calibration, Guess

STREET = SimulationConfig(
    seed=5000,
    frames=8,
    width=621,
    height=188,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.3,
    time_offset_s=0.02,
)
CONFIG = CalibrationConfig(
    method="joint",
    decide_sweep=False,
    use_motion="never",
    lower_edges="never",
    check_contradictions=False,
    find_causes=False,
    search=SearchConfig(enabled=False),
    assumptions=AssumptionConfig(test=False),
)
NAMES = ("left", "right")


@cache
def rig() -> Mapping[str, SimulatedDrive]:
    return stereo(STREET)


@cache
def drives() -> dict[str, list[Drive]]:
    return stored((STREET, "rig"), lambda: prepare_rig({n: [d] for n, d in rig().items()}, CONFIG))


@cache
def solved(known: KnownRig | None = None) -> RigResult:
    step = np.array([*np.radians([0.6, -0.4, 0.5]), 0.03, 0.02, -0.02])
    guesses = {name: Guess(drive.truth.cTl.retract(step)) for name, drive in rig().items()}
    return calibrate_rig_prepared(drives(), guesses, CONFIG, known or KnownRig())


@cache
def together() -> RigResult:
    """With a known pose that is a little off, so that both cameras are moved."""
    off = gtsam.Pose3(gtsam.Rot3.RzRyRx(np.radians([0.03, -0.04, 0.03])), np.array([0.004, -0.003, 0.004]))
    return solved(KnownRig((KnownPose("right", "left", stereo_pose() * off),), one_trigger=True))


def fit_of(result: CalibrationResult) -> Fit:
    assert result.fit is not None
    return result.fit


def misfit_px(result: CalibrationResult, name: str, at: Calibration) -> float:
    """How far residuals are from those of a calibration, beside a bias that all points have [px]."""
    fit = fit_of(result)
    frame = int(np.bincount(fit.points.frames).argmax())
    points = fit.points.take(fit.points.frames == frame)
    drawn = DriveReader([rig()[name]]).frame(fit.frames[frame])
    assert drawn is not None and len(points) > 20
    uvs, _ = project_points(drawn, points, at)
    return float(np.ptp(points.residuals_px - ((uvs - points.pixels) * points.normals).sum(axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_with_nothing_known_the_fit_is_that_of_the_camera_by_itself(name: str) -> None:
    result = solved()[name]
    fit = fit_of(result)
    assert not fit.by_edges and len(fit.profiles) == 7 and len(fit.iterations) > 1
    assert FitQuality.from_diagnostics(result.diagnostics) == fit.quality
    assert fit.quality.share > fit.quality.attainable - 0.05
    assert misfit_px(result, name, result.calibration) < 0.01


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.slow
def test_the_fit_is_measured_at_the_answer_of_the_rig(name: str) -> None:
    result = together()[name]
    own = result.diagnostics["by_own_images"]
    alone = Calibration(gtsam.Pose3(np.array(own["T_camera_lidar"])), own["time_offset_s"])
    assert together().diagnostics["known_poses"][0]["used"]
    assert misfit_px(result, name, result.calibration) < 0.01
    assert misfit_px(result, name, alone) > 0.1
    fit = fit_of(result)
    # Those of the estimate by its own images are left out: it is another one.
    assert fit.profiles == () and fit.iterations == ()
    assert FitQuality.from_diagnostics(result.diagnostics) == fit.quality
    assert fit.quality.share_at_start is not None and fit.quality.share > 2.0 * fit.quality.share_at_start


def test_the_page_of_a_camera_has_its_objects_and_residuals() -> None:
    page = report_html(ReportInputs(together()["right"], [rig()["right"]]))
    assert re.findall(r"<h2>([^<]*)</h2>", page) == [
        "Verdict",
        "What is weak, and what to record next",
        "Before and after",
        "Close-ups of objects",
        "Residuals",
        "Numbers and background",
    ]
    assert "boundary points within 1.5 px of the contour (at the start" in page and "Convergence" not in page
    assert page.count('class="closeup"') >= 3
