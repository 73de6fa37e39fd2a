"""Drives in bags: frames in the order of the stamps, each with one sensor unless two have the same stamp."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.classes import MaskEncoding, guess_mask_encoding
from sst_graph.data.arrays import listed
from sst_graph.data.point_times import ScanTimes, clock_of_points
from sst_graph.data.rectified import RectifiedSource
from sst_graph.data.ros.bag import Bag, Topic
from sst_graph.data.ros.camera_info import ImageGeometry, geometry_by_file, has_matrix, image_geometry
from sst_graph.data.ros.clouds import cloud_of, field_names, times_of
from sst_graph.data.ros.frames import CloudReading, check_size, mask_classes, scan_of
from sst_graph.data.ros.images import mask_of, picture_of
from sst_graph.data.ros.index import BagIndex, Stamped, read_index
from sst_graph.data.ros.link_frame import LEAST_SEEN, LINK_AXES, is_link, may_be_link
from sst_graph.data.ros.moving_frame import check_moves_along
from sst_graph.data.ros.topics import Topics, choose_topics
from sst_graph.data.source import Loader, SourceOptions, Stamps
from sst_graph.data.two_clocks import DriveProperties, Sensor, merged
from sst_graph.errors import ConfigError, DataError, count_of, printable
from sst_graph.files.reading import path_of
from sst_graph.metrics import LINK_FROM_OPTICAL
from sst_graph.sampling import evenly_spread
from sst_graph.types import CameraImage, Scan, SemanticClass, Source

_LOG = logging.getLogger(__name__)

LAYOUT = "a bag: PATH.bag, PATH.mcap, PATH.db3, or a rosbag2 folder"

_SUFFIXES, _METADATA = (".bag", ".mcap", ".db3"), "metadata.yaml"
_CLOUDS_TO_JUDGE = 8
"""How many clouds, spread over the drive, are looked at until one shows the axes of the images' frame."""
_MASKS_TO_JUDGE = 8
"""How many masks, spread over the drive, decide on their encoding."""


@dataclass(frozen=True, eq=False)
class BagMessages:
    """Messages of a bag, read when asked for.

    Attributes:
        bag: where they are read.
        topics: they are read from.
        index: of them.
    """

    bag: Bag
    topics: Topics
    index: BagIndex

    def read(self, stamped: Stamped, topic: Topic) -> Any:
        """A message of a topic.

        Raises:
            DataError: the bag is damaged.
        """
        data = self.bag.read(stamped.message, self.topics.sensors, self.index.received_ns)
        return self.bag.decoded(data, topic.type)

    def place(self, stamped: Stamped) -> str:
        """What a fault of a message is reported at."""
        return f"{self.bag.path}, {stamped.message.topic} at {stamped.stamp_ns} ns"

    def picture(self, k: int) -> NDArray[np.uint8]:
        """Pixels of image k."""
        stamped, topic = self.index.images[k], self.topics.image
        return picture_of(self.read(stamped, topic), topic.type, self.place(stamped))

    def times(self, k: int, stamps: Stamps) -> ScanTimes | None:
        """Times of the points of scan k; stamps: which ones are those of the scans."""
        stamped = self.index.clouds[k]
        values = times_of(self.read(stamped, self.topics.cloud), self.place(stamped))
        if values is None:
            return None
        received_ns = stamped.message.received_ns
        # Tools that write bags anew may take the header's stamp for the time of recording, or round it.
        is_known = stamps == "received" or abs(received_ns - stamped.stamp_ns) > 1_000
        return ScanTimes(stamped.stamp_ns, values, received_ns if is_known else None)


