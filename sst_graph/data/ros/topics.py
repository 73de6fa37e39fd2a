"""Which topics of a bag hold the image, the cloud, the camera's model, the masks and the transforms."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from sst_graph.data.ros.bag import TF_MESSAGE, Topic
from sst_graph.data.ros.livox import CUSTOM
from sst_graph.data.source import SourceOptions
from sst_graph.errors import DataError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"

_LISTED = 12
"""Topics that an error lists at most."""
_DEPTH = re.compile(r"/(depth|depth_registered|aligned_depth_to_\w+|disparity)(/|$)")
"""In the name of a topic of images: depths, as RGB-D cameras publish them beside their colours."""
_MASK_WORDS = ("mask", "label", "semantic", "segment")
"""In the name of a topic of images: these may be masks of labels."""


@dataclass(frozen=True)
class Topics:
    """Topics that a drive is read from.

    Attributes:
        image, cloud: of the camera and the LiDAR.
        info: of the camera's model; None where a file has it.
        mask: of the semantic masks, or None.
        transforms: names of those with TFMessage.
    """

    image: Topic
    cloud: Topic
    info: Topic | None
    mask: Topic | None
    transforms: tuple[str, ...]

    @property
    def sensors(self) -> frozenset[str]:
        """Names of the topics that frames are read from."""
        return frozenset(one.name for one in (self.image, self.cloud, self.mask) if one is not None)


def choose_topics(path: Path, topics: Mapping[str, Topic], options: SourceOptions) -> Topics:
    """The topics that the options name; where they name none, the only one of its type.

    The model of a camera is that beside its images: "/camera/camera_info" for "/camera/image_raw"; a topic of
    masks whose name does not begin with "/" stands there as well. Of images with a compressed copy the plain
    ones are taken, and of those of an RGB-D camera the colours.

    Raises:
        DataError: none or several fit; the topics of the bag are listed.
    """
    filled = {name: topic for name, topic in topics.items() if topic.count}
    kinds, named, mask = (IMAGE, COMPRESSED), options.mask_topic, None
    images = {
        n: t for n, t in filled.items() if named is None or (n.rpartition("/")[2] != named and n != named)
    }
    image = _image(path, images, options, kinds)
    if named is not None:
        name = named if named.startswith("/") else f"{_namespace(image.name)}/{named}"
        mask = _named(path, filled, name, kinds, "--mask-topic")
    return Topics(
        image=image,
        cloud=_one(path, filled, options.cloud_topic, "--cloud-topic", (CLOUD, CUSTOM)),
        info=None if options.camera_file is not None else _info(path, filled, options.info_topic, image),
        mask=mask,
        transforms=tuple(name for name, topic in filled.items() if topic.type == TF_MESSAGE),
    )


def _image(path: Path, images: Mapping[str, Topic], options: SourceOptions, types: tuple[str, ...]) -> Topic:
    """The images that the options name by their topic, or by the camera: a topic, or its namespace."""
    camera = options.camera
    if options.image_topic is not None or camera == SourceOptions().camera:
        return _one(path, images, options.image_topic, "--image-topic", types)
    inside = {n: t for n, t in images.items() if _namespace(n) == "/" + camera.strip("/")}
    if camera in images or not inside:
        return _named(path, images, camera, types, "--camera")
    return _one(path, inside, None, "--camera", types)


def _one(
    path: Path, topics: Mapping[str, Topic], name: str | None, option: str, types: tuple[str, ...]
) -> Topic:
    if name is not None:
        return _named(path, topics, name, types, option)
    fitting = [topic for topic in topics.values() if topic.type in types]
    plain = {topic.name for topic in fitting if topic.type == IMAGE}
    fitting = [
        topic for topic in fitting if topic.name.removesuffix("/compressed") not in plain - {topic.name}
    ]
    fitting = [topic for topic in fitting if not topic.name.endswith("/compressedDepth")]
    fitting = [topic for topic in fitting if not _DEPTH.search(topic.name)] or fitting
    if len(fitting) == 1:
        return fitting[0]
    what = " or ".join(types)
    if not fitting:
        raise DataError(path, f"no topic of {what} among {listed(topics.values())}", "one")
    masks = [topic.name for topic in fitting if any(word in topic.name for word in _MASK_WORDS)]
    hint = "; several cameras by --camera" if option == "--image-topic" else ""
    hint = f"; of masks by --mask-topic {masks[0]}" if masks else hint
    raise DataError(path, f"several topics of {what}: {listed(fitting)}", f"one, named by {option}{hint}")


def _info(path: Path, topics: Mapping[str, Topic], name: str | None, image: Topic) -> Topic:
    if name is None:
        beside = topics.get(_namespace(image.name) + "/camera_info")
        if beside is not None and beside.type == INFO:
            return beside
    if name is None and not any(topic.type == INFO for topic in topics.values()):
        found = f"no topic of {INFO} among {listed(topics.values())}"
        raise DataError(path, found, "one, or the camera in a file (--camera-file)")
    return _one(path, topics, name, "--info-topic", (INFO,))


def _namespace(image: str) -> str:
    """Namespace of a camera by the name of its images: "/front" of "/front/image_raw/compressed"."""
    return image.removesuffix("/compressed").rpartition("/")[0]


def _named(path: Path, topics: Mapping[str, Topic], name: str, types: tuple[str, ...], option: str) -> Topic:
    topic = topics.get(name)
    if topic is None:
        raise DataError(
            path, f"no message of {name} ({option}); there are {listed(topics.values())}", "a topic"
        )
    if topic.type not in types:
        raise DataError(path, f"{option} {name} of {topic.type}", " or ".join(types))
    return topic


def listed(topics: Iterable[Topic]) -> str:
    """Topics with type and number of messages, in one line."""
    ordered = list(topics)
    words = [f"{one.name} ({one.type.replace('/msg/', '/')}, {one.count})" for one in ordered[:_LISTED]]
    more = len(ordered) - _LISTED
    return ", ".join(words + [f"and {more} more"] * (more > 0)) or "no topic with messages"
