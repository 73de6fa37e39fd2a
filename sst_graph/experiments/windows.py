"""Real drives cut into windows: do the results spread as far as their covariances claim?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate
from sst_graph.config import Settings, setting
from sst_graph.data import open_source
from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError
from sst_graph.experiments.markdown import table
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

PARTS = (slice(0, 3), slice(3, 6), slice(6, 7))
"""Rotation, translation and time offset among the seven unknowns."""


@dataclass(frozen=True)
class WindowsConfig(Settings):
    """Drives and how they are cut.

    Attributes:
        data: folders of drives that bring a nominal calibration, the guess of every window.
        windows: numbers of equal windows that each drive is cut into, one row of the table each; and, with
            several drives, one more for windows of the same number in one graph.
        shift: image shift.
        calibration: settings of the method.
    """

    data: tuple[str, ...] = setting((), length=(0, 1000))
    windows: tuple[int, ...] = setting((2, 3, 4), at_least=2, at_most=1000, length=(1, 100))
    shift: int = setting(0, at_least=-1000, at_most=1000)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)


def run(config: WindowsConfig, progress: Progress | None = None) -> str:
    """A Markdown table: one row for every drive and number of windows, and for all drives in one graph.

    Raises:
        ConfigError: no data.
        DataError: a drive cannot be used.
    """
    if not config.data:
        raise ConfigError("data: found none, expected folders, such as --set 'data=[\"DRIVE\"]'")
    rows = []
    together = [config.data] if len(config.data) > 1 else []
    for paths in [*((path,) for path in config.data), *together]:
        for done, count in enumerate(config.windows):
            rows.append(_row(paths, count, config))
            if progress is not None:
                progress(" + ".join(paths), done + 1, len(config.windows))
    return table(_HEADER, rows)


_HEADER = (
    "| drive | windows | rotation [deg]: spread / claimed | translation [cm] | time offset [ms] "
    "| spread in claimed sigmas: rotation, translation, offset "
    "| error, RMS: QAD [deg], ATD [cm], offset [ms] | status |"
)


def _row(paths: Sequence[str], count: int, config: WindowsConfig) -> list[str]:
    """Drives cut into ``count`` windows each; those of the same number go into one graph."""
    wholes = [open_source(path, image_shift=config.shift) for path in paths]
    edges = [np.linspace(0, len(whole), count + 1).round().astype(int) for whole in wholes]
    results, errors = [], []
    for i in range(count):
        windows = [
            open_source(path, image_shift=config.shift, frames=f"{edge[i]}:{edge[i + 1]}")
            for path, edge in zip(paths, edges, strict=True)
        ]
        result = calibrate(windows, windows[0].nominal, config.calibration)
        results.append(result)
        truth = windows[0].truth
        if truth is not None and result.status != "not_converged":
            errors.append(calibration_errors(result.T_camera_lidar, result.time_offset_s, truth))
    names = " + ".join(whole.name for whole in wholes)
    states = ", ".join(result.status for result in results)
    return [names, str(count), *spread_cells(results), error_cell(errors), states]


def error_cell(errors: Sequence[CalibrationErrors]) -> str:
    """Root of the mean square over windows of QAD [deg], ATD [cm] and the offset's error [ms]."""
    if not errors:
        return "–"
    values = [[error.qad_deg, 100.0 * error.atd_m] for error in errors]
    offsets = [1e3 * error.time_offset_s for error in errors if error.time_offset_s is not None]
    roots = [*np.sqrt(np.mean(np.square(values), axis=0)), np.sqrt(np.mean(np.square(offsets or [np.nan])))]
    return ", ".join("–" if np.isnan(root) else f"{root:.2f}" for root in roots)


def spread_cells(results: Sequence[CalibrationResult]) -> list[str]:
    """Spread over claim of rotation, translation and offset, and the three in sigmas; doubted results, which
    claim nothing, are left out."""
    claimed = [result for result in results if result.status != "not_converged"]
    if len(claimed) < 2:
        return ["–"] * (len(PARTS) + 1)
    deviations, covariances = deviations_of(claimed)
    cells = []
    for part, unit in zip(PARTS, (np.degrees(1.0), 100.0, 1e3), strict=True):
        width = part.stop - part.start
        spread = np.sqrt((deviations[:, part] ** 2).sum() / (width * (len(claimed) - 1)))
        sigma = np.sqrt(np.mean([np.trace(C[part, part]) / width for C in covariances]))
        cells.append(f"{unit * spread:.2f} / {unit * sigma:.2f}")
    return [*cells, ", ".join(f"{ratio:.2f}" for ratio in spread_in_sigmas(deviations, covariances))]


def deviations_of(results: Sequence[CalibrationResult]) -> tuple[FloatArray, list[FloatArray]]:
    """(n, 7) deviations of results from their mean weighted by information, and their covariances."""
    first = results[0].calibration
    steps = np.array([first.local_coordinates(result.calibration) for result in results])
    covariances = [np.asarray(result.covariance, np.float64) for result in results]
    information = [np.linalg.inv(C) for C in covariances]
    weighted = np.sum([H @ step for H, step in zip(information, steps, strict=True)], axis=0)
    return steps - np.linalg.solve(np.sum(information, axis=0), weighted), covariances


def spread_in_sigmas(deviations: FloatArray, covariances: Sequence[FloatArray]) -> list[float]:
    """Spread of rotation, translation and time offset over what is claimed; 1 where the claims hold."""
    ratios = []
    for part in PARTS:
        squares = [
            float(d[part] @ np.linalg.solve(C[part, part], d[part]))
            for d, C in zip(deviations, covariances, strict=True)
        ]
        freedom = (part.stop - part.start) * (len(deviations) - 1)
        ratios.append(float(np.sqrt(np.sum(squares) / freedom)))
    return ratios
