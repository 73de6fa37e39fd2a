"""One pass over a bag: where each scan, image and mask stands, with its stamp; model and transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.ros.bag import Bag, Message
from sst_graph.data.ros.camera_info import has_matrix, is_other_camera
from sst_graph.data.ros.topics import Topics
from sst_graph.data.ros.transforms import Transforms
from sst_graph.data.source import Stamps
from sst_graph.errors import DataError, count_of

_STEP_BACK_NS = 1_000_000_000
"""Messages of one sensor arrive out of order by less than this; beyond it the clock was set back [ns]."""


@dataclass(frozen=True)
class Stamped:
    """A message.

    Attributes:
        stamp_ns: its stamp in the drive [ns].
        message: where it stands.
        header_ns: the stamp of its header [ns].
    """

    stamp_ns: int
    message: Message
    header_ns: int


@dataclass(frozen=True)
class BagIndex:
    """What a drive's bag holds.

    Attributes:
        images, clouds, masks: of the camera and the LiDAR, stamps rising.
        image_frame, cloud_frame: names of their coordinate frames.
        info: the first CameraInfo of a calibrated camera; the first where there is none; None where there is
            no topic of them.
        other_infos: how many CameraInfo describe another camera than it.
        transforms: of all TFMessages.
        repeated: messages left out because their stamp is that of another of the same topic.
        received_ns: (n,) times of all messages of the sensors, rising.
    """

    images: tuple[Stamped, ...]
    clouds: tuple[Stamped, ...]
    masks: tuple[Stamped, ...]
    image_frame: str
    cloud_frame: str
    info: Any
    other_infos: int
    transforms: Transforms
    repeated: int
    received_ns: NDArray[np.int64]

    def masks_by_image(self) -> dict[int, Stamped]:
        """Masks by the stamps of their images, whose headers are stamped alike; where none is, as of drivers
        that leave the stamp at zero, by the stamps in the drive.
        """
        by_header = {one.header_ns: one for one in reversed(self.masks) if one.header_ns}
        found = {one.stamp_ns: by_header[one.header_ns] for one in self.images if one.header_ns in by_header}
        if found:
            return found
        by_stamp = {one.stamp_ns: one for one in self.masks}
        return {one.stamp_ns: by_stamp[one.stamp_ns] for one in self.images if one.stamp_ns in by_stamp}


@dataclass
class _Sensor:
    frame: str = ""
    stamped: list[Stamped] = field(default_factory=list)


def read_index(bag: Bag, topics: Topics, stamps: Stamps) -> BagIndex:
    """Read every message of the drive's topics once; of images and clouds only the headers are kept.

    Raises:
        DataError: a damaged bag; stamps that are zero or jump back.
    """
    sensors = {name: _Sensor() for name in topics.sensors}
    received: list[int] = []
    models, transforms = _CameraInfos(), Transforms()
    types = bag.topics
    infos = [] if topics.info is None else [topics.info.name]
    for message, data in bag.messages([*topics.sensors, *infos, *topics.transforms]):
        if message.topic in sensors:
            header_ns, frame = bag.header(data)
            sensor = sensors[message.topic]
            sensor.frame = sensor.frame or frame
            stamp_ns = message.received_ns if stamps == "received" else header_ns
            sensor.stamped.append(Stamped(stamp_ns, message, header_ns))
            received.append(message.received_ns)
        elif message.topic in topics.transforms:
            transforms.add(bag.decoded(data, types[message.topic].type))
        else:
            models.add(bag, data, types[message.topic].type)
    rising = {name: _rising(bag, name, sensor.stamped) for name, sensor in sensors.items()}
    masks = () if topics.mask is None else rising[topics.mask.name]
    return BagIndex(
        images=rising[topics.image.name],
        clouds=rising[topics.cloud.name],
        masks=masks,
        image_frame=sensors[topics.image.name].frame,
        cloud_frame=sensors[topics.cloud.name].frame,
        info=models.first,
        other_infos=models.others,
        transforms=transforms,
        repeated=sum(len(sensors[name].stamped) - len(rising[name]) for name in sensors),
        received_ns=np.sort(np.array(received, np.int64)),
    )


@dataclass
class _CameraInfos:
    """The CameraInfo messages of a bag, of which equal ones are decoded once."""

    first: Any = None
    others: int = 0
    _bytes: bytes = b""

    def add(self, bag: Bag, data: bytes, type_name: str) -> None:
        """Take a message."""
        content = bag.without_header(data)
        if self.first is None or not has_matrix(self.first):
            self.first, self._bytes, self.others = bag.decoded(data, type_name), content, 0
        elif content != self._bytes:
            message = bag.decoded(data, type_name)
            self.others += has_matrix(message) and is_other_camera(self.first, message)


def _rising(bag: Bag, topic: str, stamped: list[Stamped]) -> tuple[Stamped, ...]:
    """Messages by their stamps, each stamp once."""
    place = f"{bag.path}, {topic}"
    if not stamped:
        raise DataError(place, "no message", "some")
    stamps = np.array([one.stamp_ns for one in stamped], np.int64)
    if zeros := int((stamps == 0).sum()):
        expected = "stamps of the sensor's driver (--stamps received takes the times of recording)"
        raise DataError(place, f"{zeros} of {count_of(len(stamps), 'message')} with stamp 0", expected)
    steps = np.diff(stamps)
    if len(steps) and int(steps.min()) < -_STEP_BACK_NS:
        k = int(np.argmin(steps))
        found = f"stamps that jump back by {-int(steps[k]) * 1e-9:.3f} s at message {k + 1}"
        raise DataError(place, found, "stamps of one clock that rises")
    ordered = {one.stamp_ns: one for one in reversed(stamped)}
    return tuple(ordered[stamp] for stamp in sorted(ordered))
