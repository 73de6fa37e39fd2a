"""What a drive, a scan or an image must be, checked once where it comes in.

Scans and images come back in the documented dtypes (:mod:`sst_graph.types`), without a copy where nothing has
to change. Whole numbers and floats of any width and byte order are converted where every value
fits; everything else is refused with what was found and what was expected.
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of, one_line
from sst_graph.factors.arguments import described, is_whole, masked_values
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import checked_pose, checked_text, checked_time_offset_s, pinhole_camera
from sst_graph.timestamps import LATEST_NS
from sst_graph.types import NO_PICTURE, CameraImage, Frame, PixelStretch, Scan, SemanticClass, Source

MOST_POINTS = 10_000_000
"""Points of a scan; ten times what the densest spinning LiDAR gives in a sweep."""
FARTHEST_M = 1e5
"""No LiDAR sees farther; a larger coordinate is another unit or a broken packet [m]."""
LONGEST_SWEEP_S = 2.0
"""Times of points are relative to the scan's stamp; a larger one is an absolute time [s]."""

MOST_STRETCH = 1e6
"""No lens enlarges pixels more where an image is rectified."""

_IS_CLASS = np.isin(np.arange(256), [int(c) for c in SemanticClass])
_FIRST_UNKNOWN = int(np.argmin(_IS_CLASS))
"""All smaller numbers are classes."""


def is_source(value: object) -> bool:
    """Whether a value has what a :class:`~sst_graph.types.Source` has."""
    return all(hasattr(value, name) for name in ("camera", "nominal", "name", "__len__", "__getitem__"))


def checked_source(source: Any) -> Source:
    """A source whose own words can be used: its name, with which results are written, length, camera and
    nominal extrinsic. Its frames are checked where they are read.

    Raises:
        DataError: one of these is none.
    """
    if not is_source(source):
        raise DataError("a drive", described(source), "a source, with name, camera, nominal and frames")
    name = source.name
    if not isinstance(name, str):
        raise DataError(f"a {type(source).__name__}: name", described(name), "text")
    checked_text(name, f"a {type(source).__name__}: name")
    try:
        count = len(source)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{name}: length", one_line(error), "a number of frames") from error
    if count == 0:
        raise DataError(name, "no frame", "one or more")
    checked_intrinsics(source.camera, f"{name}: camera")
    if not isinstance(source.nominal, gtsam.Pose3 | None):
        raise DataError(f"{name}: nominal", described(source.nominal), "a gtsam.Pose3, or None")
    return source  # type: ignore[no-any-return]


def checked_position(position: Any, count: int, slices: bool = False) -> int:
    """Position of one of ``count`` frames, from 0; those below zero count from the end.

    Args:
        slices: whether a slice would have done, for the message.

    Raises:
        DataError: no whole number.
        IndexError: no frame there, by which Python knows the end of a sequence.
    """
    if not is_whole(position):
        raise DataError(
            "position of a frame", described(position), f"a whole number{', or a slice' * slices}"
        )
    number: int = int(position)
    if not -count <= number < count:
        raise IndexError(f"frame {described(number)}: the drive has {count}")
    return number % count


def checked_slice(positions: slice, count: int) -> slice:
    """Positions of some of ``count`` frames.

    Raises:
        DataError: a bound or a step that is no whole number, or a step of zero.
    """
    try:
        positions.indices(count)
    except (TypeError, ValueError):
        parts = ", ".join(map(described, (positions.start, positions.stop, positions.step)))
        raise DataError("slice of frames", parts, "whole numbers or None, and no step of 0") from None
    return positions


def checked_scan(scan: object, place: str = "scan", fewest: int = 1) -> Scan:
    """A scan whose arrays agree with each other and hold nothing but usable numbers.

    Args:
        fewest: points that it must have.

    Raises:
        DataError: they do not.
    """
    if not isinstance(scan, Scan):
        raise DataError(place, f"a {type(scan).__name__}", "a Scan")
    stamp_ns = checked_stamp(scan.stamp_ns, place)
    points = _array(scan.points, (None, 3), f"{place}: points")
    n = len(points)
    if not fewest <= n <= MOST_POINTS:
        raise DataError(f"{place}: points", count_of(n, "point"), f"{fewest} to {MOST_POINTS}")
    points = _reals(points, FARTHEST_M, f"{place}: points", "m")
    classes = _labels(_array(scan.classes, (n,), f"{place}: classes"), f"{place}: classes")
    instances, rings = (
        None if value is None else _whole(_array(value, (n,), f"{place}: {name}"), f"{place}: {name}")
        for name, value in (("instances", scan.instances), ("rings", scan.rings))
    )
    offsets_s = None
    if scan.offsets_s is not None:
        times = _array(scan.offsets_s, (n,), f"{place}: point times")
        offsets_s = _reals(times, LONGEST_SWEEP_S, f"{place}: point times", "s after the stamp")
    left_out = scan.left_out
    if not is_whole(left_out) or left_out < 0:
        raise DataError(f"{place}: left_out", described(left_out), "a number of points")
    return Scan(stamp_ns, points, classes, instances, offsets_s, rings, int(left_out))


