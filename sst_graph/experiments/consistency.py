"""Does the covariance hold? NEES and coverage of the joint method over many short simulated drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError
from sst_graph.experiments.markdown import table
from sst_graph.experiments.starts import error_of, start_near
from sst_graph.metrics import nees
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import FloatArray

DRIVES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "standing": ("standing, 3 frames", {"motion": "standing", "frames": 3, "time_offset_s": 0.0}),
    "stop": ("with a stop, 12 frames", {"motion": "mixed", "frames": 12, "time_offset_s": 0.1}),
    "no-stop": ("varied speed, 12 frames", {"motion": "no_stop", "frames": 12, "time_offset_s": 0.1}),
}
"""Title and the simulator's settings of every kind of drive."""


@dataclass(frozen=True)
class ConsistencyConfig(Settings):
    """Streets and starts; every run has a street of its own.

    Attributes:
        runs: of each kind of drive.
        drives: kinds of drives.
        seed: of the first street; the next ones follow.
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        lost_deg: a rotation error beyond this is a wrong result, not a matter of covariance [deg].
        label_noise: of the simulator.
        calibration: settings of the method.
    """

    runs: int = setting(100, at_least=2, at_most=100_000)
    drives: tuple[str, ...] = setting(tuple(DRIVES), length=(1, 100))
    seed: int = setting(1000, at_least=0, at_most=10**15)
    start_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    lost_deg: float = setting(2.0, at_least=0.0, at_most=180.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)

    def __post_init__(self) -> None:
        if unknown := [name for name in self.drives if name not in DRIVES]:
            raise ConfigError(f"drives: found {', '.join(unknown)}, expected some of {', '.join(DRIVES)}")


@dataclass(frozen=True)
class ConsistencyRun:
    """Error and claim of one run.

    Attributes:
        error: (7,) in the covariance's own coordinates.
        covariance: (7, 7).
        not_converged: whether the result claims nothing.
        offset_observable: whether the drive determines the time offset; if not, it is not compared.
    """

    error: FloatArray
    covariance: FloatArray
    not_converged: bool
    offset_observable: bool = True

    def judged(self, part: slice) -> slice:
        """The unknowns of a part of the seven that the drive determines."""
        return slice(part.start, part.stop if self.offset_observable else min(part.stop, 6))

    def nees(self, part: slice) -> float:
        """Normalised estimation error squared of some of the seven, over their number."""
        some = self.judged(part)
        return nees(self.error[some], self.covariance[some, some]) / float(some.stop - some.start)


def run(
    config: ConsistencyConfig,
    progress: Progress | None = None,
    drives: Mapping[str, tuple[str, Mapping[str, Any]]] = DRIVES,
) -> str:
    """A Markdown table, one row for every kind of drive and one for all; ``drives`` as :data:`DRIVES`."""
    rows = []
    everything: list[ConsistencyRun] = []
    for name in config.drives:
        title, drive = drives[name]
        runs = []
        for number in range(config.runs):
            runs.append(_run(drive, config.seed + number, config))
            if progress is not None:
                progress(name, number + 1, config.runs)
        rows.append(row(title, runs, config.lost_deg))
        everything += runs
    if len(config.drives) > 1:
        rows.append(row("all", everything, config.lost_deg))
    return table(_HEADER, rows)


def _run(drive: Mapping[str, Any], seed: int, config: ConsistencyConfig) -> ConsistencyRun:
    simulated = simulate(SimulationConfig(seed=seed, label_noise=config.label_noise, **drive))
    prepared = prepare_drives([simulated], config.calibration)
    rng = np.random.default_rng([seed, 11])
    start = start_near(simulated.truth.cTl, config.start_deg, config.start_m, rng)
    result = calibrate_prepared(prepared, start, config.calibration)
    error = error_of(result.calibration, simulated.truth)
    not_converged = result.status == "not_converged" or not result.frames_used
    return ConsistencyRun(
        error, result.covariance, not_converged, offset_observable=drive["motion"] != "standing"
    )


_HEADER = (
    "| drive | runs (not converged, wrong) | NEES / dimension: rotation | translation | time offset | all "
    "| within 95 % intervals: rotation, translation, time offset |"
)

_PARTS = {"rotation": slice(0, 3), "translation": slice(3, 6), "time offset": slice(6, 7), "all": slice(0, 7)}


def row(title: str, runs: Sequence[ConsistencyRun], lost_deg: float) -> list[str]:
    """A row of the table: runs that did not converge and wrong ones are counted and left out of the means."""
    claimed = [r for r in runs if not r.not_converged]
    kept = [r for r in claimed if np.degrees(np.linalg.norm(r.error[:3])) < lost_deg]
    cells, cover = [], []
    for name, part in _PARTS.items():
        judged = [r for r in kept if r.judged(part).stop > part.start]
        cells.append(f"{np.mean([r.nees(part) for r in judged]):.2f}" if judged else "–")
        if judged and name != "all":
            inside = [np.abs(r.error[part]) < 1.96 * np.sqrt(np.diag(r.covariance)[part]) for r in judged]
            cover.append(f"{100.0 * np.mean(inside):.0f} %")
    counts = f"{len(runs)} ({len(runs) - len(claimed)}, {len(claimed) - len(kept)})"
    return [title, counts, *cells, ", ".join(cover)]
