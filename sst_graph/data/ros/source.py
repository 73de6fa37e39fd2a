"""Drives in bags: frames in the order of the stamps, each with one sensor unless two have the same stamp."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, overload

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.classes import MaskEncoding, classes_of_mask, classes_of_points, guess_mask_encoding
from sst_graph.data.info.facts import SensorFacts, SourceFacts
from sst_graph.data.rectified import RectifiedSource
from sst_graph.data.ros.bag import Bag
from sst_graph.data.ros.camera_info import ImageGeometry, image_geometry
from sst_graph.data.ros.clouds import Cloud, cloud_of
from sst_graph.data.ros.images import mask_of, picture_of
from sst_graph.data.ros.index import BagIndex, Stamped, read_index
from sst_graph.data.ros.topics import Topics, choose_topics
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source import TURNS, Loader, SourceOptions, Sweep
from sst_graph.errors import ConfigError, DataError, printable
from sst_graph.factors.camera import PinholeCamera
from sst_graph.sweep_timing import SweepStamp, SweepTiming
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, SemanticClass, Source

_LOG = logging.getLogger(__name__)

LAYOUT = "a bag: PATH.bag (ROS 1), PATH.mcap, PATH.db3, or a rosbag2 folder with metadata.yaml"

_SUFFIXES = (".bag", ".mcap", ".db3")
_MASKS_TO_JUDGE = 8
"""How many masks, spread over the drive, decide on their encoding."""


class FramePlaces(NamedTuple):
    """Where the parts of a frame stand; None where it has none."""

    scan: Stamped | None
    image: Stamped | None
    mask: Stamped | None


@dataclass(frozen=True, eq=False)
class RosDrive:
    """What holds for every frame of a drive.

    Attributes:
        bag: where messages are read.
        topics: they are read from.
        index: of the messages.
        model: of the camera.
        nominal: cTl by the transforms, or None; ``nominal_reason`` says why.
        encoding: of the masks; None without masks.
        timing: times of the points by azimuth, where the options name a sense of rotation.
    """

    bag: Bag
    topics: Topics
    index: BagIndex
    model: ImageGeometry
    nominal: gtsam.Pose3 | None
    nominal_reason: str
    encoding: MaskEncoding | None
    timing: SweepTiming | None


@dataclass(frozen=True, eq=False)
class RosSource:
    """A drive in a bag that satisfies :class:`~sst_graph.types.Source`; a slice of it is one as well.

    Made by :func:`open_ros`. Frames are read from the bag when they are asked for.

    Attributes:
        name: of the file or folder, without suffix.
        drive: what holds for every frame.
        frames: where the parts of each frame stand.
        first: index of the first frame.
        options: how the drive is read.
    """

    name: str
    drive: RosDrive
    frames: tuple[FramePlaces, ...]
    first: int
    options: SourceOptions

    @property
    def camera(self) -> PinholeCamera:
        return self.drive.model.camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        return self.drive.nominal

    @property
    def truth(self) -> GroundTruth | None:
        return None

    @property
    def sweep(self) -> Sweep:
        """How the times of the points are found."""
        return self.options.sweep

    @property
    def sweep_stamp(self) -> SweepStamp:
        """The instant that a scan's stamp names where times follow from azimuths."""
        return self.options.sweep_stamp

    @cached_property
    def scan_positions(self) -> tuple[int, ...]:
        """Positions of the frames that have a scan."""
        return tuple(k for k, frame in enumerate(self.frames) if frame.scan is not None)

    @cached_property
    def image_positions(self) -> tuple[int, ...]:
        """Positions of the frames that have an image."""
        return tuple(k for k, frame in enumerate(self.frames) if frame.image is not None)

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> RosSource: ...
    def __getitem__(self, position: int | slice) -> Frame | RosSource:
        """Frame at a position (read from the bag), or the drive restricted to a slice of positions, step 1.

        Raises:
            DataError: a message holds what it must not, or the bag is damaged.
            IndexError: no frame at this position.
        """
        if isinstance(position, slice):
            start, stop, step = position.indices(len(self))
            if step != 1:
                raise ConfigError(f"frames with step {step}: expected consecutive ones")
            return replace(self, frames=self.frames[start:stop], first=self.first + start)
        return Frame(self.frame_number(position), self.read_scan(position), self.read_image(position))

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def frame_number(self, position: int) -> int:
        """Index of the frame at a position; nothing is read."""
        return self.first + range(len(self))[position]

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position; errors as of the frame."""
        place = self.frames[position].scan
        return None if place is None else self._scan(place)

    def read_image(self, position: int) -> CameraImage | None:
        """Image of the frame at a position; errors as of the frame."""
        frame = self.frames[position]
        return None if frame.image is None else self._image(frame.image, frame.mask)

    def facts(self) -> SourceFacts:
        """Topics and stamps."""
        topics = self.drive.topics
        images, scans = (
            np.array([one.stamp_ns for one in places if one is not None], np.int64)
            for places in ([f.image for f in self.frames], [f.scan for f in self.frames])
        )
        notes = [f"camera model from {topics.info.name}"]
        if self.drive.index.repeated:
            notes.append(f"{self.drive.index.repeated} messages with the stamp of another were left out")
        return SourceFacts(
            image=SensorFacts(f"{topics.image.name} ({topics.image.type})", images),
            scan=SensorFacts(f"{topics.cloud.name} ({topics.cloud.type})", scans),
            nominal=self.drive.nominal_reason,
            notes=tuple(notes),
        )

    def _scan(self, place: Stamped) -> Scan:
        cloud = self._cloud(place)
        count = len(cloud.points)
        classes, instances = np.full(count, SemanticClass.IGNORE, np.uint8), np.zeros(count, np.uint16)
        if cloud.labels is not None:
            classes, instances = classes_of_points(cloud.labels, self._place(place))
        offsets_s = cloud.offsets_s
        if self.drive.timing is not None:
            offsets_s = self.drive.timing.offsets_s(cloud.points)
        rings = rings_from_order(cloud.points) if cloud.rings is None else cloud.rings
        return Scan(place.stamp_ns, cloud.points, classes, instances, offsets_s, rings, cloud.left_out)

    def _cloud(self, place: Stamped) -> Cloud:
        times, labels = self.sweep == "auto", self.drive.topics.mask is not None
        message = self._message(place, self.drive.topics.cloud.type)
        return cloud_of(message, place.stamp_ns, self._place(place), times, labels)

    def _image(self, place: Stamped, mask: Stamped | None) -> CameraImage:
        topic = self.drive.topics.image
        pixels = picture_of(self._message(place, topic.type), topic.type, self._place(place))
        _check_size(pixels, self.camera, self._place(place))
        return CameraImage(place.stamp_ns, self._mask(mask), pixels)

    def _mask(self, place: Stamped | None) -> NDArray[np.uint8]:
        """Classes (h, w); where there is no mask every pixel may be anything."""
        topic, encoding = self.drive.topics.mask, self.drive.encoding
        if place is None or topic is None or encoding is None:
            return np.full((self.camera.height, self.camera.width), SemanticClass.IGNORE, np.uint8)
        numbers = mask_of(self._message(place, topic.type), topic.type, self._place(place))
        _check_size(numbers, self.camera, self._place(place))
        return classes_of_mask(numbers, encoding, self._place(place))

    def _message(self, place: Stamped, type_name: str) -> Any:
        return _read(self.drive.bag, self.drive.topics, self.drive.index, place, type_name)

    def _place(self, place: Stamped) -> str:
        return _place(self.drive.bag, place)


def is_ros(path: Path) -> bool:
    """Whether a path is a bag."""
    return path.suffix in _SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()


def open_ros(path: Path, options: SourceOptions) -> Source:
    """Open a bag: every message of its topics is read once for its stamp.

    Images of a lens that distorts are rectified as they are read.

    Raises:
        DataError: no bag, a damaged one, or no topics that fit; no calibrated camera; stamps that are zero or
            jump back.
        ConfigError: an option that means nothing for bags, or no such range of frames.
        MissingDependencyError: rosbags is not installed.
    """
    if not is_ros(path):
        raise DataError(path, "no file or folder" if not path.exists() else "no bag", LAYOUT)
    bag = Bag(path)
    topics = choose_topics(path, bag.topics, options)
    index = read_index(bag, topics, options.stamps)
    frames = _frames(index)
    chosen = options.frames or slice(None)
    first, last = chosen.start or 0, len(frames) if chosen.stop is None else chosen.stop
    if first >= len(frames) or last > len(frames):
        raise ConfigError(f"frames {first}:{last}: the drive has frames 0:{len(frames)}, of one sensor each")
    size = _size(bag, topics, index)
    model = image_geometry(index.info, topics.image.name, size, f"{path}, {topics.info.name}")
    oTl, reason = index.transforms.pose(index.image_frame, index.cloud_frame)
    nominal = None if oTl is None else gtsam.Pose3(model.cRo, np.zeros(3)) * oTl
    drive = RosDrive(
        bag,
        topics,
        index,
        model,
        nominal,
        reason,
        _encoding(bag, topics, index, options),
        _timing(options, index),
    )
    if nominal is None:
        _LOG.info("%s: no nominal extrinsic: %s", printable(path), reason)
    name = printable(path.stem if path.is_file() else path.name)
    source = RosSource(name, drive, frames, 0, options)[first:last]
    return source if model.lens is None else RectifiedSource(source, Rectification.of(model.lens))


def _frames(index: BagIndex) -> tuple[FramePlaces, ...]:
    """Scans and images by their stamps; a mask belongs to the image that has its stamp."""
    scans, images, masks = (
        {one.stamp_ns: one for one in stamped} for stamped in (index.clouds, index.images, index.masks)
    )
    if masks and not masks.keys() & images.keys():
        first = index.masks[0]
        expected = f"the stamps of their images, such as {index.images[0].stamp_ns} ns"
        raise DataError(first.message.topic, f"masks at other stamps, such as {first.stamp_ns} ns", expected)
    return tuple(
        FramePlaces(scans.get(stamp), images.get(stamp), masks.get(stamp))
        for stamp in sorted(scans.keys() | images.keys())
    )


def _size(bag: Bag, topics: Topics, index: BagIndex) -> tuple[int, int]:
    """Width and height of the first image [px]."""
    first, type_name = index.images[0], topics.image.type
    height, width = picture_of(
        _read(bag, topics, index, first, type_name), type_name, _place(bag, first)
    ).shape[:2]
    return width, height


def _encoding(bag: Bag, topics: Topics, index: BagIndex, options: SourceOptions) -> MaskEncoding | None:
    mask = topics.mask
    if mask is None:
        return None
    if options.label_encoding != "auto":
        return MaskEncoding(options.label_encoding)
    chosen = np.unique(np.linspace(0, len(index.masks) - 1, _MASKS_TO_JUDGE).round().astype(int))
    masks = (
        mask_of(_read(bag, topics, index, place, mask.type), mask.type, _place(bag, place))
        for place in (index.masks[k] for k in chosen)
    )
    return guess_mask_encoding(masks, f"{bag.path}, {mask.name}")


def _timing(options: SourceOptions, index: BagIndex) -> SweepTiming | None:
    """Times by azimuth where the options name a sense of rotation."""
    if options.sweep not in TURNS:
        return None
    if len(index.clouds) < 2:
        raise ConfigError(f"sweep {options.sweep!r}: the period of a turn needs two scans or more")
    period_s = float(np.median(np.diff([one.stamp_ns for one in index.clouds]))) * 1e-9
    start_rad = float(np.radians(options.sweep_start_deg))
    return SweepTiming(TURNS[options.sweep], start_rad, period_s, options.sweep_stamp)


def _read(bag: Bag, topics: Topics, index: BagIndex, place: Stamped, type_name: str) -> Any:
    data = bag.read(place.message, topics.sensors, index.received_ns)
    return bag.decoded(data, type_name)


def _check_size(array: NDArray[np.uint8], camera: PinholeCamera, place: str) -> None:
    if array.shape[:2] != (camera.height, camera.width):
        expected = f"{camera.width}x{camera.height} px, as the first image"
        raise DataError(place, f"{array.shape[1]}x{array.shape[0]} px", expected)


def _place(bag: Bag, place: Stamped) -> str:
    return f"{bag.path}, {place.message.topic} at {place.stamp_ns} ns"


ROS_LOADER = Loader(
    recognizes=is_ros, open=open_ros, layout=LAYOUT, unused=("sequence", "cloud", "image_shift")
)
