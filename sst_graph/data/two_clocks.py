"""A drive whose camera and LiDAR stamp their data by clocks and at rates of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Generic, Self, TypeVar, overload

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.info.facts import SensorFacts, SourceFacts
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source import SourceOptions, Sweep
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.sweep_timing import SweepStamp
from sst_graph.timestamps import check_rising
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan
from sst_graph.validation import checked_position, checked_slice

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Sensor(Generic[T]):
    """What one sensor measured, read when asked for.

    Attributes:
        stamps_ns: (n,) in the sensor's own clock, rising strictly [ns].
        read: measurement k of n, stamped ``stamps_ns[k]``; DataError where its files cannot be used.
        place: where its data stand: a topic, a folder.
        topic: name of the topic; empty where it is none.
        instances: of images: instances (h, w) of image k, which whole frames show; None: there are none.
    """

    stamps_ns: NDArray[np.int64]
    read: Callable[[int], T]
    place: str = ""
    topic: str = ""
    instances: Callable[[int], NDArray[np.uint16] | None] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class DriveProperties:
    """What holds for every frame of a drive.

    Attributes:
        name: of the drive.
        camera: intrinsics.
        nominal: cTl that the data bring, or None.
        truth: what is known to be true, or None.
        truth_is_reference: the truth is a published calibration, not known to hold.
        sweep, sweep_stamp: as :class:`~sst_graph.data.source.SourceOptions` has them.
        nominal_reason: where the nominal extrinsic comes from, or why there is none.
        notes: sentences on what else was found.
        remarks: such that concern every result of the drive.
        doubts: what may be wrong with the data: reasons of a result that is not ok, behind causes that are
            found.
    """

    name: str
    camera: PinholeCamera
    nominal: gtsam.Pose3 | None = None
    truth: GroundTruth | None = None
    truth_is_reference: bool = False
    sweep: Sweep = "auto"
    sweep_stamp: SweepStamp = "forward"
    nominal_reason: str = ""
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class FramePositions:
    """Positions of a frame's scan and image among those of their sensors; one may be None."""

    scan: int | None
    image: int | None


@dataclass(frozen=True, eq=False)
class IndexedSource(ABC):
    """What sources of files and bags have in common: frames by their indices, and what holds for all of them.

    Attributes:
        properties: what holds for every frame.
        indices: of the frames, among those of the whole drive.
    """

    properties: DriveProperties
    indices: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.properties.name

    @property
    def camera(self) -> PinholeCamera:
        return self.properties.camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        return self.properties.nominal

    @property
    def truth(self) -> GroundTruth | None:
        return self.properties.truth

    @property
    def truth_is_reference(self) -> bool:
        """Whether the truth is a published calibration, not known to hold."""
        return self.properties.truth_is_reference

    @property
    def sweep(self) -> Sweep:
        """How the times of the points are found."""
        return self.properties.sweep

    @property
    def sweep_stamp(self) -> SweepStamp:
        """The instant that a scan's stamp names where times follow from azimuths."""
        return self.properties.sweep_stamp

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> Self: ...
    def __getitem__(self, position: int | slice) -> Frame | Self:
        """Frame at a position (read from disk), or the drive restricted to a slice of positions.

        Raises:
            DataError: a file of the frame is truncated, damaged or holds what it must not; neither a whole
                number nor a slice.
            IndexError: no frame at this position.
        """
        if isinstance(position, slice):
            return replace(self, indices=self.indices[checked_slice(position, len(self))])
        return self._frame(position)

    @abstractmethod
    def _frame(self, position: int) -> Frame:
        """Frame at a position; errors as of ``self[position]``."""

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def frame_number(self, position: int) -> int:
        """Index of the frame at a position; nothing is read."""
        return self._index(position)

    def _index(self, position: int) -> int:
        """Index of the frame at a position.

        Raises:
            DataError: no whole number.
            IndexError: no frame at this position.
        """
        return self.indices[checked_position(position, len(self), slices=True)]


