"""The result of a calibration and its file, ``calibration.json``.

The file's contract: ``{"format": "sst-graph/calibration", "version": 1, "T_camera_lidar": 4x4,
"time_offset_s", "covariance": 7x7, "status", "reasons", "weak_directions", "camera", "frames_used",
"drive_offsets", "config", "method", "initial", "read_as", "diagnostics", "versions"}``; strict JSON, no NaN.
The same data and settings give the same bytes: what a clock on the wall showed is left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

import gtsam
import numpy as np

from sst_graph.errors import DataError, in_file
from sst_graph.factors.arguments import (
    as_numbers,
    checked_gtsam,
    checked_number,
    checked_several,
    checked_type,
    described,
)
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import (
    check_covariance,
    check_finite,
    checked_text,
    pinhole_camera,
    read_only,
)
from sst_graph.files.json_table import JsonTable, json_table
from sst_graph.files.reading import CALIBRATION, parse_json, path_of, read_text
from sst_graph.files.strict_json import strict_json
from sst_graph.fit import Fit
from sst_graph.types import ByValue, Calibration, FloatArray

Status = Literal["ok", "unobservable", "not_converged"]

CALIBRATION_NAME, RIG_NAME = "calibration.json", "rig.json"
"""File of one camera, and that of several together, beside a folder for each."""

UNNAMED_CAMERA = "camera"
"""Name of a camera whose name in the data is not known."""

FORMAT = "sst-graph/calibration"
VERSION = 1

WALL_CLOCK = "seconds"
"""Entry of the diagnostics: how long each stage took [s]; it is not written."""

LIKELY_CAUSES = "likely_causes"
"""Entry of the diagnostics: the reasons that name a likely fault of the data. Most others follow from it."""

DIRECTION_SCALES: FloatArray = np.array([np.radians(0.1)] * 3 + [0.01] * 3 + [0.001])
"""(7,) one scaled unit of a weak direction: 0.1 deg [rad], 1 cm [m], 1 ms [s]."""


@dataclass(frozen=True, eq=False)
class WeakDirection(ByValue):
    """A combination of the unknowns that the data hardly determine.

    Attributes:
        vector: (7,) unit vector in scaled units (:data:`DIRECTION_SCALES`), order of the covariance; where
            drives have a time offset each, the last is that of the drive which the sentence begins with.
        sigma: standard deviation along it, in scaled units; large but finite.
        sentence: what is not observable, in words and numbers.
        advice: what to record to determine it.
    """

    vector: FloatArray
    sigma: float
    sentence: str
    advice: str

    @property
    def reason(self) -> str:
        """Sentence and advice."""
        return f"{self.sentence}: {self.advice}"


@dataclass(frozen=True)
class FrameId:
    """A frame that took part: the drive's name and the frame's index in it."""

    drive: str
    frame: int


@dataclass(frozen=True)
class DriveOffset:
    """Time offset of one drive and its standard deviation [s]."""

    drive: str
    time_offset_s: float
    sigma_s: float


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations in human units, xyz where there are three."""

    rotation_deg: tuple[float, float, float]
    translation_cm: tuple[float, float, float]
    time_offset_ms: float


