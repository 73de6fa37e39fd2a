"""The result of a calibration and its file, ``calibration.json``.

The file's contract: ``{"format": "sst-graph/calibration", "version": 1, "T_camera_lidar": 4x4,
"time_offset_s", "covariance": 7x7, "status", "reasons", "weak_directions", "camera", "frames_used",
"drive_offsets", "config", "method", "initial", "diagnostics", "versions"}``; strict JSON, no NaN.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.errors import DataError

FloatArray = NDArray[np.float64]
Status = Literal["ok", "unobservable", "not_converged"]

UNNAMED_CAMERA = "camera"
"""Name of a camera whose name in the data is not known."""

FORMAT = "sst-graph/calibration"
VERSION = 1

DIRECTION_SCALES: FloatArray = np.array([np.radians(0.1)] * 3 + [0.01] * 3 + [0.001])
"""(7,) one scaled unit of a weak direction: 0.1 deg [rad], 1 cm [m], 1 ms [s]."""


@dataclass(frozen=True)
class WeakDirection:
    """A combination of the unknowns that the data hardly tells.

    Attributes:
        vector: (7,) unit vector in scaled units (:data:`DIRECTION_SCALES`), order of the covariance; where
            drives have a time offset each, the last is that of the drive which the sentence begins with.
        sigma: standard deviation along it, in scaled units; large but finite.
        sentence: what cannot be told, in words and numbers.
        advice: what to record to tell it.
    """

    vector: FloatArray
    sigma: float
    sentence: str
    advice: str


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


@dataclass(frozen=True)
class CalibrationResult:
    """An estimated extrinsic and time offset, and how far to trust them. Signs: :mod:`factors`.

    Attributes:
        T_camera_lidar: p_camera = T_camera_lidar . p_lidar.
        time_offset_s: t_lidar = t_camera_stamp + time_offset_s [s].
        covariance: (7, 7) [rot xyz rad, trans xyz m, offset s], right perturbation; finite, also where
            a direction is unobservable (its sigma is then large).
        status: ``ok``, or why the numbers are not to be trusted.
        camera: the camera that T_camera_lidar belongs to.
        camera_name: its name in the data, such as ``image_2``.
        reasons: one sentence for each cause of a status that is not ``ok``.
        weak_directions: what the data hardly tells, weakest first.
        frames_used: the frames that took part.
        drive_offsets: an offset for each drive, where one each was asked for.
        method: name of the method.
        config: its settings, as a JSON-able dictionary.
        initial: where the estimation started, or None without a guess.
        initial_offset_s: time offset at the start [s].
        diagnostics: JSON-able numbers about the run.
        versions: of the packages that took part.
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
    initial_offset_s: float = 0.0
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_status(self.status)
        _check_finite("T_camera_lidar", self.T_camera_lidar.matrix(), (4, 4))
        _check_finite("time_offset_s", np.asarray(self.time_offset_s), ())
        _check_covariance(self.covariance)
        for weak in self.weak_directions:
            _check_finite("weak_directions.vector", np.asarray(weak.vector), (7,))
            _check_finite("weak_directions.sigma", np.asarray(weak.sigma), ())

    def sigmas(self) -> Sigmas:
        """Standard deviations of the seven unknowns, in degrees, centimetres and milliseconds."""
        sigma = np.sqrt(np.diag(self.covariance))
        rx, ry, rz = np.degrees(sigma[:3]).tolist()
        x, y, z = (100.0 * sigma[3:6]).tolist()
        return Sigmas((rx, ry, rz), (x, y, z), 1e3 * float(sigma[6]))

    def to_json(self) -> str:
        """The text of ``calibration.json``; what is not finite in the diagnostics becomes null."""
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
            "diagnostics": self.diagnostics,
            "versions": self.versions,
        }
        return _dump(json_able(document)) + "\n"

    def _initial_document(self) -> dict[str, Any] | None:
        if self.initial is None:
            return None
        return {"T_camera_lidar": self.initial.matrix(), "time_offset_s": self.initial_offset_s}

    @staticmethod
    def from_json(text: str, place: str | Path = "calibration.json") -> CalibrationResult:
        """The result in the text of a ``calibration.json``.

        Raises:
            DataError: naming ``place``, what was found and what was expected.
        """
        reader = _Reader(_document(text, place), str(place))
        camera = reader.table("camera")
        initial = None if reader.value("initial", None) is None else reader.table("initial")
        try:
            return CalibrationResult(
                T_camera_lidar=reader.pose("T_camera_lidar"),
                time_offset_s=reader.number("time_offset_s"),
                covariance=reader.matrix("covariance", (7, 7)),
                status=cast(Status, reader.text("status")),
                camera=camera.camera(),
                camera_name=camera.text("name"),
                reasons=tuple(str(reason) for reason in reader.sequence("reasons")),
                weak_directions=tuple(weak.weak_direction() for weak in reader.tables("weak_directions")),
                frames_used=tuple(
                    FrameId(frame.text("drive"), frame.integer("frame"))
                    for frame in reader.tables("frames_used")
                ),
                drive_offsets=tuple(
                    DriveOffset(drive.text("drive"), drive.number("time_offset_s"), drive.number("sigma_s"))
                    for drive in reader.tables("drive_offsets")
                ),
                method=reader.text("method", "joint"),
                config=reader.mapping("config"),
                initial=None if initial is None else initial.pose("T_camera_lidar"),
                initial_offset_s=0.0 if initial is None else initial.number("time_offset_s"),
                diagnostics=reader.mapping("diagnostics"),
                versions=reader.mapping("versions"),
            )
        except DataError as error:
            if error.place.startswith(str(place)):
                raise
            raise DataError(f"{place}: {error.place}", error.found, error.expected) from error