@dataclass(frozen=True, eq=False)
class BagSensors:
    """Scans and images of a bag.

    Attributes:
        messages: that they are made of.
        size: width and height of the images [px].
        encoding: of the masks; None without masks.
        reading: of the clouds.
    """

    messages: BagMessages
    size: tuple[int, int]
    encoding: MaskEncoding | None
    reading: CloudReading

    def scan(self, k: int) -> Scan:
        """Scan k of the topic.

        Raises:
            DataError: the message holds what it must not, or the bag is damaged.
        """
        messages, stamped = self.messages, self.messages.index.clouds[k]
        message = messages.read(stamped, messages.topics.cloud)
        return scan_of(message, stamped.stamp_ns, messages.place(stamped), self.reading)

    def image(self, k: int) -> CameraImage:
        """Image k of the topic, with its mask; errors as of a scan."""
        stamped, pixels = self.messages.index.images[k], self.messages.picture(k)
        check_size(pixels, self.size, self.messages.place(stamped))
        return CameraImage(stamped.stamp_ns, self._mask(self._masks.get(stamped.stamp_ns)), pixels)

    @cached_property
    def _masks(self) -> dict[int, Stamped]:
        """By the stamps of their images."""
        return self.messages.index.masks_by_image()

    def _mask(self, stamped: Stamped | None) -> NDArray[np.uint8]:
        """Classes (h, w); where there is no mask every pixel may be anything."""
        messages, topic, encoding = self.messages, self.messages.topics.mask, self.encoding
        if stamped is None or topic is None or encoding is None:
            return np.full(self.size[::-1], SemanticClass.IGNORE, np.uint8)
        message, place = messages.read(stamped, topic), messages.place(stamped)
        return mask_classes(message, topic.type, encoding, self.size, place)


def is_ros(path: Path) -> bool:
    """Whether a path is a bag, or a folder of some."""
    if path.is_file():
        return path.suffix in _SUFFIXES
    return (path / _METADATA).is_file() or is_folder_of_bags(path)


def is_folder_of_bags(path: Path) -> bool:
    """Whether bags stand in a folder by themselves: one drive or several, nothing says it."""
    return path.is_dir() and not (path / _METADATA).is_file() and bool(_bag_files(path))


def _bag_files(path: Path) -> list[Path]:
    """Bags that are files of a folder."""
    return [entry for entry in listed(path, LAYOUT) if entry.suffix in _SUFFIXES and entry.is_file()]


def _only_bag(path: Path) -> Path:
    """The bag that a path names: itself, or the only file of a folder without metadata.yaml.

    Raises:
        DataError: no bag, or several files that nothing puts together.
    """
    if not is_ros(path):
        raise DataError(path, "no file or folder" if not path.exists() else "no bag", LAYOUT)
    if path.is_file() or (path / _METADATA).is_file():
        return path
    files = _bag_files(path)
    if len(files) > 1:
        some = ", ".join(file.name for file in files[:4]) + (", ..." if len(files) > 4 else "")
        joined = f"{_METADATA} beside them ('ros2 bag reindex' writes it)"
        if all(file.suffix == ".bag" for file in files):
            command = f"rosbags-convert --src {path}/*.bag --dst DRIVE"
            joined = f"one bag ({command!r} joins the parts of one drive)"
        expected = f"{joined}, or one of them as DATA"
        raise DataError(path, f"{count_of(len(files), 'bag')} ({some}) without {_METADATA}", expected)
    return files[0]


def open_ros(path: Path, options: SourceOptions) -> Source:
    """Open a bag: every message of its topics is read once for its stamp.

    Images of a lens that distorts are rectified as they are read.

    Raises:
        DataError: no bag, a damaged one, or no topics that fit; no calibrated camera; stamps that are zero or
            jump back.
        ConfigError: an option that means nothing for bags, or no such range of frames.
        MissingDependencyError: rosbags is not installed.
    """
    path = _only_bag(path)
    bag = Bag(path)
    topics = choose_topics(path, bag.topics, options)
    index = read_index(bag, topics, options.stamps)
    _check_masks(bag, index)
    of_frame = check_moves_along(
        index.cloud_frame, index.image_frame, index.transforms, f"{path}, {topics.cloud.name}"
    )
    messages = BagMessages(bag, topics, index)
    height, width = messages.picture(0).shape[:2]
    size = (width, height)
    geometry = _geometry(path, topics, index, size, options)
    fields = field_names(messages.read(index.clouds[0], topics.cloud))
    oTl, reason = _extrinsic(messages, geometry)
    nominal = None if oTl is None else geometry.extrinsic(oTl)
    if nominal is None:
        _LOG.info("%s: no nominal extrinsic: %s", printable(path), reason)
    times = partial(messages.times, stamps=options.stamps)
    clock, of_clock = clock_of_points(times, len(index.clouds), options)
    timing, has_labels = options.timing(_stamps(index.clouds)), topics.mask is not None
    reading = CloudReading(timing, options.sweep == "auto", has_labels, clock)
    sensors = BagSensors(messages, size, _encoding(messages, options), reading)
    notes = [f"camera model from {topics.info.name if topics.info else options.camera_file}"]
    notes.append(f"fields of the clouds: {', '.join(fields)}")
    if index.repeated:
        notes.append(f"left out {count_of(index.repeated, 'message')} with the stamp of another")
    if topics.info is not None and index.other_infos:
        others = count_of(index.other_infos, "CameraInfo", "CameraInfo")
        notes.append(f"{others} of {topics.info.name} of another camera than the first, whose model is taken")
        _LOG.warning("%s: %s", printable(path), notes[-1])
    model, name = geometry.model, printable(path.stem if path.is_file() else path.name)
    properties = DriveProperties(
        name,
        model.intrinsics,
        nominal,
        nominal_reason=reason,
        notes=tuple(notes),
        remarks=(of_clock,) * bool(of_clock),
        doubts=(of_frame,) * bool(of_frame),
    )
    scans = Sensor(_stamps(index.clouds), sensors.scan, _place_of(topics.cloud), topics.cloud.name)
    images = Sensor(_stamps(index.images), sensors.image, _place_of(topics.image), topics.image.name)
    drive = merged(properties, scans, images, options, path, scans_are_complete=True)
    return drive if model.is_pinhole else RectifiedSource(drive, Rectification.of(model))


