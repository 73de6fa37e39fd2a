"""The result of a rig's calibration and its file, ``rig.json``.

The file's contract: ``{"format": "sst-graph/rig", "version": 1, "cameras": [{"name", "folder", "status"}],
"covariance": 7n x 7n, "status", "reasons", "camera_poses", "known", "diagnostics"}``; strict JSON. The
calibration of each camera is the ``calibration.json`` in its folder beside it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.factors.arguments import checked_several, checked_type, described
from sst_graph.files.checked_values import check_covariance, check_finite, read_only
from sst_graph.files.json_table import JsonTable, json_table
from sst_graph.files.reading import FileKind, parse_json, path_of, read_text
from sst_graph.files.strict_json import strict_json
from sst_graph.result import CALIBRATION_NAME, RIG_NAME, CalibrationResult, Status, check_status, read_result
from sst_graph.rig.known import KnownPose, KnownRig
from sst_graph.rig.marginal import RelativePose, RigMarginal
from sst_graph.types import FloatArray

FORMAT = "sst-graph/rig"
VERSION = 1
RIG = FileKind("a rig.json", 16 * 1024 * 1024)

_MOST_CAMERAS = 64
_AGREE = 1e-9
"""Relative difference between a camera's covariance in its own file and in the rig's."""


@dataclass(frozen=True, eq=False)
class RigResult:
    """The calibrations of several cameras on one LiDAR, and how their errors go together.

    Two results are equal if their files are.

    Attributes:
        cameras: the calibration of each camera, by name.
        covariance: (7 n, 7 n), camera by camera in that order, each [rot xyz rad, trans xyz m, offset s] with
            right perturbations; the blocks of single cameras are those of their calibrations.
        status: the worst of the cameras'.
        reasons: what is wrong with the rig as a whole, such as a known pose that contradicts the estimates.
        known: what was known beforehand.
        diagnostics: JSON-able numbers.
    """

    cameras: Mapping[str, CalibrationResult]
    covariance: FloatArray
    status: Status
    reasons: tuple[str, ...] = ()
    known: KnownRig = field(default_factory=KnownRig)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checked_type("cameras", self.cameras, Mapping, "a dict of results by the camera's name")
        for name, camera in self.cameras.items():
            checked_type("name of a camera", name, str, "a text")
            checked_type(f"calibration of {name:.60}", camera, CalibrationResult, "a CalibrationResult")
        checked_type("known", self.known, KnownRig, "a KnownRig")
        checked_several("reasons", self.reasons, str, "a text", "a tuple of texts")
        checked_type("diagnostics", self.diagnostics, Mapping, "a dict")
        n = 7 * len(self.cameras)
        check_status(self.status)
        check_finite("covariance", self.covariance, (n, n))
        check_covariance("covariance", self.covariance, min_sigma=0.0)
        object.__setattr__(self, "covariance", read_only(self.covariance))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RigResult):
            return NotImplemented
        return self.to_json() == other.to_json() and dict(self.cameras) == dict(other.cameras)

    def __hash__(self) -> int:
        return hash(self.to_json())

    def __getitem__(self, name: str) -> CalibrationResult:
        """The calibration of one camera.

        Raises:
            ConfigError: no such camera.
        """
        if not (isinstance(name, str) and name in self.cameras):
            raise ConfigError(f"camera: found {described(name)}, expected one of {', '.join(self.cameras)}")
        return self.cameras[name]

    def marginal(self) -> RigMarginal:
        """All extrinsics and time offsets as one Gaussian: a factor for a graph of your own."""
        results = self.cameras.values()
        return RigMarginal(
            tuple(self.cameras),
            tuple(result.T_camera_lidar for result in results),
            tuple(result.time_offset_s for result in results),
            self.covariance,
        )

    def relative_pose(self, camera: str, reference: str) -> RelativePose:
        """The pose of one camera in another, with its covariance.

        Raises:
            ConfigError: no such camera.
        """
        return self.marginal().relative_pose(camera, reference)

    def to_dict(self) -> dict[str, Any]:
        """What ``rig.json`` holds."""
        folders = folder_names(self.cameras)
        return {
            "format": FORMAT,
            "version": VERSION,
            "cameras": [
                {"name": name, "folder": folders[name], "status": result.status}
                for name, result in self.cameras.items()
            ],
            "covariance": self.covariance,
            "status": self.status,
            "reasons": self.reasons,
            "camera_poses": self.marginal().relative_poses(),
            "known": self.known,
            "diagnostics": self.diagnostics,
        }

    def to_json(self) -> str:
        """The text of ``rig.json``."""
        return strict_json(self.to_dict()) + "\n"

    @staticmethod
    def from_json(
        text: str, cameras: Mapping[str, CalibrationResult], place: str | Path = RIG_NAME
    ) -> RigResult:
        """The result in the text of a ``rig.json``, with its cameras' calibrations.

        Raises:
            DataError: no such text, or calibrations of other cameras.
        """
        table = json_table(parse_json(text, place, RIG.name), place, FORMAT, VERSION)
        names = _names(table)
        if sorted(names) != sorted(cameras):
            raise DataError(place, f"cameras {', '.join(names)}", f"those given: {', '.join(cameras)}")
        covariance = table.covariance("covariance", 7 * len(names))
        for i, name in enumerate(names):
            block = covariance[7 * i : 7 * i + 7, 7 * i : 7 * i + 7]
            own = cameras[name].covariance
            scale = np.sqrt(np.outer(np.diag(own), np.diag(own)))
            if (np.abs(block - own) > _AGREE * scale).any():
                raise DataError(place, f"another covariance of {name} than its calibration has", "the same")
        return RigResult(
            {name: cameras[name] for name in names},
            covariance,
            cast(Status, table.text("status")),
            table.sentences("reasons"),
            _known(table.table("known")),
            table.mapping("diagnostics"),
        )


def read_rig(path: str | Path) -> RigResult:
    """The result in a folder that ``sst-graph calibrate`` wrote for several cameras, or in its ``rig.json``.

    Raises:
        DataError: a file is missing, unreadable, or of another result.
    """
    path = path_of(path, "a rig.json")
    file = path / RIG_NAME if path.is_dir() else path
    text = read_text(file, RIG)
    names = _names(json_table(parse_json(text, file, RIG.name), file, FORMAT, VERSION))
    folders = folder_names(names)
    cameras = {name: read_result(file.parent / folders[name] / CALIBRATION_NAME) for name in names}
    return RigResult.from_json(text, cameras, file)


def folder_names(cameras: Mapping[str, Any] | tuple[str, ...]) -> dict[str, str]:
    """Name of each camera's folder: its own without what a folder's name cannot hold; different ones."""
    found: dict[str, str] = {}
    for name in cameras:
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", name).strip("_.") or "camera"
        free, number = plain, 2
        while free in found.values():
            free, number = f"{plain}_{number}", number + 1
        found[name] = free
    return found


def worst(statuses: list[Status]) -> Status:
    """The worst of some statuses."""
    order: tuple[Status, ...] = ("not_converged", "unobservable", "ok")
    return min(statuses, key=order.index)


def _names(table: JsonTable) -> tuple[str, ...]:
    names = tuple(camera.text("name") for camera in table.tables("cameras"))
    if not 1 <= len(names) <= _MOST_CAMERAS or len(set(names)) < len(names):
        raise DataError(
            f"{table.place}: cameras",
            count_of(len(names), "name"),
            f"1 to {_MOST_CAMERAS}, each of them once",
        )
    return names


def _known(table: JsonTable) -> KnownRig:
    trigger = table.value("one_trigger")
    if not isinstance(trigger, bool):
        raise DataError(f"{table.place}: one_trigger", f"{trigger!r:.60}", "true or false")
    try:
        poses = tuple(
            KnownPose(
                pose.text("camera"),
                pose.text("reference"),
                pose.pose("T_camera_reference"),
                pose.number("rotation_sigma_deg"),
                pose.number("translation_sigma_m"),
            )
            for pose in table.tables("poses")
        )
    except ConfigError as error:
        raise DataError(table.place, str(error), "poses of cameras in others") from None
    return KnownRig(poses, trigger)