def checked_image(image: object, camera: PinholeCamera, place: str = "image") -> CameraImage:
    """An image whose mask, picture and instances have the camera's size; the picture may be missing.

    Raises:
        DataError: they have not, or hold other than labels and 8-bit colours.
    """
    if not isinstance(image, CameraImage):
        raise DataError(place, f"a {type(image).__name__}", "a CameraImage")
    stamp_ns = checked_stamp(image.stamp_ns, place)
    size = (camera.height, camera.width)
    # The picture first: a mask may have been made as large as it.
    for what, array in (("picture", image.pixels), ("mask", image.mask)):
        _check_size(array, size, what, place)
    mask = _array(image.mask, size, f"{place}: mask", "the camera's size")
    mask = _labels(mask, f"{place}: mask")
    pixels = NO_PICTURE
    if not isinstance(image.pixels, np.ndarray) or image.has_picture:
        pixels = _array(image.pixels, (*size, 3), f"{place}: pixels", "the camera's size in BGR")
    if pixels.dtype != np.uint8:
        raise DataError(f"{place}: pixels", f"dtype {pixels.dtype}", "uint8")
    instances = None
    if image.instances is not None:
        instances = _array(image.instances, size, f"{place}: instances", "the camera's size")
        instances = _whole(instances, f"{place}: instances")
    valid = image.valid
    if valid is not None:
        valid = _array(valid, size, f"{place}: valid", "the camera's size")
        if valid.dtype != np.bool_:
            raise DataError(f"{place}: valid", f"dtype {valid.dtype}", "bool")
    stretch = None if image.stretch is None else _stretch(image.stretch, f"{place}: stretch")
    return CameraImage(stamp_ns, mask, np.ascontiguousarray(pixels), instances, valid, stretch)


def checked_frame(frame: object, place: str = "frame") -> Frame:
    """A frame with an index and its two parts, which are not looked into.

    Raises:
        DataError: something else, or an index that is no whole number.
    """
    if not isinstance(frame, Frame):
        raise DataError(place, f"a {type(frame).__name__}", "a Frame")
    return Frame(checked_index(frame.index, place), frame.scan, frame.image)


def checked_index(index: object, place: str = "frame") -> int:
    """The number of a frame in its drive as a plain int.

    Raises:
        DataError: it is no whole number, or one that does not fit into int64.
    """
    if not is_whole(index):
        raise DataError(place, f"an index that is a {type(index).__name__}", "a whole number")
    if abs(int(index)) > LATEST_NS:
        raise DataError(place, "an index of more than 19 digits", "a number of a frame")
    return int(index)


def checked_intrinsics(camera: object, place: str = "camera") -> PinholeCamera:
    """A camera of plain numbers that go with the size of its image.

    Raises:
        DataError: something else, or as :func:`sst_graph.files.checked_values.pinhole_camera`.
    """
    if not isinstance(camera, PinholeCamera):
        raise DataError(place, f"a {type(camera).__name__}", "a PinholeCamera")
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    return pinhole_camera(intrinsics, (int(camera.width), int(camera.height)), place)


def checked_guess(initial: object, time_offset_s: object) -> tuple[gtsam.Pose3 | None, float]:
    """A guess of cTl, or None, and one of the time offset [s].

    Raises:
        DataError: no pose, no finite number, or no pose of two sensors on one vehicle.
    """
    offset = checked_time_offset_s(_number(time_offset_s, "initial time offset"), "initial time offset")
    if initial is None:
        return None, offset
    if not isinstance(initial, gtsam.Pose3):
        raise DataError("initial", f"a {type(initial).__name__}", "a gtsam.Pose3, or None")
    # As it is, and not made orthonormal anew: the same guess gives the same bits.
    checked_pose(np.asarray(initial.matrix()), "initial")
    return initial, offset