_SEVERAL = {
    "reasons": str,
    "weak_directions": WeakDirection,
    "frames_used": FrameId,
    "drive_offsets": DriveOffset,
}
"""Fields of a result that hold several, and of what type."""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """An estimated extrinsic and time offset, and how far to trust them. Signs: :mod:`factors`.

    Two results are equal if :meth:`to_json` writes the same of them.

    Attributes:
        T_camera_lidar: p_camera = T_camera_lidar . p_lidar.
        time_offset_s: t_lidar = t_camera_stamp + time_offset_s [s].
        covariance: (7, 7) [rot xyz rad, trans xyz m, offset s], right perturbation; finite, also where
            a direction is unobservable (its sigma is then large).
        status: ``ok``, or why the numbers are not to be trusted.
        camera: the camera that T_camera_lidar belongs to.
        camera_name: its name in the data, such as ``image_2``.
        reasons: one sentence for each cause of a status that is not ``ok``.
        weak_directions: what the data hardly determine, weakest first.
        frames_used: the frames that took part.
        drive_offsets: an offset for each drive, with ``time_offset_per_drive``.
        method: name of the method.
        config: its settings, as a JSON-able dictionary.
        initial: where the estimation started, or None without a guess.
        initial_time_offset_s: time offset at the start [s].
        read_as: how the drives were read, by option: what pairs of scans and images the result holds for.
        diagnostics: JSON-able numbers about the run.
        versions: of the packages that took part.
        fit: how the result fits its data, point by point; in memory only, and None of a result from a file.
        edges_fit: the same of edges in frames without labels, where ``fit`` is of the labels in the others.
    """

    T_camera_lidar: gtsam.Pose3
    time_offset_s: float
    covariance: FloatArray
    status: Status
    camera: PinholeCamera
    camera_name: str = UNNAMED_CAMERA
    reasons: tuple[str, ...] = ()
    weak_directions: tuple[WeakDirection, ...] = ()
    frames_used: tuple[FrameId, ...] = ()
    drive_offsets: tuple[DriveOffset, ...] = ()
    method: str = "joint"
    config: Mapping[str, Any] = field(default_factory=dict)
    initial: gtsam.Pose3 | None = None
    initial_time_offset_s: float = 0.0
    read_as: Mapping[str, Any] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    fit: Fit | None = field(default=None, repr=False)
    edges_fit: Fit | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_status(self.status)
        checked_gtsam("T_camera_lidar", self.T_camera_lidar, gtsam.Pose3)
        checked_type("camera", self.camera, PinholeCamera, "a PinholeCamera")
        checked_type("camera_name", self.camera_name, str, "a text")
        checked_type("method", self.method, str, "the name of a method")
        if self.initial is not None:
            checked_gtsam("initial", self.initial, gtsam.Pose3)
        checked_number("initial_time_offset_s", self.initial_time_offset_s)
        for name in ("fit", "edges_fit"):
            checked_type(name, getattr(self, name), (Fit, type(None)), "a Fit, or None")
        for name, kind in _SEVERAL.items():
            one, several = f"a {kind.__name__}", f"a tuple of {kind.__name__}"
            checked_several(name, getattr(self, name), kind, one, several)
        for name in ("config", "read_as", "diagnostics", "versions"):
            checked_type(name, getattr(self, name), Mapping, "a dict")
        check_finite("time_offset_s", as_numbers("time_offset_s", self.time_offset_s), ())
        check_finite("covariance", self.covariance, (7, 7))
        check_covariance("covariance", self.covariance, min_sigma=0.0)
        object.__setattr__(self, "covariance", read_only(self.covariance))
        for weak in self.weak_directions:
            check_finite("weak_directions.vector", np.asarray(weak.vector), (7,))
            check_finite("weak_directions.sigma", np.asarray(weak.sigma), ())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CalibrationResult):
            return NotImplemented
        return self.to_json() == other.to_json()

    def __hash__(self) -> int:
        return hash(self.to_json())

    @property
    def calibration(self) -> Calibration:
        """``T_camera_lidar`` and ``time_offset_s`` as one."""
        return Calibration(self.T_camera_lidar, self.time_offset_s)

    def time_offset_of(self, drive: str) -> float:
        """Time offset of a drive: its own where the result has one for each, else that of all [s]."""
        own = {one.drive: one.time_offset_s for one in self.drive_offsets}
        return own.get(drive, self.time_offset_s)

    @property
    def image_topic(self) -> str:
        """Topic of the images in a bag; empty where they came from elsewhere."""
        topic = self.read_as.get("image_topic")
        return topic if isinstance(topic, str) else ""

    @property
    def lens(self) -> str:
        """Model of the lens from whose pictures the images were rectified; empty where none was."""
        lens = self.read_as.get("lens")
        return lens if isinstance(lens, str) else ""

    @property
    def fits(self) -> tuple[Fit, ...]:
        """``fit`` and ``edges_fit``, those that are there."""
        return tuple(fit for fit in (self.fit, self.edges_fit) if fit is not None)

    @property
    def fit_is_check(self) -> bool:
        """Whether the fit is that of data which the estimate has not used."""
        return self.method == "motion"

    def sigmas(self) -> Sigmas:
        """Standard deviations of the seven unknowns, in degrees, centimetres and milliseconds."""
        sigma = np.sqrt(np.diag(self.covariance))
        rx, ry, rz = np.degrees(sigma[:3]).tolist()
        x, y, z = (100.0 * sigma[3:6]).tolist()
        return Sigmas((rx, ry, rz), (x, y, z), 1e3 * float(sigma[6]))

    def to_json(self) -> str:
        """The text of ``calibration.json``; what is not finite in the diagnostics becomes null.

        Text that is not Unicode (a lone surrogate) is escaped, so that the file is UTF-8.
        """
        diagnostics = {name: value for name, value in self.diagnostics.items() if name != WALL_CLOCK}
        document = {
            "format": FORMAT,
            "version": VERSION,
            "T_camera_lidar": self.T_camera_lidar.matrix(),
            "time_offset_s": self.time_offset_s,
            "covariance": self.covariance,
            "status": self.status,
            "reasons": self.reasons,
            "weak_directions": [dataclasses.asdict(weak) for weak in self.weak_directions],
            "camera": {"name": self.camera_name, **dataclasses.asdict(self.camera)},
            "frames_used": [dataclasses.asdict(frame) for frame in self.frames_used],
            "drive_offsets": [dataclasses.asdict(offset) for offset in self.drive_offsets],
            "method": self.method,
            "config": self.config,
            "initial": self._initial_document(),
            "read_as": self.read_as,
            "diagnostics": diagnostics,
            "versions": self.versions,
        }
        return strict_json(document) + "\n"

    def _initial_document(self) -> dict[str, Any] | None:
        if self.initial is None:
            return None
        return {"T_camera_lidar": self.initial.matrix(), "time_offset_s": self.initial_time_offset_s}

    @staticmethod
    def from_json(text: str, place: str | Path = "calibration.json") -> CalibrationResult:
        """The result in the text of a ``calibration.json``.

        Raises:
            DataError: naming ``place``, what was found and what was expected.
        """
        reader = json_table(parse_json(text, place, CALIBRATION.name), place, FORMAT, VERSION)
        camera = reader.table("camera")
        initial = None if reader.value("initial", None) is None else reader.table("initial")
        with in_file(place):
            return CalibrationResult(
                T_camera_lidar=reader.pose("T_camera_lidar"),
                time_offset_s=reader.time_offset_s("time_offset_s"),
                covariance=reader.covariance("covariance", 7),
                status=cast(Status, reader.text("status")),
                camera=_camera(camera),
                camera_name=camera.text("name"),
                reasons=reader.sentences("reasons"),
                weak_directions=tuple(map(_weak_direction, reader.tables("weak_directions"))),
                frames_used=tuple(
                    FrameId(frame.text("drive"), frame.integer("frame"))
                    for frame in reader.tables("frames_used")
                ),
                drive_offsets=tuple(
                    DriveOffset(
                        drive.text("drive"), drive.time_offset_s("time_offset_s"), drive.number("sigma_s")
                    )
                    for drive in reader.tables("drive_offsets")
                ),
                method=reader.text("method", "joint"),
                config=reader.mapping("config"),
                initial=None if initial is None else initial.pose("T_camera_lidar"),
                initial_time_offset_s=0.0 if initial is None else initial.time_offset_s("time_offset_s"),
                read_as=reader.mapping("read_as"),
                diagnostics=reader.mapping("diagnostics"),
                versions=_versions(reader),
            )