@dataclass(frozen=True, eq=False)
class TwoClockSource(IndexedSource):
    """Frames in the order of their stamps (satisfies :class:`~sst_graph.types.Source`); a slice is one, too.

    A frame holds a scan or an image; both where their stamps are equal. Made by :func:`merged`. ``indices``
    are positions in ``places``.

    Attributes:
        scans, images: of the whole drive.
        places: scan and image of every frame of the whole drive.
    """

    scans: Sensor[Scan]
    images: Sensor[CameraImage]
    places: tuple[FramePositions, ...]

    @cached_property
    def scan_positions(self) -> list[int]:
        """Positions of the frames that have a scan."""
        return [k for k, index in enumerate(self.indices) if self.places[index].scan is not None]

    @cached_property
    def image_positions(self) -> list[int]:
        """Positions of the frames that have an image."""
        return [k for k, index in enumerate(self.indices) if self.places[index].image is not None]

    def _frame(self, position: int) -> Frame:
        image, of_image = self.read_image(position), self.places[self._index(position)].image
        if image is not None and of_image is not None and self.images.instances is not None:
            image = replace(image, instances=self.images.instances(of_image))
        return Frame(self._index(position), self.read_scan(position), image)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last frame."""
        return self._stamp_ns(0), self._stamp_ns(-1)

    def within(self, span_ns: tuple[int, int]) -> slice:
        """Positions of the frames whose stamps lie in a span, both ends included."""
        first, last = span_ns
        inside = [k for k in range(len(self)) if first <= self._stamp_ns(k) <= last]
        return slice(inside[0], inside[-1] + 1) if inside else slice(0, 0)

    def _stamp_ns(self, position: int) -> int:
        place = self.places[self.indices[position]]
        if place.scan is not None:
            return int(self.scans.stamps_ns[place.scan])
        assert place.image is not None
        return int(self.images.stamps_ns[place.image])

    def facts(self) -> SourceFacts:
        """Sensors and their stamps."""
        places = [self.places[index] for index in self.indices]
        scans = [place.scan for place in places if place.scan is not None]
        images = [place.image for place in places if place.image is not None]
        return SourceFacts(
            SensorFacts(self.scans.place, self.scans.stamps_ns[scans], self.scans.topic),
            SensorFacts(self.images.place, self.images.stamps_ns[images], self.images.topic),
            self.properties.nominal_reason,
            self.properties.notes,
            self.properties.remarks,
            self.properties.doubts,
        )

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position; errors as of the frame."""
        place = self.places[self._index(position)]
        return None if place.scan is None else self.scans.read(place.scan)

    def read_image(self, position: int) -> CameraImage | None:
        """Image of the frame at a position, without instances; errors as of the frame."""
        place = self.places[self._index(position)]
        return None if place.image is None else self.images.read(place.image)


def merged(
    properties: DriveProperties,
    scans: Sensor[Scan],
    images: Sensor[CameraImage],
    options: SourceOptions,
    folder: Path,
    scans_are_complete: bool = False,
) -> TwoClockSource:
    """The drive of a LiDAR and a camera.

    ``options.frames`` counts frames in the order of stamps. With ``options.image_shift`` image k is image
    k + shift, stamped as image k; the truth's time offset follows. Scans whose sweep ``options.sweep`` names
    get their points' times from azimuths, or none; scans without laser numbers those that the order of their
    points shows.

    Args:
        folder: named in errors.
        scans_are_complete: the reader of the scans has followed ``options.sweep`` and numbered the lasers.

    Raises:
        DataError: no scan or no image, or stamps of a sensor that do not rise strictly.
        ConfigError: frames that the drive has not, or that hold no scan or no image.
    """
    for what, sensor in (("scan", scans), ("image", images)):
        if not len(sensor):
            raise DataError(folder, f"no {what}", "scans and images")
        check_rising(sensor.stamps_ns, f"{folder} ({what}s)")
    if options.image_shift:
        images, seconds = _shifted(images, options.image_shift)
        truth = properties.truth
        if truth is not None and truth.time_offset_s is not None:
            truth = replace(truth, time_offset_s=truth.time_offset_s + seconds)
            properties = replace(properties, truth=truth)
    properties = replace(properties, sweep=options.sweep, sweep_stamp=options.sweep_stamp)
    if not scans_are_complete:
        scans = replace(scans, read=_completed(scans, options))
    places = _places(scans.stamps_ns, images.stamps_ns)
    return TwoClockSource(properties, _selected(places, options), scans, images, places)