def _number(value: object, place: str) -> float:
    """A finite number as a plain float."""
    numbers = int | float | np.integer | np.floating
    if isinstance(value, bool | np.timedelta64) or not isinstance(value, numbers):
        raise DataError(place, f"a {type(value).__name__}", "a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DataError(place, f"{number}", "a finite number")
    return number


def _stretch(stretch: object, place: str) -> PixelStretch:
    """The checked stretch of a rectified image: a grid of at least 2x2 places, and a whole step."""
    if not isinstance(stretch, PixelStretch):
        raise DataError(place, f"a {type(stretch).__name__}", "a PixelStretch")
    squares = _array(stretch.squares, (None, None, 3), f"{place}: squares")
    if min(squares.shape[:2]) < 2:
        raise DataError(f"{place}: squares", f"shape {squares.shape}", "at least 2 rows and columns")
    step = stretch.step_px
    if not is_whole(step) or not 1 <= step <= LATEST_NS:
        raise DataError(f"{place}: step_px", f"{step!r:.60}", "a whole number of pixels, 1 or more")
    checked = _reals(squares, MOST_STRETCH**2, f"{place}: squares", "px^2 a px^2")
    return stretch if checked is stretch.squares and type(step) is int else PixelStretch(checked, int(step))


def _check_size(array: object, size: tuple[int, int], what: str, place: str) -> None:
    """Height and width, where an array has these; a picture may be missing."""
    if not isinstance(array, np.ndarray) or array.ndim < 2 or (what == "picture" and not array.size):
        return
    if array.shape[:2] != size:
        (height, width), (h, w) = size, array.shape[:2]
        remedy = "all of a drive have it" if what == "picture" else "make masks at the pictures' full size"
        expected = f"{width}x{height} px, the camera's size: {remedy}"
        raise DataError(place, f"a {what} of {w}x{h} px", expected)


def checked_stamp(stamp_ns: object, place: str) -> int:
    """A stamp as a plain int [ns].

    Raises:
        DataError: it is no whole number, or one that no clock shows.
    """
    if not is_whole(stamp_ns):
        raise DataError(place, f"a stamp that is a {type(stamp_ns).__name__}", "whole nanoseconds")
    if abs(int(stamp_ns)) > LATEST_NS:
        raise DataError(place, "a stamp of more than 146 years", "nanoseconds that fit into int64")
    return int(stamp_ns)


def _array(value: object, shape: tuple[int | None, ...], place: str, why: str = "") -> NDArray[Any]:
    """A plain array of a shape, in which None stands for any length."""
    if not isinstance(value, np.ndarray):
        raise DataError(place, f"a {type(value).__name__}", "a NumPy array")
    fits = value.ndim == len(shape) and all(
        b is None or a == b for a, b in zip(value.shape, shape, strict=True)
    )
    if not fits:
        wanted = f"({', '.join('n' if length is None else str(length) for length in shape)})"
        raise DataError(place, f"shape {value.shape}", f"{wanted}{f', {why}' if why else ''}")
    if (masked := masked_values(value)) > 0:
        raise DataError(place, count_of(masked, "masked value"), "an array without a mask: leave them out")
    return np.asarray(value)


def _reals(array: NDArray[Any], most: float, place: str, unit: str) -> NDArray[np.float32]:
    """As float32, all finite and within +-``most``."""
    if array.dtype.kind not in "fiu":
        raise DataError(place, f"dtype {array.dtype}", "float32")
    if not array.size:
        return np.ascontiguousarray(array, np.float32)
    # NaN and inf make the largest or the smallest value NaN or inf, and no copy is needed to see it.
    low, high = float(array.min()), float(array.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = int(np.count_nonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1)))
        raise DataError(place, f"{bad} of {len(array)} that are NaN or inf", "finite numbers")
    if max(-low, high) > most:
        worst = low if -low > high else high
        raise DataError(place, f"{worst:.6g}", f"at most {most:g} {unit}")
    return np.ascontiguousarray(array, np.float32)


def _labels(array: NDArray[Any], place: str) -> NDArray[np.uint8]:
    """As uint8, nothing but classes."""
    if array.dtype.kind not in "iu":
        raise DataError(place, f"dtype {array.dtype}", "uint8 of SemanticClass")
    if not array.size:
        return np.ascontiguousarray(array, np.uint8)
    if array.dtype != np.uint8 and (int(array.min()) < 0 or int(array.max()) > 255):
        raise DataError(place, f"labels {int(array.min())} to {int(array.max())}", "values of SemanticClass")
    labels = np.ascontiguousarray(array, np.uint8)
    # Most arrays are known by their largest number.
    if int(labels.max()) < _FIRST_UNKNOWN:
        return labels
    known = _IS_CLASS.take(labels)
    if not known.all():
        raise DataError(place, f"label {int(labels[~known][0])}", "values of SemanticClass")
    return labels


def _whole(array: NDArray[Any], place: str) -> NDArray[np.uint16]:
    """As uint16."""
    if array.dtype.kind not in "iu":
        raise DataError(place, f"dtype {array.dtype}", "uint16")
    if not array.size:
        return np.ascontiguousarray(array, np.uint16)
    if array.dtype not in (np.uint8, np.uint16) and (int(array.min()) < 0 or int(array.max()) > 0xFFFF):
        raise DataError(place, f"numbers {int(array.min())} to {int(array.max())}", "0 to 65535")
    return np.ascontiguousarray(array, np.uint16)
