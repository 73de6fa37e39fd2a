"""The table of SST-Calib (Kodaira et al., ITSC 2022) on simulated streets, with our methods beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.batch.config import Method
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress, prepare_drive
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.result import Status
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import GroundTruth

PUBLISHED = (
    "| *printed:* SST-Calib, static stage | – | 8.8 % | – | 1.28 / 0.81 | – | 18.9 / 12.8 | – |",
    "| *printed:* SST-Calib, joint stage | – | – | – | 0.67 / 0.66 | – | 7.45 / 5.52 | 3.4 |",
    "| *printed:* SemAlign | – | – | – | 1.14 / 0.46 | – | – | – |",
)
"""The paper's own figures, from starts of 10 degrees on KITTI sequence 00, laid out as ours."""


@dataclass(frozen=True)
class PaperTableConfig(Settings):
    """Streets, starts and methods.

    Attributes:
        streets: number of simulated streets, one run of every method on each.
        seed: of the first street; the next ones follow.
        methods: that are compared.
        frames: of each street, which stands, accelerates, turns and brakes.
        images_late: each image shows the world this many frame times after its scan.
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        failed_deg, failed_m: rotation (QAD) or translation (ATD) beyond which a run has failed.
        label_noise: of the simulator.
        calibration: settings of every method.
    """

    streets: int = setting(20, at_least=1, at_most=10_000)
    seed: int = setting(0, at_least=0, at_most=10**15)
    methods: tuple[Method, ...] = setting(("paper", "static", "semalign", "joint"), length=(1, 100))
    frames: int = setting(60, at_least=1, at_most=10_000)
    images_late: int = setting(1, at_least=-4, at_most=4)
    start_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    failed_deg: float = setting(5.0, at_least=0.0, at_most=180.0)
    failed_m: float = setting(0.5, at_least=0.0, at_most=100.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)

    def street(self, number: int) -> SimulationConfig:
        """The simulation of a street."""
        settings = SimulationConfig(
            seed=self.seed + number,
            frames=self.frames,
            motion="mixed",
            label_noise=self.label_noise,
            azimuth_limit_deg=60.0,
        )
        return dataclasses.replace(settings, time_offset_s=self.images_late * settings.period_s)


@dataclass(frozen=True)
class Run:
    """One method on one street.

    Attributes:
        method: its name; ``start`` for the start itself.
        errors: against the truth.
        status: what the result says of itself; None for a start.
        seconds: time taken after reading the drive [s].
    """

    method: str
    errors: CalibrationErrors
    status: Status | None
    seconds: float = 0.0


def run(config: PaperTableConfig, progress: Progress | None = None) -> str:
    """The table as Markdown."""
    runs = []
    for number in range(config.streets):
        runs += street_runs(config, number)
        if progress is not None:
            progress("streets", number + 1, config.streets)
    return markdown(config, runs)


def street_runs(config: PaperTableConfig, number: int) -> list[Run]:
    """The start and every method from it, on one street."""
    source = simulate(config.street(number))
    drive = prepare_drive(source, config.calibration.classes, config.calibration.prepare)
    start = wrong_start(source.truth.cTl, config, number)
    runs = [Run("start", calibration_errors(start, 0.0, source.truth), None)]
    for method in config.methods:
        settings = dataclasses.replace(config.calibration, method=method)
        result = calibrate_prepared([drive], start, settings)
        truth = GroundTruth(source.truth.cTl, source.truth.time_offset_s)
        errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, truth)
        runs.append(Run(method, errors, result.status, result.diagnostics["seconds"]["estimate"]))
    return runs


def wrong_start(cTl: gtsam.Pose3, config: PaperTableConfig, number: int) -> gtsam.Pose3:
    """The true pose turned (rotation vector, camera side) and shifted by seeded uniform errors."""
    rng = np.random.default_rng([config.seed + number, 7])
    turn = np.radians(rng.uniform(-config.start_deg, config.start_deg, 3))
    shift = rng.uniform(-config.start_m, config.start_m, 3)
    return gtsam.Pose3(gtsam.Rot3.Expmap(turn) * cTl.rotation(), cTl.translation() + shift)


def failed(errors: CalibrationErrors, config: PaperTableConfig) -> bool:
    """Whether a run has failed."""
    return errors.qad_deg > config.failed_deg or errors.atd_m > config.failed_m


def markdown(config: PaperTableConfig, runs: Sequence[Run]) -> str:
    """The table of runs: means and medians of those that did not fail."""
    lines = [
        f"{config.streets} simulated streets (seeds {config.seed} to {config.seed + config.streets - 1}, "
        f"label noise {config.label_noise:g}, {config.frames} frames), images {config.images_late} frame "
        f"late, starts within ±{config.start_deg:g}° and ±{100 * config.start_m:g} cm by axis. Failed: QAD "
        f"above {config.failed_deg:g}° or ATD above {100 * config.failed_m:g} cm. Figures are mean / median "
        "of the runs that did not fail, and the median of all in its own column.",
        "",
        "| method | QAD of all, median [deg] | failed | of these flagged | QAD [deg] | AEAD [deg] | "
        "ATD [cm] | abs. time error, median [ms] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [_row(method, runs, config) for method in ("start", *config.methods)]
    return "\n".join([*lines, *PUBLISHED]) + "\n"


def _row(method: str, runs: Sequence[Run], config: PaperTableConfig) -> str:
    own = [r for r in runs if r.method == method]
    bad = [r for r in own if failed(r.errors, config)]
    good = [r.errors for r in own if not failed(r.errors, config)]
    flagged = [r for r in bad if r.status != "ok"]
    cells = [
        method,
        f"{np.median([r.errors.qad_deg for r in own]):.2f}",
        f"{len(bad)} of {len(own)}",
        f"{len(flagged)} of {len(bad)}" if bad and method != "start" else "–",
        _mean_median([e.qad_deg for e in good], 2),
        _mean_median([e.aead_deg for e in good], 2),
        _mean_median([100.0 * e.atd_m for e in good], 1),
        _time(method, good),
    ]
    return "| " + " | ".join(cells) + " |"


def _mean_median(values: Sequence[float], digits: int) -> str:
    if not values:
        return "–"
    return f"{np.mean(values):.{digits}f} / {np.median(values):.{digits}f}"


def _time(method: str, errors: Sequence[CalibrationErrors]) -> str:
    """Median absolute time error of the methods that estimate the offset."""
    if method not in ("paper", "joint") or not errors:
        return "–"
    return f"{1e3 * np.median([abs(e.time_offset_s or 0.0) for e in errors]):.1f}"