def read_result(path: str | Path) -> CalibrationResult:
    """The result in a folder that ``sst-graph calibrate`` wrote, or in its ``calibration.json``.

    Raises:
        DataError: the file is missing, unreadable or not such a file.
    """
    file = file_of_one_camera(path_of(path, "a calibration.json"))
    return CalibrationResult.from_json(read_text(file, CALIBRATION), file)


def result_file(path: Path) -> Path:
    """The ``calibration.json`` that a file or the folder that holds one stands for."""
    return path / CALIBRATION_NAME if path.is_dir() else path


def file_of_one_camera(path: Path) -> Path:
    """As :func:`result_file`; of several cameras there is a result each.

    Raises:
        DataError: the path is that of all of them together.
    """
    file = result_file(path)
    if path.name == RIG_NAME or (not file.exists() and (path / RIG_NAME).is_file()):
        folder = path if path.is_dir() else path.parent
        of_one = ", ".join(sorted(str(one.parent) for one in folder.glob(f"*/{CALIBRATION_NAME}")))
        raise DataError(path, "a rig of several cameras", f"the result of one: {of_one}")
    return file


def check_status(status: object) -> None:
    """Refuse what is no :data:`Status`.

    Raises:
        DataError: it is none.
    """
    if not (isinstance(status, str) and status in get_args(Status)):
        found = f"{status!r:.60}" if isinstance(status, str) else described(status)
        raise DataError("status", found, "one of " + ", ".join(get_args(Status)))


def _camera(table: JsonTable) -> PinholeCamera:
    fx, fy, cx, cy = (table.number(key) for key in ("fx", "fy", "cx", "cy"))
    return pinhole_camera((fx, fy, cx, cy), (table.integer("width"), table.integer("height")), table.place)


def _weak_direction(table: JsonTable) -> WeakDirection:
    return WeakDirection(
        table.matrix("vector", (7,)),
        table.number("sigma"),
        table.sentence("sentence"),
        table.sentence("advice"),
    )


def _versions(table: JsonTable) -> dict[str, str]:
    found = JsonTable(table.mapping("versions"), f"{table.place}: versions")
    return {checked_text(name, found.place): found.text(name) for name in found.data}
