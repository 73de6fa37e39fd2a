"""Accuracy and consistency of the joint method on simulated streets, scenario by scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError
from sst_graph.experiments.markdown import median_worst, status_counts, table
from sst_graph.experiments.starts import errors_of, start_near
from sst_graph.metrics import CalibrationErrors
from sst_graph.result import Status
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass


@dataclass(frozen=True)
class Scenario:
    """One kind of drive and of start.

    Attributes:
        title: its row in the table.
        drive: changes to the simulator's settings.
        classes: that are aligned.
        guess: False starts from nothing at all.
        starts: starts tried on every street.
    """

    title: str
    drive: Mapping[str, Any]
    classes: tuple[SemanticClass, ...] = (SemanticClass.VEHICLE,)
    guess: bool = True
    starts: int = 1


_MANY = (
    SemanticClass.VEHICLE,
    SemanticClass.BUILDING,
    SemanticClass.VEGETATION,
    SemanticClass.POLE,
    SemanticClass.PERSON,
    SemanticClass.FENCE,
    SemanticClass.SIGN,
)
_STANDING = {"motion": "standing", "frames": 3, "time_offset_s": 0.0}
_STOP = {"motion": "mixed", "frames": 40, "time_offset_s": 0.1}

SCENARIOS: Mapping[str, Scenario] = {
    "standing": Scenario("standing, 3 frames", _STANDING, starts=10),
    "standing-none": Scenario("standing, 3 frames, no guess", _STANDING, guess=False),
    "stop-100": Scenario("moving with a stop, 40 frames, 100 ms", _STOP),
    "stop-200": Scenario("the same, 200 ms", {**_STOP, "time_offset_s": 0.2}),
    "stop-300": Scenario("the same, 300 ms", {**_STOP, "time_offset_s": 0.3}),
    "classes": Scenario("the same, 100 ms, all classes", _STOP, _MANY),
    "no-stop": Scenario("no standing frame, varied speed", {**_STOP, "motion": "no_stop"}),
    "constant": Scenario("constant speed, straight", {**_STOP, "motion": "constant"}),
    "half-moving": Scenario("half of the vehicles moving", {**_STOP, "moving_fraction": 0.5}),
    "mostly-moving": Scenario("four of five vehicles moving", {**_STOP, "moving_fraction": 0.8}),
    "rolling": Scenario("rolling sweep with times", {**_STOP, "rolling": True}),
}


@dataclass(frozen=True)
class AccuracyConfig(Settings):
    """Streets, starts and scenarios.

    Attributes:
        streets: number of simulated streets of every scenario.
        seed: of the first street; the next ones follow.
        scenarios: names; all of them by default.
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        failed_deg: rotation error (QAD) beyond which a run has failed [deg].
        label_noise: of the simulator.
        calibration: settings of the method.
    """

    streets: int = setting(10, at_least=1, at_most=10_000)
    seed: int = setting(100, at_least=0, at_most=10**15)
    scenarios: tuple[str, ...] = setting(tuple(SCENARIOS), length=(1, 100), choices=SCENARIOS)
    start_deg: float = setting(20.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    failed_deg: float = setting(1.0, at_least=0.0, at_most=180.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)


@dataclass(frozen=True)
class AccuracyRun:
    """One run: its errors against the truth, its status, whether it failed."""

    errors: CalibrationErrors
    status: Status
    failed: bool


def run(config: AccuracyConfig, progress: Progress | None = None) -> str:
    """All scenarios on all streets, as a Markdown table.

    Raises:
        ConfigError: the method aligns no time offset and no covariance can be judged.
    """
    if config.calibration.method not in ("auto", "joint"):
        raise ConfigError(f"accuracy is about the joint method, found {config.calibration.method}")
    rows = []
    for name in config.scenarios:
        outcomes: list[AccuracyRun] = []
        for street in range(config.streets):
            outcomes += _street(SCENARIOS[name], config, config.seed + street)
            if progress is not None:
                progress(name, street + 1, config.streets)
        rows.append(_row(SCENARIOS[name], outcomes))
    return table(_HEADER, rows)


def _street(scenario: Scenario, config: AccuracyConfig, seed: int) -> list[AccuracyRun]:
    """Every start on one street; the data are prepared once."""
    settings: dict[str, Any] = {"label_noise": config.label_noise, **scenario.drive}
    drive = simulate(SimulationConfig(seed=seed, **settings))
    calibration = dataclasses.replace(config.calibration, classes=scenario.classes)
    prepared = prepare_drives([drive], calibration)
    rng = np.random.default_rng([seed, 7])
    outcomes = []
    for _ in range(scenario.starts):
        start = start_near(drive.truth.cTl, config.start_deg, config.start_m, rng) if scenario.guess else None
        result = calibrate_prepared(prepared, start, calibration)
        errors = errors_of(result, drive.truth)
        outcomes.append(AccuracyRun(errors, result.status, errors.qad_deg > config.failed_deg))
    return outcomes


_HEADER = (
    "| scenario | runs | failed (silent) | rotation [deg] median / p95 | ATD [cm] median / p95 "
    "| time offset [ms] median / p95 | NEES rotation, translation (of 3), all (of 7) "
    "| ok / unobservable / not converged |"
)


def _row(scenario: Scenario, outcomes: Sequence[AccuracyRun]) -> list[str]:
    """A row; medians and percentiles are over all runs, failed ones included."""
    failed = [outcome for outcome in outcomes if outcome.failed]
    silent = sum(outcome.status == "ok" for outcome in failed)
    errors = [outcome.errors for outcome in outcomes]
    worst = partial(np.percentile, q=95)
    rotation = median_worst([e.qad_deg for e in errors], 3, worst)
    translation = median_worst([100.0 * e.atd_m for e in errors], 2, worst)
    standing = scenario.drive.get("motion") == "standing"
    time_offset = [1e3 * abs(e.time_offset_s or 0.0) for e in errors if not standing]
    return [
        scenario.title,
        str(len(outcomes)),
        f"{len(failed)} ({silent})",
        rotation,
        translation,
        median_worst(time_offset, 2, worst),
        mean_nees(errors),
        status_counts([outcome.status for outcome in outcomes]),
    ]


def mean_nees(errors: Sequence[CalibrationErrors]) -> str:
    """Mean NEES of rotation, translation and all seven unknowns."""
    nees = [e.nees for e in errors if e.nees is not None]
    means = [np.mean([getattr(n, part) for n in nees]) for part in ("rotation", "translation", "joint")]
    return ", ".join(f"{mean:.1f}" for mean in means)
