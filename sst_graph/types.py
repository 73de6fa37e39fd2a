"""Data types of sst_graph: scans, images, frames, sources, motions.

Conventions (frames, signs, units) are stated in :mod:`factors`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.arguments import checked_array, checked_gtsam, checked_number, checked_type
from sst_graph.factors.camera import PinholeCamera

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class ByValue:
    """Equality and hash of a frozen dataclass with arrays, poses or tables in it: by value, bit by bit.

    The dataclass is declared with ``eq=False``. NaN equals NaN, and 0.0 equals -0.0 not.
    """

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return _value(self) == _value(other)

    def __hash__(self) -> int:
        return hash(_value(self))


def _value(item: Any) -> Hashable:
    """``item`` as a hashable value that is equal for equal content."""
    if isinstance(item, np.ndarray):
        return item.dtype.str, item.shape, item.tobytes()
    if isinstance(item, gtsam.Pose3):
        return "Pose3", item.matrix().tobytes()
    if isinstance(item, Mapping):
        return frozenset((key, _value(one)) for key, one in item.items())
    if isinstance(item, list | tuple):
        return tuple(_value(one) for one in item)
    if isinstance(item, float):
        return "float", float(item).hex()
    if dataclasses.is_dataclass(item) and not isinstance(item, type):
        values = (_value(getattr(item, f.name)) for f in dataclasses.fields(item) if f.compare)
        return (type(item).__qualname__, *values)
    hash(item)
    return item  # type: ignore[no-any-return]


class SemanticClass(IntEnum):
    """Canonical classes that both sensors' labels are mapped to.

    ``OTHER`` is known to be none of the named classes (background); ``IGNORE`` may be anything. ``OBJECT`` is
    what stands on the ground, of no known class: found by geometry, in no label of any data set.
    """

    OTHER = 0
    VEHICLE = 1
    GROUND = 2
    BUILDING = 3
    VEGETATION = 4
    POLE = 5
    PERSON = 6
    TWO_WHEELER = 7
    SKY = 8
    TERRAIN = 9
    FENCE = 10
    SIGN = 11
    OBJECT = 12
    IGNORE = 255


@dataclass(frozen=True, eq=False)
class Scan(ByValue):
    """One LiDAR sweep.

    Attributes:
        stamp_ns: LiDAR-clock stamp [ns].
        points: (n, 3) float32, LiDAR frame [m].
        classes: (n,) uint8 of :class:`SemanticClass`.
        instances: (n,) uint16 instance number within its class (0: none), or None.
        offsets_s: (n,) float32, time of each point minus ``stamp_ns`` [s], or None where all
            points are taken at (or compensated to) the stamp.
        rings: (n,) uint16 laser number, or None where the data does not name it.
        left_out: number of further points in the data, which were NaN, inf or at the origin.
    """

    stamp_ns: int
    points: NDArray[np.float32]
    classes: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None = None
    offsets_s: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    left_out: int = 0

    @property
    def has_labels(self) -> bool:
        """Whether any point is known to be of some class."""
        return bool((self.classes != SemanticClass.IGNORE).any())


@dataclass(frozen=True, eq=False)
class ScanWithIntensities(Scan):
    """A scan of data that tell how strong the returns were; only networks look at it.

    Attributes:
        intensities: (n,) float32, in the data's own unit.
    """

    intensities: NDArray[np.float32] = dataclasses.field(kw_only=True)


def with_intensities(scan: Scan, intensities: NDArray[np.float32] | None) -> Scan:
    """The scan with the strength of its returns (n,), where the data tell it."""
    return scan if intensities is None else ScanWithIntensities(**vars(scan), intensities=intensities)


def intensities_of(scan: Scan) -> NDArray[np.float32] | None:
    """Strength of the returns (n,), or None where the data do not tell it."""
    return scan.intensities if isinstance(scan, ScanWithIntensities) else None


NO_PICTURE: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)
"""Pixels of an image whose picture is missing."""


@dataclass(frozen=True, eq=False)
class PixelStretch(ByValue):
    """By how much the pixels of a resampled image are enlarged against those of the image it was made of.

    With J the derivative of a pixel's place in the original by its place here, A = J^-1 J^-T: a distance d
    across a contour of unit normal n is d / sqrt(n' A n) in the original.

    Attributes:
        squares: (rows, columns, 3) float32: xx, xy and yy of A at every ``step_px``-th pixel.
        step_px: between two of them [px].
    """

    squares: NDArray[np.float32]
    step_px: int

    def across(self, uvs: FloatArray, normals: FloatArray) -> FloatArray:
        """Stretch (n,) across contours at pixels uvs (n, 2) [px], unit normals (n, 2).

        1 where pixels were made smaller: the pixels here then limit what is seen.
        """
        rows, columns = self.squares.shape[:2]
        place = np.clip(uvs.T / self.step_px, 0.0, np.array([[columns - 1.0], [rows - 1.0]]))
        first = np.minimum(place.astype(np.intp), np.array([[columns - 2], [rows - 2]]))
        (a, b), (u, v) = (place - first)[:, :, None], first
        xx, xy, yy = (
            (1.0 - b) * ((1.0 - a) * self.squares[v, u] + a * self.squares[v, u + 1])
            + b * ((1.0 - a) * self.squares[v + 1, u] + a * self.squares[v + 1, u + 1])
        ).T
        x, y = normals.T
        return np.asarray(np.sqrt(np.maximum(xx * x * x + 2.0 * xy * x * y + yy * y * y, 1.0)))


@dataclass(frozen=True, eq=False)
class CameraImage(ByValue):
    """One camera image with its semantic mask.

    Attributes:
        stamp_ns: camera-clock stamp [ns].
        mask: (h, w) uint8 of :class:`SemanticClass`; all IGNORE where there is no mask.
        pixels: (h, w, 3) uint8 BGR picture, or :data:`NO_PICTURE`.
        instances: (h, w) uint16 instance number (0: none), or None.
        valid: (h, w) bool, False where the camera saw nothing (rectified from a lens that sees less), or None
            where it saw everything. Its border is no edge of anything; the mask is IGNORE beyond it.
        stretch: of a rectified image, by how much its pixels are enlarged; None: they are as taken.
    """

    stamp_ns: int
    mask: NDArray[np.uint8]
    pixels: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None = None
    valid: NDArray[np.bool_] | None = None
    stretch: PixelStretch | None = None

    @property
    def has_mask(self) -> bool:
        """Whether any pixel is known to be of some class."""
        return bool((self.mask != SemanticClass.IGNORE).any())

    @property
    def has_picture(self) -> bool:
        return self.pixels.size > 0


@dataclass(frozen=True, eq=False)
class Frame(ByValue):
    """Scan ``index`` of a drive and the image that carries the same stamp; one may be missing."""

    index: int
    scan: Scan | None
    image: CameraImage | None


@dataclass(frozen=True, eq=False)
class Calibration(ByValue):
    """An extrinsic and a time offset: what this package estimates. ``cTl, time_offset_s = calibration``.

    Attributes:
        cTl: pose of the LiDAR in the camera.
        time_offset_s: offset with the sign of :mod:`factors` [s].

    Raises:
        FactorError: no pose, or no finite number.
    """

    cTl: gtsam.Pose3
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        checked_gtsam("cTl of Calibration", self.cTl, gtsam.Pose3)
        checked_number("time_offset_s of Calibration", self.time_offset_s)

    def local_coordinates(self, other: Calibration) -> FloatArray:
        """(7,) step to another: Log of the poses' difference [rad, m], difference of the offsets [s].

        Raises:
            FactorError: something else than a calibration.
        """
        checked_type("the other calibration", other, Calibration, "a Calibration")
        xi = gtsam.Pose3.Logmap(self.cTl.between(other.cTl))
        return np.append(np.asarray(xi, dtype=np.float64), other.time_offset_s - self.time_offset_s)

    def retract(self, step: FloatArray) -> Calibration:
        """The calibration a step (7,) away, as :meth:`local_coordinates` has it.

        Raises:
            FactorError: no such step.
        """
        step = checked_array("step of a Calibration", step, (7,))
        return Calibration(self.cTl.retract(step[:6]), self.time_offset_s + float(step[6]))

    def __iter__(self) -> Iterator[Any]:
        return iter((self.cTl, self.time_offset_s))


@dataclass(frozen=True)
class Guess:
    """What is known of a calibration beforehand: an extrinsic, or None, and a time offset [s].

    Raises:
        FactorError: no pose, or no finite number.
    """

    cTl: gtsam.Pose3 | None
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if self.cTl is not None:
            checked_gtsam("cTl of Guess", self.cTl, gtsam.Pose3)
        checked_number("time_offset_s of Guess", self.time_offset_s)


@dataclass(frozen=True, eq=False)
class GroundTruth(ByValue):
    """What is known to be true of a drive (simulated, or a published reference).

    Attributes:
        cTl: pose of the LiDAR in the camera.
        time_offset_s: offset with the sign of :mod:`factors`, or None where it is not known.

    Raises:
        FactorError: no pose, or no finite number.
    """

    cTl: gtsam.Pose3
    time_offset_s: float | None

    def __post_init__(self) -> None:
        checked_gtsam("cTl of GroundTruth", self.cTl, gtsam.Pose3)
        if self.time_offset_s is not None:
            checked_number("time_offset_s of GroundTruth", self.time_offset_s)


class Source(Protocol):
    """A drive: frames in the order of their index, each read when it is accessed."""

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> PinholeCamera: ...

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        """Nominal cTl that the data brings, or None."""
        ...

    @property
    def truth(self) -> GroundTruth | None: ...

    def __len__(self) -> int: ...

    def __getitem__(self, position: int) -> Frame: ...

    def __iter__(self) -> Iterator[Frame]: ...


@dataclass(frozen=True, eq=False)
class RelativeMotion(ByValue):
    """Motion of one sensor between two of its stamps.

    Attributes:
        from_ns, to_ns: stamps in the sensor's own clock [ns].
        aTb: pose of the sensor at ``to_ns`` in the sensor's frame at ``from_ns``.
        covariance: (6, 6) of aTb, [rot rad, trans m], right perturbation.
        ok: False where no motion could be estimated (aTb is then a prediction, covariance is large).
    """

    stored_apart: ClassVar[bool] = True

    from_ns: int
    to_ns: int
    aTb: gtsam.Pose3
    covariance: FloatArray
    ok: bool = True

    @property
    def seconds(self) -> float:
        """Length of the interval [s]."""
        return (self.to_ns - self.from_ns) * 1e-9

    @cached_property
    def mean_twist(self) -> FloatArray:
        """(6,) mean twist [rad/s, m/s] over the interval, in the sensor's own frame."""
        return np.asarray(gtsam.Pose3.Logmap(self.aTb)) / self.seconds
