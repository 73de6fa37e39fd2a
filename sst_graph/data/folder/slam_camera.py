"""Cameras in the settings of SLAM systems: ORB-SLAM, VINS (camodocal), FAST-LIVO (vikit).

- ORB-SLAM 2 and 3: ``Camera.fx`` or ``Camera1.fx``, ``Camera.k1``, ``Camera.type``, ``Camera.width``;
- camodocal, of VINS-Mono, VINS-Fusion and LVI-SAM: ``model_type``, ``projection_parameters``,
  ``distortion_parameters``, ``image_width``;
- vikit, of SVO, FAST-LIVO and R3LIVE: ``cam_model``, ``cam_fx``, ``cam_d0`` or ``k1``, ``cam_width``.

Their other entries are not of the camera.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sst_graph.cameras.model import CameraModel
from sst_graph.cameras.readers import camera_of
from sst_graph.data.folder.camera_entries import pinhole_by_names, refuse_of_lens
from sst_graph.errors import DataError
from sst_graph.files.yaml_file import number

Table = Mapping[str, Any]

_PLUMB_BOB, _FISHEYE = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_ORB = re.compile(r"Camera1?\.(\w+)", re.ASCII)
_COEFFICIENT = re.compile(r"(cam)?[kpd]\d|xi|alpha|lambda", re.ASCII)
"""Plain names of numbers that say what a lens does."""


@dataclass(frozen=True)
class _Camera:
    """Entries of a camera.

    Attributes:
        entries: by their names in the file.
        intrinsics: names of fx, fy, cx, cy, width and height.
        lens: names of the coefficients, in OpenCV's order.
        distortion: the lens's name in ROS.
    """

    entries: Table
    intrinsics: tuple[str, str, str, str, str, str]
    lens: Collection[str]
    distortion: str

    def model(self, place: str | Path) -> CameraModel:
        """Raises:
        DataError: an entry is missing, no number, or of another lens.
        """
        refuse_of_lens(self.entries, self.lens, place, _COEFFICIENT)
        expected = f"{', '.join(self.intrinsics)} of the camera"
        intrinsics = pinhole_by_names(self.entries, self.intrinsics, place, expected)
        values = [number(self.entries.get(name, 0.0), f"{place} ({name})") for name in self.lens]
        return camera_of(intrinsics, self.distortion, values, place)


def slam_camera(table: Table, place: str | Path) -> CameraModel | None:
    """The camera of a SLAM system's settings; None where a table is not one.

    Raises:
        DataError: a model that is not known, or an entry that is missing or no number.
    """
    for form in (_orb_slam, _camodocal, _vikit):
        if (found := form(table, place)) is not None:
            return found.model(place)
    return None


def _orb_slam(table: Table, place: str | Path) -> _Camera | None:
    entries = {name[1]: value for key, value in table.items() if (name := _ORB.fullmatch(str(key)))}
    if "fx" not in entries:
        return None
    lenses = {
        "pinhole": ("plumb_bob", _PLUMB_BOB),
        "rectified": ("none", ()),
        "kannalabrandt8": ("equidistant", _FISHEYE),
    }
    distortion, lens = _lens(entries.get("type", "PinHole"), lenses, f"{place} (Camera.type)")
    return _Camera(entries, ("fx", "fy", "cx", "cy", "width", "height"), lens, distortion)


def _camodocal(table: Table, place: str | Path) -> _Camera | None:
    projection = table.get("projection_parameters")
    if not isinstance(projection, dict):
        return None
    of_lens = table.get("distortion_parameters", {})
    if not isinstance(of_lens, dict):
        raise DataError(place, f"distortion_parameters {of_lens!r:.60}", "numbers by name")
    entries = {str(key): value for key, value in {**projection, **of_lens}.items()}
    size = {name: table[name] for name in ("image_width", "image_height") if name in table}
    lenses = {
        "pinhole": ("plumb_bob", _PLUMB_BOB),
        "kannalabrandt": ("equidistant", ("k2", "k3", "k4", "k5")),
    }
    distortion, lens = _lens(table.get("model_type", ""), lenses, f"{place} (model_type)")
    names = ("mu", "mv", "u0", "v0") if distortion == "equidistant" else ("fx", "fy", "cx", "cy")
    return _Camera({**entries, **size}, (*names, "image_width", "image_height"), lens, distortion)


def _vikit(table: Table, place: str | Path) -> _Camera | None:
    if "cam_fx" not in table:
        return None
    lenses = {
        "pinhole": ("plumb_bob", tuple(f"cam_d{k}" for k in range(5))),
        "equidistantcamera": ("equidistant", _FISHEYE),
    }
    distortion, lens = _lens(table.get("cam_model", ""), lenses, f"{place} (cam_model)")
    entries = {str(key): value for key, value in table.items()}
    names = ("cam_fx", "cam_fy", "cam_cx", "cam_cy", "cam_width", "cam_height")
    return _Camera(entries, names, lens, distortion)


def _lens(
    model: object, lenses: Mapping[str, tuple[str, tuple[str, ...]]], place: str
) -> tuple[str, tuple[str, ...]]:
    """Name in ROS and names of the coefficients of a model."""
    plain = str(model).lower().replace("_", "")
    if plain not in lenses:
        raise DataError(place, f"camera model {model!r:.60}", f"one of {', '.join(lenses)}")
    return lenses[plain]