def json_able(value: Any) -> Any:
    """``value`` with arrays and tuples as lists, enums as names, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): json_able(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return json_able(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_able(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, np.generic):
        return json_able(value.item())
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return json_able({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_result(path: Path) -> CalibrationResult:
    """The result in a ``calibration.json``.

    Raises:
        DataError: the file is missing, unreadable or not such a file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(path, "no such file", "a calibration.json") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, str(error), "a readable calibration.json") from error
    return CalibrationResult.from_json(text, path)


def checked_pose(matrix: FloatArray, place: str) -> gtsam.Pose3:
    """The pose of a (4, 4) homogeneous matrix; a rotation off by rounding is made orthonormal.

    Raises:
        DataError: not finite, a last row other than 0 0 0 1, or a rotation that is none (1e-3).
    """
    _check_finite(place, matrix, (4, 4))
    R = matrix[:3, :3]
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise DataError(place, f"last row {matrix[3].tolist()}", "0 0 0 1")
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(R) < 0.0:
        found = f"a 3x3 block with |R R' - I| = {off:.2g}, det {np.linalg.det(R):.3g}"
        raise DataError(place, found, "a rotation matrix")
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(R) if off > 1e-12 else gtsam.Rot3(R), matrix[:3, 3])


def _check_status(status: str) -> None:
    if status not in get_args(Status):
        raise DataError("status", repr(status), "one of " + ", ".join(get_args(Status)))


def _check_finite(place: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise DataError(place, f"shape {array.shape}", f"shape {shape}")
    if not np.isfinite(array).all():
        raise DataError(place, "a value that is not finite", "finite numbers")


def _check_covariance(covariance: FloatArray) -> None:
    _check_finite("covariance", covariance, (7, 7))
    variances = np.diag(covariance)
    if (variances < 0.0).any():
        raise DataError("covariance", f"a variance of {variances.min():.3g}", "variances of at least 0")
    scale = np.sqrt(np.outer(variances, variances)) + np.finfo(float).tiny
    if (np.abs(covariance - covariance.T) > 1e-6 * scale).any():
        raise DataError("covariance", "a matrix that is not symmetric", "a covariance")


def _dump(document: dict[str, Any]) -> str:
    """Strict JSON, one key a line, matrices one row a line."""
    entries = []
    for key, value in document.items():
        rows = isinstance(value, list) and value and isinstance(value[0], (list, dict))
        if rows:
            body = ",\n".join("    " + json.dumps(row, allow_nan=False, ensure_ascii=False) for row in value)
            entries.append(f"  {json.dumps(key)}: [\n{body}\n  ]")
        else:
            entries.append(f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False, ensure_ascii=False)}")
    return "{\n" + ",\n".join(entries) + "\n}"


def _document(text: str, place: str | Path) -> dict[str, Any]:
    """The JSON object in ``text``, of the right format and version."""
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:
        raise DataError(place, f"no JSON ({error})", "a calibration.json") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = document.get("format") if isinstance(document, dict) else type(document).__name__
        raise DataError(place, f"format {found!r}", f"format '{FORMAT}'")
    if document.get("version") != VERSION:
        raise DataError(place, f"version {document.get('version')!r}", f"version {VERSION}")
    return document


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


_REQUIRED: Any = object()


@dataclass(frozen=True)
class _Reader:
    """Typed access to a JSON object; every complaint names its place."""

    data: Mapping[str, Any]
    place: str

    def value(self, key: str, default: Any = _REQUIRED) -> Any:
        if key not in self.data and default is _REQUIRED:
            raise DataError(self.place, f"no '{key}'", f"'{key}'")
        return self.data.get(key, default)

    def _typed(self, key: str, kinds: Any, expected: str, default: Any = _REQUIRED) -> Any:
        value = self.value(key, default)
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise DataError(f"{self.place}: {key}", f"{value!r:.60}", expected)
        return value

    def number(self, key: str) -> float:
        return float(self._typed(key, (int, float), "a number"))

    def integer(self, key: str) -> int:
        return int(self._typed(key, int, "a whole number"))

    def text(self, key: str, default: Any = _REQUIRED) -> str:
        return str(self._typed(key, str, "text", default))

    def sequence(self, key: str) -> list[Any]:
        return list(self._typed(key, list, "a list", []))

    def mapping(self, key: str) -> dict[str, Any]:
        return dict(self._typed(key, dict, "an object", {}))

    def table(self, key: str) -> _Reader:
        return _Reader(self._typed(key, dict, "an object"), f"{self.place}: {key}")

    def tables(self, key: str) -> list[_Reader]:
        items = self.sequence(key)
        for item in items:
            if not isinstance(item, dict):
                raise DataError(f"{self.place}: {key}", f"{item!r:.60}", "objects")
        return [_Reader(item, f"{self.place}: {key}[{i}]") for i, item in enumerate(items)]

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        try:
            array = np.array(self.value(key), dtype=np.float64)
        except (ValueError, TypeError):
            raise DataError(f"{self.place}: {key}", "no numeric array", f"shape {shape}") from None
        _check_finite(f"{self.place}: {key}", array, shape)
        return array

    def pose(self, key: str) -> gtsam.Pose3:
        return checked_pose(self.matrix(key, (4, 4)), f"{self.place}: {key}")

    def camera(self) -> PinholeCamera:
        fx, fy, cx, cy = (self.number(key) for key in ("fx", "fy", "cx", "cy"))
        return PinholeCamera(fx, fy, cx, cy, self.integer("width"), self.integer("height"))

    def weak_direction(self) -> WeakDirection:
        return WeakDirection(
            self.matrix("vector", (7,)), self.number("sigma"), self.text("sentence"), self.text("advice")
        )
