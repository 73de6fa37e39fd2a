"""What became of one drive: the record that a batch keeps of it, and its row in the summary."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import gtsam
import numpy as np

from sst_graph.errors import DataError, printable
from sst_graph.export import common_errors
from sst_graph.files.json_table import json_table
from sst_graph.files.reading import parse_json
from sst_graph.files.strict_json import strict_json
from sst_graph.inspect.reasons import first_reason
from sst_graph.marginal import SCAN_HASHES, CalibrationMarginal, Common, hashes_in, inverse, steps_in
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

FORMAT = "sst-graph/batch-record"
VERSION = 2
RECORD = "a record of a batch"

Status = Literal[
    "ok",
    "unobservable",
    "not_converged",
    "bad_input",
    "crash",
    "killed",
    "memory_limit",
    "time_limit",
    "storage",
    "not_run",
]
"""The result's own status, or why there is none: the command refused the data (``bad_input``), its process
ended by itself (``crash``), by others (``killed``) or at a limit, the data could not be copied or the result
not be written (``storage``), the batch ended before (``not_run``)."""
WITH_RESULT = ("ok", "unobservable", "not_converged")

ATTENTION = (
    "crash",
    "memory_limit",
    "time_limit",
    "storage",
    "bad_input",
    "killed",
    "not_run",
    "not_converged",
)
"""Status by how much it needs to be looked at, most first; then come unobservable and ok."""


@dataclass(frozen=True)
class Cost:
    """What the attempts at a drive took.

    Attributes:
        attempts: how many there were.
        wall_s, cpu_s: of the last one [s].
        peak_bytes: of memory, of the last one.
        input_bytes: size of the drive's files.
    """

    attempts: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_bytes: int = 0
    input_bytes: int = 0


@dataclass(frozen=True)
class Numbers:
    """The numbers of a result, as plain lists; conventions of calibration.json.

    Attributes:
        T_camera_lidar: 4 rows of 4.
        time_offset_s: [s].
        covariance: 7 rows of 7.
        common_errors: 7 numbers for each assumption, by name: what one deviation of it shifts the result by.
        frames: how many took part.
        camera: name of the camera.
        scan_hashes: of some of its scans.
    """

    T_camera_lidar: list[list[float]]
    time_offset_s: float
    covariance: list[list[float]]
    common_errors: dict[str, list[float]]
    frames: int
    camera: str
    scan_hashes: tuple[str, ...] = ()

    @staticmethod
    def of(result: CalibrationResult) -> Numbers:
        """Of a result."""
        return Numbers(
            result.T_camera_lidar.matrix().tolist(),
            result.time_offset_s,
            result.covariance.tolist(),
            {name: step.tolist() for name, step in common_errors(result).items()},
            len(result.frames_used),
            result.camera_name,
            tuple(result.diagnostics.get(SCAN_HASHES, ())),
        )

    @property
    def sigmas(self) -> FloatArray:
        """(7,) standard deviations [rad, m, s]."""
        return np.asarray(np.sqrt(np.diag(np.array(self.covariance))))

    def marginal(self) -> CalibrationMarginal:
        """As :func:`sst_graph.export.marginal_of_result` of the result.

        Raises:
            EstimationError: the covariance has no inverse.
        """
        information = inverse(np.array(self.covariance), "covariance of the result")
        cTl = gtsam.Pose3(np.array(self.T_camera_lidar))
        errors = {name: np.array(step) for name, step in self.common_errors.items()}
        common = Common(errors, self.scan_hashes)
        return CalibrationMarginal(cTl, self.time_offset_s, information, np.zeros(7), common=common)


@dataclass(frozen=True)
class Record:
    """What became of one drive.

    Attributes:
        drive: its name; place: where its data stand.
        status: of the result, or why there is none.
        reason: one line; empty where all is well.
        cost: what it took.
        numbers: of the result, or None.
        log: last lines of what a failed attempt wrote on stderr.
        files: fingerprint of the drive's files that the result is of; empty where it is not known.
    """

    drive: str
    place: str
    status: Status
    reason: str = ""
    cost: Cost = Cost()
    numbers: Numbers | None = None
    log: tuple[str, ...] = ()
    files: str = ""

    @property
    def has_result(self) -> bool:
        """Whether the drive's folder holds a result."""
        return self.status in WITH_RESULT

    @property
    def attention(self) -> int:
        """Rank by how much it needs to be looked at, 0 first."""
        order = (*ATTENTION, "unobservable", "ok")
        return order.index(self.status)

    def to_json(self) -> str:
        """The text of its file."""
        return strict_json({"format": FORMAT, "version": VERSION, **asdict(self)}) + "\n"

    @staticmethod
    def from_json(data: bytes, place: str | Path) -> Record:
        """The record in such a text.

        Raises:
            DataError: no such text.
        """
        table = json_table(json_of(data, place, RECORD), place, FORMAT, VERSION)
        status, cost = table.text("status"), table.table("cost")
        if status not in get_args(Status):
            raise DataError(place, f"status {status!r:.40}", f"one of {', '.join(get_args(Status))}")
        numbers = None
        if table.value("numbers", None) is not None:
            read = table.table("numbers")
            numbers = Numbers(
                read.pose("T_camera_lidar").matrix().tolist(),
                read.time_offset_s("time_offset_s"),
                read.covariance("covariance", 7).tolist(),
                {name: step.tolist() for name, step in steps_in(read).items()},
                read.integer("frames"),
                read.text("camera"),
                hashes_in(read),
            )
        spent = Cost(
            cost.integer("attempts"),
            cost.number("wall_s"),
            cost.number("cpu_s"),
            cost.integer("peak_bytes"),
            cost.integer("input_bytes"),
        )
        return Record(
            table.text("drive"),
            table.text("place"),
            status,  # type: ignore[arg-type]
            table.sentence("reason"),
            spent,
            numbers,
            table.sentences("log"),
            table.text("files", ""),
        )


def reason_of(result: CalibrationResult) -> str:
    """The first reason of a result that is not ok, in short."""
    if result.status == "ok":
        return ""
    return printable(first_reason(result, "its report"), 1000)


def json_of(data: bytes, place: str | Path, kind: str) -> Any:
    """The JSON in the bytes of a file of a kind.

    Raises:
        DataError: no UTF-8, or no JSON.
    """
    try:
        return parse_json(data.decode("utf-8"), place, kind)
    except UnicodeDecodeError:
        raise DataError(place, "bytes that are no UTF-8", kind) from None
