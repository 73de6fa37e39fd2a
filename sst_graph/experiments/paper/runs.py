"""One run: a method from a start on a drive, and its errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.config import to_dict
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.experiments.paper.config import START, VARIANTS, PaperTableConfig
from sst_graph.experiments.paper.drives import TableDrive
from sst_graph.experiments.starts import start_near, truth_of
from sst_graph.experiments.tasks.resumable import digest
from sst_graph.metrics import calibration_errors
from sst_graph.odometry.sweep import with_sweep
from sst_graph.types import GroundTruth, Source


@dataclass(frozen=True)
class Case:
    """What is to be run.

    Attributes:
        drive: on which.
        images_late: frames by which its images are late.
        start: number of the start.
        method: row of the table, or START.
    """

    drive: TableDrive
    images_late: int
    start: int
    method: str

    def __str__(self) -> str:
        return self.drive.name

    def key(self, config: PaperTableConfig) -> str:
        """Digest of all that its result depends on beside the code: settings of drive, start and method."""
        if self.drive.street is None:
            data: Any = [str(Path(self.drive.path).resolve()), self.drive.sequence, self.drive.frames]
        else:
            data = to_dict(config.street(self.drive.street, self.images_late))
        start = [self.drive.seed, self.start, config.start_deg, config.start_m]
        how = None if self.method == START else to_dict(config.calibration_of(self.method))
        parts = {"data": data, "images_late": self.images_late, "start": start, "method": how}
        return digest(parts)


@dataclass(frozen=True)
class CaseRun:
    """What came of a case.

    Attributes:
        drive, images_late, start, method: the case.
        qad_deg, aead_deg, atd_m: errors of the pose.
        time_offset_s: estimated, or None where the method has none [s].
        true_offset_s: by the stamps, or None where it is not known [s].
        status: of the result; empty of a start.
        estimated: whether the method found anything; else the result is its start.
    """

    drive: str
    images_late: int
    start: int
    method: str
    qad_deg: float
    aead_deg: float
    atd_m: float
    time_offset_s: float | None
    true_offset_s: float | None
    status: str
    estimated: bool

    def failed(self, config: PaperTableConfig) -> bool:
        """Whether it has failed by the limits of the table."""
        return not self.estimated or self.qad_deg > config.failed_deg or self.atd_m > config.failed_m

    @property
    def true_error_ms(self) -> float | None:
        """Estimated time offset less that of the stamps [ms]."""
        if self.time_offset_s is None or self.true_offset_s is None or not self.estimated:
            return None
        return 1e3 * (self.time_offset_s - self.true_offset_s)

    def nominal_error_ms(self, config: PaperTableConfig) -> float | None:
        """Estimated time offset less that of the data sheet's rate [ms]."""
        if self.time_offset_s is None or not self.estimated:
            return None
        return 1e3 * (self.time_offset_s - config.nominal_offset_s(self.images_late))


def cases_of(drives: Sequence[TableDrive], config: PaperTableConfig) -> list[list[Case]]:
    """All cases of a table; those that share a prepared drive are together."""
    return [
        [Case(drive, late, k, m) for k in range(config.starts) for m in (START, *config.methods)]
        for late in config.images_late
        for drive in drives
    ]


def runs_of(cases: Sequence[Case], config: PaperTableConfig) -> Iterator[list[CaseRun]]:
    """The run of each of the cases of one drive, which is read once, for the first method that needs it.

    Raises:
        ConfigError, DataError: the drive cannot be used.
    """
    source = cases[0].drive.open(config, cases[0].images_late)
    truth = truth_of(source)
    prepared: list[Drive] = []
    for case in cases:
        start = start_of(case, config, truth.cTl)
        if case.method == START:
            yield [_run(case, start, None, truth)]
            continue
        prepared = prepared or [prepared_drive(source, config.calibration)]
        result = calibrate_prepared(prepared, start, config.calibration_of(case.method))
        offset_s = result.time_offset_s if VARIANTS[case.method].has_time_offset else None
        run = _run(case, result.T_camera_lidar, offset_s, truth)
        yield [dataclasses.replace(run, status=result.status, estimated=bool(result.frames_used))]


def prepared_drive(source: Source, calibration: CalibrationConfig) -> Drive:
    """What every method needs of a drive, so that all have the same."""
    swept = with_sweep(source, calibration.decide_sweep)
    return prepare_drive(swept, calibration.classes, calibration.prepare)


def start_of(case: Case, config: PaperTableConfig, cTl: gtsam.Pose3) -> gtsam.Pose3:
    """The start of a case, the same for every method and delay."""
    rng = np.random.default_rng([case.drive.seed, 7, case.start])
    return start_near(cTl, config.start_deg, config.start_m, rng)


def _run(case: Case, cTl: gtsam.Pose3, offset_s: float | None, truth: GroundTruth) -> CaseRun:
    errors = calibration_errors(cTl, offset_s or 0.0, truth)
    return CaseRun(
        case.drive.name,
        case.images_late,
        case.start,
        case.method,
        errors.qad_deg,
        errors.aead_deg,
        errors.atd_m,
        offset_s,
        truth.time_offset_s,
        "",
        True,
    )
