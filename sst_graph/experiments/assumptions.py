"""Assumptions broken on purpose: which are found, and what the others do to the answer and its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.data.simulator import SimulationConfig, simulate
from sst_graph.errors import ConfigError
from sst_graph.estimators import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.experiments.wrong_drives import WRONG, KeptDrive
from sst_graph.problem.drive import Progress
from sst_graph.result import CalibrationResult

FloatArray = NDArray[np.float64]

SIZES: dict[str, tuple[float, ...]] = {
    "focal": (0.002, 0.005, 0.01, 0.02),
    "cx": (1.0, 5.0, 15.0, 30.0),
    "cy": (1.0, 5.0, 15.0, 30.0),
    "k1": (0.003, 0.01, 0.03, 0.1),
    "k2": (0.003, 0.01, 0.03, 0.1),
    "skew": (0.002, 0.005, 0.01, 0.02),
    "range_bias": (0.02, 0.1, 0.3, 1.0),
    "range_scale": (0.005, 0.02, 0.05, 0.1),
}
"""Sizes by which each assumption is broken, in its unit, in either sense."""


@dataclass(frozen=True)
class AssumptionTableConfig(Settings):
    """Streets, and how their data are broken.

    Attributes:
        streets: simulated streets.
        seed: of the first one; the next ones follow.
        frames: of each drive.
        names: assumptions that are broken; none: all.
        clean: whether the streets are calibrated as they are, too.
        calibration: settings of the method.
    """

    streets: int = setting(5, at_least=1, at_most=10_000)
    seed: int = setting(700, at_least=0, at_most=2**31)
    frames: int = setting(30, at_least=3, at_most=1000)
    names: tuple[str, ...] = ()
    clean: bool = True
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)

    def __post_init__(self) -> None:
        if unknown := [name for name in self.names if name not in WRONG]:
            raise ConfigError(f"names: found {', '.join(unknown)}, expected some of {', '.join(WRONG)}")


@dataclass(frozen=True)
class _Run:
    """One calibration: what was found, and how far it was off (7,) [rad, m, s]."""

    result: CalibrationResult
    error: FloatArray

    @property
    def contradicted(self) -> list[str]:
        """Assumptions that the data contradict, by name."""
        report = self.result.diagnostics.get("assumptions", {})
        return [name for name, entry in report.items() if entry.get("contradicted")]

    @property
    def nees(self) -> float:
        """Normalised error squared over its dimension."""
        return float(self.error @ np.linalg.solve(self.result.covariance, self.error)) / 7.0


def run(config: AssumptionTableConfig, progress: Progress | None = None) -> str:
    """A Markdown table: a row for each assumption and size, both senses together.

    "Silent" runs are ``ok`` with a NEES above 9 per dimension: more than three sigmas off.
    """
    names = config.names or tuple(WRONG)
    cases = [("none", 0.0)] if config.clean else []
    cases += [(name, sign * size) for name in names for size in SIZES[name] for sign in (1.0, -1.0)]
    runs: dict[tuple[str, float], list[_Run]] = {}
    for street in range(config.streets):
        drive = simulate(SimulationConfig(seed=config.seed + street, frames=config.frames, time_offset_s=0.1))
        kept = KeptDrive.of(drive)
        for number, (name, size) in enumerate(cases):
            broken = kept if name == "none" else WRONG[name](kept, size)
            runs.setdefault((name, abs(size)), []).append(_calibrated(broken, config.calibration))
            if progress is not None:
                progress("assumptions", street * len(cases) + number + 1, config.streets * len(cases))
    rows = [_row(name, size, some) for (name, size), some in runs.items()]
    return "\n".join([_HEADER, "|---|---|---|---|---|---|---|---|---|", *rows]) + "\n"


def _calibrated(drive: KeptDrive, config: CalibrationConfig) -> _Run:
    result = calibrate_prepared(prepare_drives([drive], config), drive.nominal, config)
    assert drive.truth is not None
    step = np.asarray(gtsam.Pose3.Logmap(result.T_camera_lidar.between(drive.truth.cTl)))
    return _Run(result, np.append(step, (drive.truth.time_offset_s or 0.0) - result.time_offset_s))


_HEADER = (
    "| assumption | off by ± | runs | contradicted | named first | not ok | silent "
    "| error [deg, cm, ms], median | NEES / dimension, median |"
)


def _row(name: str, size: float, runs: Sequence[_Run]) -> str:
    count = len(runs)
    found = sum(bool(run.contradicted) for run in runs)
    named = sum(_first(run) == name for run in runs)
    doubted = sum(run.result.status != "ok" for run in runs)
    silent = sum(run.result.status == "ok" and run.nees > 9.0 for run in runs)
    turn = np.degrees(np.median([np.linalg.norm(run.error[:3]) for run in runs]))
    shift = 100.0 * np.median([np.linalg.norm(run.error[3:6]) for run in runs])
    offset = 1e3 * np.median([abs(run.error[6]) for run in runs])
    nees = np.median([run.nees for run in runs])
    cells = [
        name,
        f"{size:g}" if size else "–",
        str(count),
        str(found),
        str(named) if size else "–",
        str(doubted),
        str(silent),
        f"{turn:.3f}, {shift:.2f}, {offset:.2f}",
        f"{nees:.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _first(run: _Run) -> str | None:
    """The assumption that is contradicted most."""
    report = run.result.diagnostics.get("assumptions", {})
    entries = {name: report[name] for name in run.contradicted}
    ratios = {name: abs(e["estimate"]) / e["estimate_sigma"] for name, e in entries.items()}
    return max(ratios, key=lambda name: ratios[name], default=None)
