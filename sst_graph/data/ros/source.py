"""Drives in bags: frames in the order of the stamps, each with one sensor unless two have the same stamp."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.classes import MaskEncoding, guess_mask_encoding
from sst_graph.data.arrays import listed
from sst_graph.data.point_times import PointClock, ScanTimes, clock_of_points
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
from sst_graph.data.source import Loader, SourceOptions
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
    """Scans and images of a bag, read when asked for.

    Attributes:
        bag: where messages are read.
        topics: they are read from.
        index: of the messages.
        size: width and height of the images [px].
        encoding: of the masks; None without masks.
        reading: of the clouds.
    """

    bag: Bag
    topics: Topics
    index: BagIndex
    size: tuple[int, int]
    encoding: MaskEncoding | None
    reading: CloudReading

    def scan(self, k: int) -> Scan:
        """Scan k of the topic.

        Raises:
            DataError: the message holds what it must not, or the bag is damaged.
        """
        stamped = self.index.clouds[k]
        message = self._message(stamped, self.topics.cloud.type)
        return scan_of(message, stamped.stamp_ns, _place(self.bag, stamped), self.reading)

    def image(self, k: int) -> CameraImage:
        """Image k of the topic, with the mask of its stamp; errors as of a scan."""
        stamped, topic = self.index.images[k], self.topics.image
        place = _place(self.bag, stamped)
        pixels = picture_of(self._message(stamped, topic.type), topic.type, place)
        check_size(pixels, self.size, place)
        return CameraImage(stamped.stamp_ns, self._mask(self._masks.get(stamped.stamp_ns)), pixels)

    @cached_property
    def _masks(self) -> dict[int, Stamped]:
        """By stamp."""
        return {one.stamp_ns: one for one in self.index.masks}

    def _mask(self, stamped: Stamped | None) -> NDArray[np.uint8]:
        """Classes (h, w); where there is no mask every pixel may be anything."""
        topic, encoding = self.topics.mask, self.encoding
        if stamped is None or topic is None or encoding is None:
            return np.full(self.size[::-1], SemanticClass.IGNORE, np.uint8)
        place = _place(self.bag, stamped)
        return mask_classes(self._message(stamped, topic.type), topic.type, encoding, self.size, place)

    def _message(self, stamped: Stamped, type_name: str) -> Any:
        return _read(self.bag, self.topics, self.index, stamped, type_name)


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
    size = _size(bag, topics, index)
    geometry = _geometry(path, topics, index, size, options)
    oTl, reason = _extrinsic(bag, topics, index, geometry)
    nominal = None if oTl is None else geometry.extrinsic(oTl)
    if nominal is None:
        _LOG.info("%s: no nominal extrinsic: %s", printable(path), reason)
    clock, of_clock = _clock(bag, topics, index, options)
    timing, has_labels = options.timing(_stamps(index.clouds)), topics.mask is not None
    reading = CloudReading(timing, options.sweep == "auto", has_labels, clock)
    encoding = _encoding(bag, topics, index, options)
    messages = BagMessages(bag, topics, index, size, encoding, reading)
    notes = [f"camera model from {topics.info.name if topics.info else options.camera_file}"]
    notes.append(f"fields of the clouds: {', '.join(_fields(bag, topics, index))}")
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
    scans = Sensor(_stamps(index.clouds), messages.scan, _place_of(topics.cloud), topics.cloud.name)
    images = Sensor(_stamps(index.images), messages.image, _place_of(topics.image), topics.image.name)
    drive = merged(properties, scans, images, options, path, scans_are_complete=True)
    return drive if model.is_pinhole else RectifiedSource(drive, Rectification.of(model))


def _place_of(topic: Topic) -> str:
    return f"{topic.name} ({topic.type})"


def _stamps(stamped: Sequence[Stamped]) -> NDArray[np.int64]:
    return np.array([one.stamp_ns for one in stamped], np.int64)


def _check_masks(bag: Bag, index: BagIndex) -> None:
    """A mask belongs to the image that has its stamp.

    Raises:
        DataError: none does.
    """
    if index.masks and not np.intersect1d(_stamps(index.masks), _stamps(index.images)).size:
        first = index.masks[0]
        expected = f"the stamps of their images, such as {index.images[0].stamp_ns} ns"
        place = f"{bag.path}, {first.message.topic}"
        raise DataError(place, f"masks at other stamps, such as {first.stamp_ns} ns", expected)


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


def _extrinsic(
    bag: Bag, topics: Topics, index: BagIndex, geometry: ImageGeometry
) -> tuple[gtsam.Pose3 | None, str]:
    """Pose of the LiDAR in the optical axes of the camera by the transforms, or None, and why."""
    oTl, reason = index.transforms.pose(index.image_frame, index.cloud_frame)
    frame = index.image_frame
    if oTl is None or not may_be_link(frame, oTl):
        return oTl, reason
    for place in evenly_spread(index.clouds, _CLOUDS_TO_JUDGE):
        message = _read(bag, topics, index, place, topics.cloud.type)
        points = cloud_of(message, place.stamp_ns, _place(bag, place), times=False).points
        # A LiDAR that starts up sends clouds that are all but empty.
        if len(points) >= LEAST_SEEN:
            if is_link(frame, oTl, points, geometry.model):
                why = f"{frame!r} shows to be the camera's link ({LINK_AXES})"
                return LINK_FROM_OPTICAL.inverse() * oTl, f"{reason}; {why}"
            break
    return oTl, reason


def _size(bag: Bag, topics: Topics, index: BagIndex) -> tuple[int, int]:
    """Width and height of the first image [px]."""
    first, type_name = index.images[0], topics.image.type
    height, width = picture_of(
        _read(bag, topics, index, first, type_name), type_name, _place(bag, first)
    ).shape[:2]
    return width, height


def _fields(bag: Bag, topics: Topics, index: BagIndex) -> tuple[str, ...]:
    """Names of what the first cloud holds for each point."""
    return field_names(_read(bag, topics, index, index.clouds[0], topics.cloud.type))


def _clock(
    bag: Bag, topics: Topics, index: BagIndex, options: SourceOptions
) -> tuple[PointClock | None, str]:
    """The clock of the points' times, where it is not that of the stamps, and a sentence on it."""
    if options.sweep != "auto":
        return None, ""

    def read(k: int) -> ScanTimes | None:
        first = index.clouds[k]
        try:
            message = _read(bag, topics, index, first, topics.cloud.type)
            values = times_of(message, _place(bag, first))
        except DataError:  # which the scan will raise when it is read
            return None
        if values is None:
            return None
        received_ns = first.message.received_ns
        # Tools that write bags anew may take the header's stamp for the time of recording, or round it.
        is_known = options.stamps == "received" or abs(received_ns - first.stamp_ns) > 1_000
        return ScanTimes(first.stamp_ns, values, received_ns if is_known else None)

    return clock_of_points(read, len(index.clouds), options.sweep_stamp)


def _encoding(bag: Bag, topics: Topics, index: BagIndex, options: SourceOptions) -> MaskEncoding | None:
    mask = topics.mask
    if mask is None:
        return None
    if options.label_encoding != "auto":
        return MaskEncoding(options.label_encoding)
    masks = (
        mask_of(_read(bag, topics, index, place, mask.type), mask.type, _place(bag, place))
        for place in evenly_spread(index.masks, _MASKS_TO_JUDGE)
    )
    return guess_mask_encoding(masks, f"{bag.path}, {mask.name}")


def _read(bag: Bag, topics: Topics, index: BagIndex, place: Stamped, type_name: str) -> Any:
    data = bag.read(place.message, topics.sensors, index.received_ns)
    return bag.decoded(data, type_name)


def _place(bag: Bag, place: Stamped) -> str:
    return f"{bag.path}, {place.message.topic} at {place.stamp_ns} ns"


ROS_LOADER = Loader(recognizes=is_ros, open=open_ros, layout=LAYOUT, unused=("sequence", "cloud"))
