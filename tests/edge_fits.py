"""A short street without labels, solved by edges from near the truth, and how the solution fits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
from stored import simulated, stored

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.by_edges.method import fit_of_edges
from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.method_estimate import Guess
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.drive.preparation import Drive
from sst_graph.fit import Fit
from sst_graph.graph.outer_loop import JointSolution, solve_joint
from sst_graph.graph.state import State
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.simulator import SimulatedDrive, SimulationConfig

STREET = SimulationConfig(
    seed=504,
    frames=6,
    width=828,
    height=250,
    motion="no_stop",
    azimuth_limit_deg=50.0,
    time_offset_s=0.05,
)
CONFIG = CalibrationConfig(method="edges")
SIGMAS = np.array([*np.radians([0.25] * 3), 0.02, 0.02, 0.08, 0.005])
"""(7,) of the result [rad, m, s]."""
START_STEP = np.array([*np.radians([1.0, -1.0, 0.8]), 0.05, -0.04, 0.03])
"""(6,) from the truth to the guess [rad, m]."""


def street_by_edges() -> SimulatedDrive:
    return simulated(STREET)


@cache
def problem_by_edges() -> CalibrationProblem:
    street = street_by_edges()
    assert street.truth is not None
    guess = Guess(street.truth.cTl.retract(START_STEP), 0.0)
    return CalibrationProblem.of(_drives(), guess, CONFIG)


@cache
def solution_by_edges() -> JointSolution:
    """From the truth, again and again: soft matches make short steps."""
    truth = street_by_edges().truth
    assert truth is not None and truth.time_offset_s is not None
    state = State(truth.cTl, (truth.time_offset_s,))
    for _ in range(8):
        solution = solve_joint(problem_by_edges().joint(), state, NEAR_KERNELS_PX)
        state = solution.state
    return solution


def fit_at(step: np.ndarray, config: CalibrationConfig = CONFIG) -> Fit:
    """How the solution fits after a step (7,) of extrinsic and time offset."""
    solution = solution_by_edges()
    offset_s = solution.state.time_offsets_s[0] + float(step[6])
    state = replace(solution.state, cTl=solution.state.cTl.retract(step[:6]), time_offsets_s=(offset_s,))
    problem = replace(problem_by_edges(), config=config)
    fit = fit_of_edges(problem, [replace(solution, state=state)], np.diag(SIGMAS**2))
    assert fit is not None
    return fit


@cache
def fit_by_edges() -> Fit:
    return fit_at(np.zeros(7))


def result_by_edges() -> CalibrationResult:
    """With the fit, as method edges returns it."""
    street, state, fit = street_by_edges(), solution_by_edges().state, fit_by_edges()
    return CalibrationResult(
        state.cTl,
        state.time_offsets_s[0],
        np.diag(SIGMAS**2),
        "ok",
        street.camera,
        frames_used=tuple(FrameId(street.name, frame.scan) for frame in fit.frames),
        method="edges",
        initial=gtsam.Pose3(problem_by_edges().guess.cTl),
        diagnostics={"fit_quality": fit.quality.to_dict()},
        fit=fit,
    )


@cache
def _drives() -> list[Drive]:
    return stored((STREET, "drives by edges"), lambda: prepare_drives([street_by_edges()], CONFIG))
