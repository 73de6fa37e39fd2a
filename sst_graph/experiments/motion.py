"""What motion alone determines on simulated streets, and what it adds to the joint method."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress, prepare_drive
from sst_graph.errors import ConfigError
from sst_graph.experiments.accuracy import mean_nees
from sst_graph.experiments.markdown import median, median_worst, status_counts, table
from sst_graph.experiments.starts import errors_of, start_near
from sst_graph.metrics import CalibrationErrors
from sst_graph.result import Status
from sst_graph.simulator import SimulationConfig, simulate

DRIVES: Mapping[str, Mapping[str, Any]] = {
    "turning": {"motion": "turning"},
    "no-stop": {"motion": "no_stop"},
    "stop": {"motion": "mixed"},
    "constant": {"motion": "constant"},
}
"""Changes to the simulator's settings, by name."""
RUNS: Mapping[str, tuple[bool, Mapping[str, Any]]] = {
    "motion, no guess": (False, {"method": "motion"}),
    "joint, labels only": (True, {"method": "joint", "use_motion": "never"}),
    "joint": (True, {"method": "joint"}),
    "joint, motion always": (True, {"method": "joint", "use_motion": "always"}),
}
"""Whether it starts from a guess, and its settings, by name."""


@dataclass(frozen=True)
class MotionTableConfig(Settings):
    """Streets, drives and starts.

    Attributes:
        streets: number of simulated streets of every drive.
        seed: of the first street; the next ones follow.
        drives: names; all of them by default.
        frames: of each drive.
        time_offset_s: true time offset of the first street; each next one has a quarter of a period more [s].
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        label_noise: of the simulator.
        calibration: settings of the methods.
    """

    streets: int = setting(4, at_least=1, at_most=10_000)
    seed: int = setting(300, at_least=0, at_most=10**15)
    drives: tuple[str, ...] = setting(tuple(DRIVES), length=(1, 100), choices=DRIVES)
    frames: int = setting(40, at_least=1, at_most=10_000)
    time_offset_s: float = setting(0.1, at_least=-0.5, at_most=0.5)
    start_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)

    def __post_init__(self) -> None:
        latest_s = self.time_offset_s + 0.25 * (self.streets - 1) * SimulationConfig().period_s
        if latest_s > 0.5:
            raise ConfigError(
                f"streets: found {self.streets} whose offsets grow from time_offset_s {self.time_offset_s:g} "
                f"to {latest_s:.3g} s, expected offsets of at most 0.5 s"
            )


@dataclass(frozen=True)
class MotionRun:
    """One run: what was run, its errors against the truth, its status, the seconds of its estimate."""

    run: str
    errors: CalibrationErrors
    status: Status
    seconds: float


def run(
    config: MotionTableConfig,
    progress: Progress | None = None,
    outcomes_of: Callable[[MotionTableConfig, str, int], list[MotionRun]] | None = None,
) -> str:
    """Every run on every street of every drive, as a Markdown table of medians and worst cases.

    Args:
        outcomes_of: of the name of a drive and the number of a street; :func:`street_outcomes` by default.
    """
    outcomes_of = outcomes_of or street_outcomes
    rows = []
    for name in config.drives:
        outcomes: list[MotionRun] = []
        for number in range(config.streets):
            outcomes += outcomes_of(config, name, number)
            if progress is not None:
                progress(name, number + 1, config.streets)
        rows += [_row(name, label, [o for o in outcomes if o.run == label]) for label in RUNS]
    return table(_HEADER, rows)


def street_outcomes(config: MotionTableConfig, name: str, number: int) -> list[MotionRun]:
    """All runs on one street; the data are prepared once."""
    street = SimulationConfig(
        seed=config.seed + number, frames=config.frames, label_noise=config.label_noise, **DRIVES[name]
    )
    time_offset_s = config.time_offset_s + 0.25 * number * street.period_s
    source = simulate(dataclasses.replace(street, time_offset_s=time_offset_s))
    drive = prepare_drive(source, config.calibration.classes, config.calibration.prepare)
    rng = np.random.default_rng([street.seed, 9])
    start = start_near(source.truth.cTl, config.start_deg, config.start_m, rng)
    outcomes = []
    for label, (guessed, settings) in RUNS.items():
        calibration = dataclasses.replace(config.calibration, **settings)
        result = calibrate_prepared([drive], start if guessed else None, calibration)
        errors = errors_of(result, source.truth)
        outcomes.append(MotionRun(label, errors, result.status, result.diagnostics["seconds"]["estimate"]))
    return outcomes


_HEADER = (
    "| drive | run | rotation [deg] median / worst | ATD [cm] median / worst "
    "| time offset [ms] median / worst | NEES rotation, translation (of 3), all (of 7) "
    "| ok / unobservable / not converged | seconds |"
)


def _row(name: str, label: str, outcomes: Sequence[MotionRun]) -> list[str]:
    errors = [outcome.errors for outcome in outcomes]
    return [
        name,
        label,
        median_worst([e.qad_deg for e in errors], 3),
        median_worst([100.0 * e.atd_m for e in errors], 2),
        median_worst([1e3 * abs(e.time_offset_s or 0.0) for e in errors], 2),
        mean_nees(errors),
        status_counts([outcome.status for outcome in outcomes]),
        median([o.seconds for o in outcomes], 1),
    ]
