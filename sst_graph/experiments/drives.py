"""Real drives from many wrong starts: do all lead to one result, and how far is it from the reference?"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Settings, setting
from sst_graph.data import open_source
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.drive.twists import camera_twist
from sst_graph.errors import ConfigError
from sst_graph.experiments.markdown import median, table
from sst_graph.experiments.starts import start_near, truth_of
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.result import CalibrationResult
from sst_graph.types import GroundTruth, Source


@dataclass(frozen=True)
class DrivesConfig(Settings):
    """Drives, image shifts and starts.

    Attributes:
        data: folders of drives that bring a reference calibration.
        together: also all drives in one graph.
        shifts: image shifts that are tried.
        starts: starts of every drive and shift.
        seed: of the starts.
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        calibration: settings of the method.
    """

    data: tuple[str, ...] = setting((), length=(0, 1000))
    together: bool = True
    shifts: tuple[int, ...] = setting((0, 1, 2, 3), at_least=-1000, at_most=1000, length=(1, 100))
    starts: int = setting(5, at_least=1, at_most=10_000)
    seed: int = setting(0, at_least=0, at_most=10**15)
    start_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)


def run(config: DrivesConfig, progress: Progress | None = None) -> str:
    """A Markdown table: one row for every drive and shift.

    Raises:
        ConfigError: no data.
        DataError: a drive cannot be used, or brings no reference.
    """
    if not config.data:
        raise ConfigError("data: found none, expected folders, such as --set 'data=[\"DRIVE\"]'")
    rows = []
    for done, shift in enumerate(config.shifts):
        sources = [open_source(path, image_shift=shift) for path in config.data]
        drives = prepare_drives(sources, config.calibration)
        groups = [([source], [drive]) for source, drive in zip(sources, drives, strict=True)]
        if config.together and len(drives) > 1:
            groups.append((sources, drives))
        rows += [_row(some, prepared, shift, config) for some, prepared in groups]
        if progress is not None:
            progress("drives", done + 1, len(config.shifts))
    return table(_HEADER, rows)


_HEADER = (
    "| drive | shift | starts | spread of results [deg] | rotation [deg] | ATD [cm] | time offset error [ms] "
    "| forward - speed x time offset [cm] | status |"
)


def _row(sources: Sequence[Source], drives: Sequence[Drive], shift: int, config: DrivesConfig) -> list[str]:
    """One drive, or several in one graph, from all starts."""
    truth = truth_of(sources[0])
    rng = np.random.default_rng([config.seed, shift])
    results = []
    for _ in range(config.starts):
        start = start_near(truth.cTl, config.start_deg, config.start_m, rng)
        results.append(calibrate_prepared(drives, start, config.calibration))
    errors = [calibration_errors(r.T_camera_lidar, r.time_offset_s, truth) for r in results]
    return [
        " + ".join(source.name for source in sources),
        str(shift),
        str(len(results)),
        f"{_spread_deg(results):.3f}",
        median([e.qad_deg for e in errors], 3),
        median([100.0 * e.atd_m for e in errors], 2),
        median([1e3 * (e.time_offset_s or 0.0) for e in errors], 1),
        median([100.0 * _along(r, e, truth, drives[0]) for r, e in zip(results, errors, strict=True)], 1),
        ", ".join(sorted({result.status for result in results})),
    ]


def _spread_deg(results: Sequence[CalibrationResult]) -> float:
    """Largest angle between two of the results [deg]."""
    angles = [
        np.linalg.norm(gtsam.Rot3.Logmap(a.T_camera_lidar.between(b.T_camera_lidar).rotation()))
        for a, b in itertools.combinations(results, 2)
    ]
    return float(np.degrees(max(angles, default=0.0)))


def _along(result: CalibrationResult, errors: CalibrationErrors, truth: GroundTruth, drive: Drive) -> float:
    """Error of what a steady drive determines along the road: forward - speed x time offset [m]."""
    motion = DriveMotion.of(drive)
    samples = [motion.at(scan.stamp_ns) for scan in drive.scans]
    forward = [camera_twist(sample, truth.cTl).twist[5] for sample in samples if sample is not None]
    speed = float(np.mean(forward)) if forward else 0.0
    shift = result.T_camera_lidar.translation() - truth.cTl.translation()
    return float(shift[2] - speed * (errors.time_offset_s or 0.0))
