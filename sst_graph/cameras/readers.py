"""Camera models from the tables of other software; each function takes what a parser gives.

Images are raw unless a function says otherwise. Errors name the place, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.cameras.brown_conrady import BrownConradyCamera
from sst_graph.cameras.double_sphere import DoubleSphereCamera
from sst_graph.cameras.fisheye import FisheyeCamera
from sst_graph.cameras.model import LARGEST_COEFFICIENT, CameraModel
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import checked_camera, checked_pose, pinhole_camera
from sst_graph.types import FloatArray

Table = Mapping[str, Any]

_BROWN_CONRADY = {
    "plumb_bob": (4, 5),
    "radtan": (4,),
    "radial-tangential": (4, 5),
    "rational_polynomial": (8, 12, 14),
    "thin_prism": (12, 14),
}
"""Numbers of coefficients by the name of the distortion in ROS, Kalibr, OpenCV; 14: with a tilted sensor."""
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala-brandt")
_NONE = ("", "none", "pinhole")
_KALIBR = "pinhole with none, radtan or equidistant, or ds"


def camera_of(
    intrinsics: PinholeCamera, distortion: str, coefficients: Sequence[float] | FloatArray, place: str | Path
) -> CameraModel:
    """The model of a distortion's name and coefficients, in OpenCV's order.

    Coefficients that are all 0 make a pinhole, but not of a fisheye: an ideal one is none. Zeros behind the
    most coefficients that a model has are padding, as drivers with arrays of one length write it.

    Raises:
        DataError: an unknown name, a number of coefficients that does not go with it, intrinsics that do not
            go with the size of the image.
    """
    intrinsics = checked_camera(intrinsics, place)
    name = distortion.lower()
    most = 4 if name in _FISHEYE else max(_BROWN_CONRADY.get(name, (0,)))
    values = tuple(float(value) for value in coefficients)
    values = values[:most] if most and not any(values[most:]) else values
    if not (np.abs(values) <= LARGEST_COEFFICIENT).all():
        expected = f"finite numbers of at most {LARGEST_COEFFICIENT:g}"
        raise DataError(place, f"distortion coefficients {values}", expected)
    if name in _FISHEYE:
        if len(values) != 4:
            raise DataError(
                place, f"{count_of(len(values), 'coefficient')} of {distortion}", "4 (k1 k2 k3 k4)"
            )
        return FisheyeCamera(intrinsics, values)
    if name in _NONE and any(values):
        found = f"{count_of(len(values), 'distortion coefficient')} without the name of a model"
        raise DataError(place, found, f"one of {', '.join((*_BROWN_CONRADY, *_FISHEYE))}")
    if not any(values) and name in (*_NONE, *_BROWN_CONRADY):
        return BrownConradyCamera(intrinsics)
    if name not in _BROWN_CONRADY:
        known = ", ".join((*_BROWN_CONRADY, *_FISHEYE))
        raise DataError(place, f"distortion model '{distortion}'", f"one of {known}")
    if len(values) not in _BROWN_CONRADY[name]:
        expected = " or ".join(map(str, _BROWN_CONRADY[name]))
        raise DataError(place, f"{count_of(len(values), 'coefficient')} of {distortion}", expected)
    if len(values) == 14 and any(values[12:]):
        raise DataError(place, f"a tilted sensor (tau = {values[12:]})", "at most 12 coefficients")
    return BrownConradyCamera(intrinsics, values[:12])


def camera_from_camera_info(
    info: Table, rectified: bool = False, place: str | Path = "CameraInfo"
) -> CameraModel:
    """The camera of a ROS 1 or ROS 2 ``sensor_msgs/CameraInfo`` by field, K D P or k d p: ``vars(message)``.

    Args:
        rectified: the images are those of ``image_rect``: the pinhole of P. A calibration with these holds
            for the camera's rectified frame.

    Raises:
        DataError: an uncalibrated camera, another distortion model; binning or a region of interest, for
            which :func:`camera_info_of_size` gives the table to be read.
    """
    check_full_sensor(info, place)
    width, height = (_whole(info, key, place) for key in ("width", "height"))
    if rectified:
        P = _matrix(_either(info, "P", "p", place), (3, 4), f"{place}: P")
        if not P.any():
            raise DataError(place, "P = 0, an uncalibrated camera", "a calibrated one")
        return BrownConradyCamera(_pinhole(P[:, :3], width, height, f"{place}: P"))
    K = _matrix(_either(info, "K", "k", place), (3, 3), f"{place}: K")
    if not K.any():
        raise DataError(place, "K = 0, an uncalibrated camera", "a calibrated one")
    D = _numbers(_either(info, "D", "d", place), f"{place}: D")
    distortion = str(info.get("distortion_model", ""))
    return camera_of(_pinhole(K, width, height, f"{place}: K"), distortion, D, place)


def camera_info_of_size(info: Table, size: tuple[int, int], place: str | Path) -> dict[str, Any]:
    """The ``CameraInfo`` of images of ``size``, which may be a region of the sensor, binned.

    Where ``info`` has another size, its K and P are those of the full sensor; they become those of the images
    as in ROS's image_geometry: u = (u_full - x_offset) / binning_x. Where ``info`` has no size, or that of
    the images, K and P are theirs.

    Raises:
        DataError: the images have none of these sizes.
    """
    full = _member(info, "width", place), _member(info, "height", place)
    roi = info.get("roi")
    corner = _member(roi, "x_offset", place), _member(roi, "y_offset", place)
    # A region off the corner of what has the size of the whole contradicts that size: K may be of either.
    if full == (0, 0) or (full == size and any(corner)):
        check_full_sensor(info, place)
    table = dict(info) | {"width": size[0], "height": size[1], "binning_x": 0, "binning_y": 0, "roi": None}
    if full in ((0, 0), size):
        return table
    binning = [max(1, _member(info, f"binning_{axis}", place)) for axis in "xy"]
    region = _member(roi, "width", place) or full[0], _member(roi, "height", place) or full[1]
    if (region[0] // binning[0], region[1] // binning[1]) != size:
        part = f", a region of {region[0]}x{region[1]} px" if region != full else ""
        binned = f", binned {binning[0]}x{binning[1]}" if max(binning) > 1 else ""
        expected = f"{size[0]}x{size[1]} px, the size of the images"
        raise DataError(place, f"{full[0]}x{full[1]} px{part}{binned}", expected)
    scale = np.diag([1.0 / binning[0], 1.0 / binning[1], 1.0])
    scale[:2, 2] = -np.array(corner) / binning
    for name, columns in (("K", 3), ("P", 4)):
        key = name if name in table else name.lower()
        matrix = _matrix(_either(table, name, name.lower(), place), (3, columns), f"{place}: {name}")
        table[key] = (scale @ matrix).ravel()
    return table


def check_full_sensor(info: Table, place: str | Path) -> None:
    """Refuse a ``CameraInfo`` of images that are binned, or of a part of the sensor.

    Raises:
        DataError: it is.
    """
    width, height, roi = _member(info, "width", place), _member(info, "height", place), info.get("roi")
    region = {key: _member(roi, key, place) for key in ("x_offset", "y_offset", "width", "height")}
    binned = max(_member(info, "binning_x", place), _member(info, "binning_y", place)) > 1
    cut = region["width"] not in (0, width) or region["height"] not in (0, height)
    if binned or cut or region["x_offset"] or region["y_offset"]:
        raise DataError(place, "binning or a region of interest", "images of the full sensor")


def _member(group: object, name: str, place: str | Path) -> int:
    """Number in a table or an object, 0 where there is none.

    Raises:
        DataError: no number.
    """
    value = group.get(name, 0) if isinstance(group, Mapping) else getattr(group, name, 0)
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError):
        raise DataError(place, f"{name}: {value!r:.60}", "a whole number") from None


@dataclass(frozen=True)
class KalibrCamera:
    """One camera of a chain.

    Attributes:
        model: the camera.
        topic: its ROS topic; empty where the file has none.
        cTb: pose of the camera before it in the chain, in this one (``T_cn_cnm1``); None for the first.
    """

    model: CameraModel
    topic: str
    cTb: gtsam.Pose3 | None


def cameras_from_kalibr(chain: Table, place: str | Path = "camchain") -> dict[str, KalibrCamera]:
    """The cameras of a Kalibr ``camchain.yaml`` by name (``cam0`` ...).

    Raises:
        DataError: no camera, or one with a model that is not supported (omni, eucm, fov).
    """
    cameras = {
        name: _kalibr_camera(table, f"{place}: {name}")
        for name, table in chain.items()
        if isinstance(table, Mapping) and name.startswith("cam")
    }
    if not cameras:
        raise DataError(place, f"the keys {', '.join(map(str, chain))}", "cam0, cam1, ...")
    return cameras


def _kalibr_camera(table: Table, place: str) -> KalibrCamera:
    kind, distortion = str(table.get("camera_model")), str(table.get("distortion_model", "none"))
    values = _numbers(_needed(table, "intrinsics", place), f"{place}: intrinsics")
    coefficients = _numbers(table.get("distortion_coeffs", ()), f"{place}: distortion_coeffs")
    if distortion != "none" and "distortion_coeffs" not in table:
        raise DataError(place, f"the distortion '{distortion}' without coefficients", "distortion_coeffs")
    width, height = _sides(_needed(table, "resolution", place), f"{place}: resolution")
    own = {"pinhole": 0, "ds": 2}.get(kind)
    if own is None:
        raise DataError(place, f"camera model '{kind}'", f"{_KALIBR}: calibrate with one of these")
    if len(values) != own + 4:
        names = "[xi, alpha, fu, fv, pu, pv]" if own else "[fu, fv, pu, pv]"
        raise DataError(place, f"{count_of(len(values), 'intrinsic')} of {kind}", names)
    fx, fy, cx, cy = (float(value) for value in values[own:])
    intrinsics = pinhole_camera((fx, fy, cx, cy), (width, height), place)
    model: CameraModel
    if kind == "ds":
        if distortion != "none" or coefficients.any():
            raise DataError(place, f"ds with the distortion '{distortion}'", "none")
        try:
            model = DoubleSphereCamera(intrinsics, float(values[0]), float(values[1]))
        except ConfigError as error:
            raise DataError(place, str(error), "a double sphere") from None
    elif distortion not in ("none", "radtan", "equidistant"):
        raise DataError(place, f"pinhole with the distortion '{distortion}'", _KALIBR)
    else:
        model = camera_of(intrinsics, distortion, coefficients, place)
    chained = table.get("T_cn_cnm1")
    cTb = None
    if chained is not None:
        cTb = checked_pose(_matrix(chained, (4, 4), f"{place}: T_cn_cnm1"), f"{place}: T_cn_cnm1")
    return KalibrCamera(model, str(table.get("rostopic", "")), cTb)


def camera_from_opencv(table: Table, place: str | Path = "camera file") -> CameraModel:
    """The camera in a file that OpenCV's calibration or ROS's ``camera_info_manager`` wrote.

    Matrices are lists, arrays or tables with ``data``. A fisheye says so by ``fisheye_model: 1`` (OpenCV's
    sample) or ``distortion_model: equidistant``.

    Raises:
        DataError: a value is missing, or the model is unknown.
    """
    K = _matrix(_either(table, "camera_matrix", "K", place), (3, 3), f"{place}: camera_matrix")
    D = _numbers(_either(table, "distortion_coefficients", "D", place), f"{place}: distortion_coefficients")
    width, height = _whole(table, "image_width", place), _whole(table, "image_height", place)
    # OpenCV writes 5, 8, 12 or 14 coefficients, and no name of the model.
    usual = "equidistant" if _member(table, "fisheye_model", place) else _NAME_BY_LENGTH.get(len(D), "")
    distortion = str(table.get("distortion_model", usual))
    return camera_of(_pinhole(K, width, height, f"{place}: camera_matrix"), distortion, D, place)


_NAME_BY_LENGTH = {
    4: "plumb_bob",
    5: "plumb_bob",
    8: "rational_polynomial",
    12: "thin_prism",
    14: "thin_prism",
}


def camera_from_kitti_raw(
    table: Table, number: int, rectified: bool, place: str | Path = "calib_cam_to_cam.txt"
) -> CameraModel:
    """Camera 0 to 3 of KITTI raw's ``calib_cam_to_cam.txt``, numbers by key (``K_02``).

    Args:
        rectified: images of a ``_sync`` drive (``S_rect``, ``P_rect``: a pinhole); else of an ``_extract``
            one (``S``, ``K``, ``D``).

    Raises:
        DataError: a key is missing, or its numbers are no camera.
    """
    size, matrix = ("S_rect", "P_rect") if rectified else ("S", "K")
    width, height = _sides(_needed(table, f"{size}_{number:02d}", place), f"{place}: {size}_{number:02d}")
    key = f"{matrix}_{number:02d}"
    K = _matrix(_needed(table, key, place), (3, 4) if rectified else (3, 3), f"{place}: {key}")
    intrinsics = _pinhole(K[:, :3], width, height, f"{place}: {key}")
    D = () if rectified else _numbers(_needed(table, f"D_{number:02d}", place), f"{place}: D_{number:02d}")
    return camera_of(intrinsics, "none" if rectified else "plumb_bob", tuple(D), place)


def kitti_rectifying_rotation(
    table: Table, number: int, place: str | Path = "calib_cam_to_cam.txt"
) -> gtsam.Rot3:
    """``R_rect`` of a camera: from its raw to its rectified frame, p_rect = R_rect p_raw.

    Raises:
        DataError: the key is missing, or is no rotation.
    """
    key = f"R_rect_{number:02d}"
    T = np.eye(4)
    T[:3, :3] = _matrix(_needed(table, key, place), (3, 3), f"{place}: {key}")
    return checked_pose(T, f"{place}: {key}").rotation()


def camera_from_nuscenes(
    calibrated_sensor: Table, width: int = 1600, height: int = 900, place: str | Path = "calibrated_sensor"
) -> CameraModel:
    """The camera in a record of nuScenes' or nuImages' ``calibrated_sensor``; nuScenes' images are
    undistorted.

    Raises:
        DataError: the sensor is no camera, or has a distortion with more than five coefficients (nuImages'
            sixth is another model's).
    """
    values = calibrated_sensor.get("camera_intrinsic")
    if values is None or values == []:
        raise DataError(place, "no camera_intrinsic", "the record of a camera")
    K = _matrix(values, (3, 3), f"{place}: camera_intrinsic")
    given = calibrated_sensor.get("camera_distortion")
    D = _numbers(() if given is None else given, f"{place}: camera_distortion")
    if len(D) == 6 and D[5] == 0.0:
        D = D[:5]
    distortion = "plumb_bob" if len(D) else "none"
    return camera_of(_pinhole(K, width, height, f"{place}: camera_intrinsic"), distortion, D, place)


def _needed(table: Table, key: str, place: str | Path) -> Any:
    if key not in table:
        raise DataError(place, f"no {key}", f"{key} beside {', '.join(map(str, list(table)[:20]))}")
    return table[key]


def _either(table: Table, key: str, other: str, place: str | Path) -> Any:
    return table[other] if key not in table and other in table else _needed(table, key, place)


def _whole(table: Table, key: str, place: str | Path) -> int:
    return _sides([_needed(table, key, place)] * 2, f"{place}: {key}")[0]


def _sides(values: object, place: str) -> tuple[int, int]:
    """Width and height [px]."""
    sides = _numbers(values, place)
    if len(sides) != 2 or (sides != np.rint(sides)).any() or (sides < 1).any():
        raise DataError(place, f"{sides.tolist()}", "whole numbers of pixels")
    return int(sides[0]), int(sides[1])


def _numbers(values: object, place: str) -> FloatArray:
    """(n,) finite numbers of a list, an array, or a table with ``data``."""
    if isinstance(values, Mapping):
        values = _needed(values, "data", place)
    try:
        numbers = np.asarray(values, np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise DataError(place, f"{values!r:.100}", "numbers") from None
    if not np.isfinite(numbers).all():
        raise DataError(place, "NaN or inf", "finite numbers")
    return numbers


def _matrix(values: object, shape: tuple[int, int], place: str) -> FloatArray:
    numbers = _numbers(values, place)
    if len(numbers) != shape[0] * shape[1]:
        raise DataError(place, count_of(len(numbers), "number"), f"{shape[0] * shape[1]} of a {shape} matrix")
    return numbers.reshape(shape)


def _pinhole(K: FloatArray, width: int, height: int, place: str) -> PinholeCamera:
    """Intrinsics of [fx 0 cx; 0 fy cy; 0 0 1]."""
    skewed = abs(K[0, 1]) > 1e-6 * abs(K[0, 0]) or K[1, 0] != 0.0
    if skewed or not np.allclose(K[2], [0.0, 0.0, 1.0], atol=1e-9):
        raise DataError(place, f"{K.tolist()}", "[fx 0 cx; 0 fy cy; 0 0 1]")
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return pinhole_camera((fx, fy, cx, cy), (width, height), place)
