"""A result by motion is judged by edges of the pictures, which it has not used."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from moving_drives import OFFSET_S, TRUE, made_drive, weaving
from stored import simulated, stored

from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch import calibrate_prepared
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.motion_method import check_by_edges
from sst_graph.drive.preparation import Drive
from sst_graph.fit import Fit, FitQuality
from sst_graph.graph.state import State
from sst_graph.hand_eye.solution import MotionSolution, solve_motion
from sst_graph.inspect.verdict import fit_line
from sst_graph.report import ReportInputs, report_html
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.types import Guess, SemanticClass

STREET = SimulationConfig(
    seed=504,
    frames=8,
    width=828,
    height=250,
    motion="turning",
    azimuth_limit_deg=50.0,
    time_offset_s=0.02,
)
CONFIG = CalibrationConfig(method="motion", decide_sweep=False)


def street() -> SimulatedDrive:
    return simulated(STREET)


@cache
def drives() -> list[Drive]:
    return stored((STREET, "drives by motion"), lambda: prepare_drives([street()], CONFIG))


@cache
def guess() -> Guess:
    assert street().truth is not None
    return Guess(street().truth.cTl.retract(np.array([0.03, -0.03, 0.02, 0.05, -0.04, 0.03])), 0.0)


@cache
def solution() -> MotionSolution:
    return solve_motion(drives(), guess())[0]


@cache
def result() -> CalibrationResult:
    return calibrate_prepared(drives(), guess().cTl, CONFIG)


@cache
def page() -> str:
    return report_html(ReportInputs(result(), [street()]))


def at(cTl: gtsam.Pose3) -> FitQuality:
    """Of a solution by motion at an extrinsic and the true time offset."""
    moved = replace(solution(), state=State(cTl, (STREET.time_offset_s,)))
    fit = check_by_edges(drives(), guess(), CONFIG, moved)
    assert fit is not None
    return fit.quality


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.slow
def test_a_result_that_is_turned_has_a_worse_share(axis: int) -> None:
    truth = street().truth
    assert truth is not None
    true = at(truth.cTl)
    assert true.by_chance is not None and true.share > 1.4 * true.by_chance
    for sign in (-1.0, 1.0):
        turn = np.zeros(6)
        turn[axis] = sign * np.radians(1.0)
        turned = at(truth.cTl.retract(turn))
        assert turned.share < 0.8 * true.share
        assert turned.share_at_start == true.share_at_start


def test_a_result_by_motion_has_the_fit_of_its_edges() -> None:
    fit = result().fit
    assert isinstance(fit, Fit) and fit.by_edges and result().fit_is_check and fit.profiles == ()
    assert FitQuality.from_diagnostics(result().diagnostics) == fit.quality
    assert len(fit.iterations) >= result().diagnostics["outer_iterations"] > 0
    assert fit.iterations[-1].cTl.equals(result().T_camera_lidar, 0.0)
    assert set(fit.points.classes.tolist()) == {int(SemanticClass.OBJECT)}
    line = fit_line(result())
    assert line.startswith("a check by edges of the pictures, which the estimate has not used: ")
    assert "at random rotations" in line


def test_the_check_changes_nothing_and_is_left_out_without_a_report() -> None:
    config = replace(CONFIG, for_report=False)
    plain = calibrate(street(), guess().cTl, config)
    assert plain.fit is None and "fit_quality" not in plain.diagnostics
    assert not any(scan.boundaries for scan in prepare_drives([street()], config)[0].scans)
    without = {name: value for name, value in result().diagnostics.items() if name != "fit_quality"}
    assert replace(result(), fit=None, diagnostics=without) == plain


def test_motions_alone_have_nothing_to_be_judged_by() -> None:
    found = calibrate_prepared([made_drive(weaving)], TRUE, CONFIG, initial_time_offset_s=OFFSET_S)
    assert found.fit is None and found.frames_used


def test_the_page_says_that_it_is_a_check() -> None:
    headings = re.findall(r"<h2>([^<]*)</h2>", page())
    assert headings == [
        "Verdict",
        "What is weak, and what to record next",
        "Before and after",
        "Close-ups of objects",
        "Residuals",
        "Numbers and background",
    ]
    assert "A check by edges of the pictures, which the estimate has not used" in page()
    assert "Convergence" in page() and "% of the information" not in page()
    said = " ".join(re.findall(r"<(?:p|h3|figcaption)[^>]*>([^<]*)<", page()))
    assert "label" not in said and "determines most" not in said