def _completed(scans: Sensor[Scan], options: SourceOptions) -> Callable[[int], Scan]:
    """Reads scans with laser numbers, and with times of their points as the options want them."""
    timing, read = options.timing(scans.stamps_ns), scans.read

    def completed(k: int) -> Scan:
        scan = read(k)
        rings = rings_from_order(scan.points) if scan.rings is None else scan.rings
        offsets_s = scan.offsets_s if options.sweep == "auto" else None
        if timing is not None:
            offsets_s = timing.offsets_s(scan.points)
        return replace(scan, rings=rings, offsets_s=offsets_s)

    return completed


def _places(
    scan_stamps_ns: NDArray[np.int64], image_stamps_ns: NDArray[np.int64]
) -> tuple[FramePositions, ...]:
    """Scans and images in the order of their stamps, those of equal stamps together."""
    stamps = np.union1d(scan_stamps_ns, image_stamps_ns)
    scan_at = {int(stamp): k for k, stamp in enumerate(scan_stamps_ns)}
    image_at = {int(stamp): k for k, stamp in enumerate(image_stamps_ns)}
    return tuple(FramePositions(scan_at.get(stamp), image_at.get(stamp)) for stamp in stamps.tolist())


def _shifted(images: Sensor[CameraImage], shift: int) -> tuple[Sensor[CameraImage], float]:
    """Images ``shift`` later, stamped as those in whose place they stand, and by how much on average [s].

    Raises:
        ConfigError: no image is left.
    """
    count = len(images) - abs(shift)
    if count < 1:
        raise ConfigError(f"image shift {shift}: the drive has {count_of(len(images), 'image')}")
    first = max(0, -shift)
    stamps = images.stamps_ns[first : first + count]
    real = images.stamps_ns[first + shift : first + shift + count]
    shifted = _Shifted(images, first + shift, stamps)
    instances = None if images.instances is None else shifted.instances
    sensor = Sensor(stamps, shifted.read, images.place, images.topic, instances)
    return sensor, float(np.mean(real - stamps)) * 1e-9


@dataclass(frozen=True, eq=False)
class _Shifted:
    """Images from one on, under other stamps."""

    images: Sensor[CameraImage]
    first: int
    stamps_ns: NDArray[np.int64]

    def read(self, k: int) -> CameraImage:
        return replace(self.images.read(self.first + k), stamp_ns=int(self.stamps_ns[k]))

    def instances(self, k: int) -> NDArray[np.uint16] | None:
        return None if self.images.instances is None else self.images.instances(self.first + k)


def _selected(places: tuple[FramePositions, ...], options: SourceOptions) -> tuple[int, ...]:
    chosen = options.frames or slice(None)
    first, last = chosen.start or 0, len(places) if chosen.stop is None else chosen.stop
    if first >= len(places) or last > len(places):
        raise ConfigError(f"frames {first}:{last}: the drive has frames 0:{len(places)}")
    indices = tuple(range(first, last))
    for what, found in (
        ("scan", any(places[k].scan is not None for k in indices)),
        ("image", any(places[k].image is not None for k in indices)),
    ):
        if not found:
            raise ConfigError(f"frames {first}:{last}: no {what} among them")
    return indices