def _place_of(topic: Topic) -> str:
    return f"{topic.name} ({topic.type})"


def _stamps(stamped: Sequence[Stamped]) -> NDArray[np.int64]:
    return np.array([one.stamp_ns for one in stamped], np.int64)


def _check_masks(bag: Bag, index: BagIndex) -> None:
    """A mask belongs to the image whose header has its stamp.

    Raises:
        DataError: none does.
    """
    if index.masks and not index.masks_by_image():
        first = index.masks[0]
        expected = f"the stamps of their images, such as {index.images[0].header_ns} ns"
        place = f"{bag.path}, {first.message.topic}"
        raise DataError(place, f"masks at other stamps, such as {first.header_ns} ns", expected)


def _geometry(
    path: Path, topics: Topics, index: BagIndex, size: tuple[int, int], options: SourceOptions
) -> ImageGeometry:
    """Geometry of the images: by the file that the options name, or by their CameraInfo."""
    if options.camera_file is not None:
        if options.info_topic is not None:
            raise ConfigError(f"--info-topic {options.info_topic}: means nothing with --camera-file")
        return geometry_by_file(path_of(options.camera_file, "a camera"), topics.image.name, size)
    assert topics.info is not None
    place = f"{path}, {topics.info.name}"
    if not has_matrix(index.info):
        expected = "a calibrated one, or its file (--camera-file)"
        raise DataError(place, "K = 0, an uncalibrated camera", expected)
    return image_geometry(index.info, topics.image.name, size, place)


def _extrinsic(messages: BagMessages, geometry: ImageGeometry) -> tuple[gtsam.Pose3 | None, str]:
    """Pose of the LiDAR in the optical axes of the camera by the transforms, or None, and why."""
    index, frame = messages.index, messages.index.image_frame
    oTl, reason = index.transforms.pose(frame, index.cloud_frame)
    if oTl is None or not may_be_link(frame, oTl):
        return oTl, reason
    for one in evenly_spread(index.clouds, _CLOUDS_TO_JUDGE):
        message = messages.read(one, messages.topics.cloud)
        points = cloud_of(message, one.stamp_ns, messages.place(one), times=False).points
        # A LiDAR that starts up sends clouds that are all but empty.
        if len(points) >= LEAST_SEEN:
            if is_link(frame, oTl, points, geometry.model):
                why = f"{frame!r} shows to be the camera's link ({LINK_AXES})"
                return LINK_FROM_OPTICAL.inverse() * oTl, f"{reason}; {why}"
            break
    return oTl, reason


def _encoding(messages: BagMessages, options: SourceOptions) -> MaskEncoding | None:
    mask = messages.topics.mask
    if mask is None:
        return None
    if options.label_encoding != "auto":
        return MaskEncoding(options.label_encoding)
    masks = (
        mask_of(messages.read(one, mask), mask.type, messages.place(one))
        for one in evenly_spread(messages.index.masks, _MASKS_TO_JUDGE)
    )
    return guess_mask_encoding(masks, f"{messages.bag.path}, {mask.name}")


ROS_LOADER = Loader(recognizes=is_ros, open=open_ros, layout=LAYOUT, unused=("sequence", "cloud"))
