"""The tracker fed with ROS messages; what it publishes comes back as messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.classes import MaskEncoding
from sst_graph.data.lidar_pose import TimingFromCloud, in_lidar_axes, parse_lidar_pose
from sst_graph.data.point_times import StreamClock
from sst_graph.data.ros.bag import TF_MESSAGE
from sst_graph.data.ros.camera_info import (
    ImageGeometry,
    has_matrix,
    image_geometry,
    is_other_camera,
)
from sst_graph.data.ros.clouds import cloud_of, times_of
from sst_graph.data.ros.frames import CloudReading, check_size, mask_classes, scan_of
from sst_graph.data.ros.images import picture_of
from sst_graph.data.ros.link_frame import LEAST_SEEN, LINK_AXES, is_link
from sst_graph.data.ros.topics import CLOUD, COMPRESSED, IMAGE, INFO
from sst_graph.data.ros.transforms import Transforms
from sst_graph.data.source import TURNS
from sst_graph.errors import DataError, count_of
from sst_graph.metrics import LINK_FROM_OPTICAL
from sst_graph.reference import load_initial
from sst_graph.ros_node.published import OK, WARN, Diagnosis, NodeMessages, Published, diagnosis_of
from sst_graph.ros_node.sensor import SensorRecord
from sst_graph.ros_node.settings import INIT_NONE, INIT_TF, NodeSettings
from sst_graph.ros_node.stamp_queue import StampQueue, Waiting
from sst_graph.sweep_timing import SweepTiming
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.tracker.tracker import Tracker
from sst_graph.types import CameraImage, Frame, SemanticClass

_BEHIND_S = 1.0
"""A node whose messages wait longer to be taken is behind."""


class CalibrationNode:
    """Takes messages as rosbags decodes them, in the order in which they come; never raises for one.

    Each method gives what is to be published. ``now_ns`` is the node's clock [ns].

    Attributes:
        camera, lidar, masks, info, transforms: what came of each sensor, and on the topics beside them.
        tracker: None until camera, first image and start are known.
        update: the tracker's last.
    """

    def __init__(
        self, settings: NodeSettings, config: TrackerConfig | None = None, name: str = "sst_graph"
    ) -> None:
        """
        Args:
            settings: topics by the names that they have in the graph of ROS.
            config: of the tracker.
            name: of the node, with which the names of its diagnostics begin.

        Raises:
            ConfigError, DataError: a parameter that cannot be used.
        """
        self.settings, self._config = settings, config or TrackerConfig()
        self._encoding = MaskEncoding(settings.label_encoding)
        self._reading = _reading(settings)
        self._point_clock = StreamClock(settings.sweep_stamp)
        # None where the clouds are in the LiDAR's axes.
        self._T_cloud_lidar = parse_lidar_pose(settings.lidar_pose) if settings.lidar_pose else None
        given = settings.init not in (INIT_TF, INIT_NONE)
        # A node has one camera, whose name in the data that the file was made of is another matter.
        self._given = load_initial(Path(settings.init), None) if given else None
        self.camera = SensorRecord("camera", settings.image_topic, image_type(settings.image_topic))
        self.lidar = SensorRecord("lidar", settings.cloud_topic, CLOUD)
        self.masks = SensorRecord("masks", settings.mask_topic, image_type(settings.mask_topic))
        self.info = SensorRecord("camera_info", settings.info_topic, INFO)
        self.transforms = SensorRecord("transforms", "/tf_static", TF_MESSAGE)
        self.tracker: Tracker | None = None
        self.update: TrackUpdate | None = None
        self._make = NodeMessages(name)
        self._queue = StampQueue(settings.hold_s, settings.queue)
        self._halves: dict[int, dict[str, tuple[Any, str]]] = {}
        self._unpaired = 0
        self._info: Any = None
        self._other_infos = 0
        self._geometry: ImageGeometry | None = None
        self._rectification: Rectification | None = None
        self._images_in_link = False
        self._transforms = Transforms()
        self._waiting_for = self._told = ""

    @property
    def topics(self) -> dict[str, SensorRecord]:
        """What is listened to, by the part that it has here: image, mask, cloud, info, transforms."""
        found = {"image": self.camera, "cloud": self.lidar, "info": self.info, "transforms": self.transforms}
        return found | ({"mask": self.masks} if self.settings.mask_topic else {})

    @property
    def state(self) -> str:
        """The tracker's status; what the node waits for, where there is none yet."""
        if self.update is not None:
            return self.update.status
        return self.info.error or self.info.missing if self._info is None else self._waiting_for

    def news(self) -> str:
        """The state and its reason where the state has changed since the last call, else ''; for the log."""
        if self.state == self._told:
            return ""
        self._told = self.state
        return self.state if self.update is None else diagnosis_of(self.update).message

    # ------------------------------------------------------------------ messages

    def add_bytes(self, part: str, data: bytes, now_ns: int) -> list[Published]:
        """A message as it comes from the network; ``part`` is a key of :attr:`topics`."""
        sensor = self.topics[part]
        try:
            message = self._make.decoded(data, sensor.type_name)
        except Exception as error:
            sensor.received += 1
            sensor.last_ns = now_ns
            sensor.refuse(
                f"{sensor.topic}: found no {sensor.type_name} in {count_of(len(data), 'byte')}: {error}",
                now_ns,
            )
            return []
        match part:
            case "image":
                return self.add_image(message, now_ns, sensor.type_name)
            case "mask":
                return self.add_mask(message, now_ns, sensor.type_name)
            case "cloud":
                return self.add_cloud(message, now_ns)
            case "info":
                self.add_info(message, now_ns)
            case _:
                self.add_transforms(message, now_ns)
        return []

    def add_image(self, message: Any, now_ns: int, type_name: str = IMAGE) -> list[Published]:
        """An Image or CompressedImage."""

        def take() -> None:
            stamp_ns = self._stamp_ns(message, self.camera)
            if not self.settings.mask_topic:
                self._queue.add(stamp_ns, False, {"image": (message, type_name)})
            else:
                self._add_half(stamp_ns, "image", message, type_name)

        return self._received(self.camera, now_ns, take)

    def add_mask(self, message: Any, now_ns: int, type_name: str = IMAGE) -> list[Published]:
        """A mask with the stamp of its image."""

        def take() -> None:
            self._add_half(self._stamp_ns(message, self.masks), "mask", message, type_name)

        return self._received(self.masks, now_ns, take)

    def add_cloud(self, message: Any, now_ns: int) -> list[Published]:
        """A PointCloud2."""

        def take() -> None:
            stamp_ns = self._stamp_ns(message, self.lidar)
            self._queue.add(stamp_ns, True, message)
            if self._reading.stored_times and self._point_clock.undecided:
                times = None
                with suppress(DataError):  # What is wrong with a cloud is said when it is used.
                    times = times_of(message, self.lidar.topic)
                self._point_clock.add(stamp_ns, times, now_ns)

        return self._received(self.lidar, now_ns, take)

    def add_info(self, message: Any, now_ns: int) -> None:
        """A CameraInfo; the first one that can be used counts, those of another camera are counted."""
        if self._geometry is None:
            self._info = message
            return
        try:
            if is_other_camera(self._info, message):
                size, place = (int(message.width), int(message.height)), self.settings.info_topic
                if not has_matrix(message):
                    raise DataError(place, "K = 0, an uncalibrated camera", "a calibrated one")
                image_geometry(message, self.camera.topic, size, place)
                self._other_infos += 1
        except Exception as error:
            self.info.refuse(_reason(error), now_ns)

    def add_transforms(self, message: Any, now_ns: int) -> None:
        """A TFMessage of /tf_static."""
        try:
            self._transforms.add(message)
        except Exception as error:
            self.lidar.refuse(f"a message of transforms that cannot be used: {error}", now_ns)

    def tick(self, now_ns: int) -> Published:
        """Diagnostics; to be called once a second or so."""
        sensors = [self.camera, self.lidar, *([self.masks] if self.settings.mask_topic else [])]
        behind_s = max(one.waited_s for one in sensors)
        found = [one.diagnosis(now_ns, self.settings.silent_s) for one in sensors]
        found[0] = self._with_camera_infos(found[0], now_ns)
        if self._point_clock.words:
            values = {**found[1].values, "times_of_points": self._point_clock.words}
            found[1] = dataclasses.replace(found[1], values=values)
        if self.update is None:
            found.insert(0, Diagnosis("calibration", WARN, self.state, {}))
        else:
            found.insert(0, diagnosis_of(self.update))
        found.append(self._diagnosis_of_queue(behind_s))
        if self.settings.publish != "none":
            found.append(self._diagnosis_of_tf())
        return Published(diagnostics=self._make.diagnostics(found, now_ns))

    def finish(self, now_ns: int) -> list[Published]:
        """Use all that waits, and solve the whole window, as at the end of a drive."""
        published = self._work(now_ns, at_end=True)
        if self.tracker is not None and self.update is not None:
            published.append(self._published(self.tracker.optimize()))
        return published

    # ------------------------------------------------------------------ steps

    def _received(self, sensor: SensorRecord, now_ns: int, take: Callable[[], None]) -> list[Published]:
        """Put a message into the queue, and do the work that is due."""
        sensor.received += 1
        sensor.last_ns = now_ns
        try:
            take()
        except Exception as error:
            sensor.refuse(_reason(error), now_ns)
        return self._work(now_ns)

    def _stamp_ns(self, message: Any, sensor: SensorRecord) -> int:
        """Stamp of a message's header; its frame is noted.

        Raises:
            DataError: the stamp is 0.
        """
        header = message.header
        stamp_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        if stamp_ns == 0:
            raise DataError(sensor.topic, "a message with stamp 0", "stamps of the sensor's driver")
        sensor.frame = sensor.frame or str(header.frame_id).lstrip("/")
        return stamp_ns

    def _add_half(self, stamp_ns: int, what: str, message: Any, type_name: str) -> None:
        """Keep an image or a mask until the other of its stamp is there; then both wait as one."""
        halves = self._halves.setdefault(stamp_ns, {})
        halves[what] = (message, type_name)
        if len(halves) == 2:
            self._queue.add(stamp_ns, False, self._halves.pop(stamp_ns))
        while len(self._halves) > self.settings.queue:
            # The first that came: stamps go back where a bag begins again.
            del self._halves[next(iter(self._halves))]
            self._unpaired += 1

    def _work(self, now_ns: int, at_end: bool = False) -> list[Published]:
        """Give the tracker what is due, once it can be made."""
        if self.tracker is None and not self._begun(now_ns):
            self._queue.drop_oldest()
            return []
        published = []
        for one in self._queue.due(at_end):
            update = self._use(one, now_ns)
            if update is not None and (one.is_scan or not update.accepted):
                published.append(self._published(update))
        return published

    def _begun(self, now_ns: int) -> bool:
        """Make the tracker, as soon as the camera, the first image and the start are known."""
        first = next((one for one in self._queue.peek() if not one.is_scan), None)
        if self._info is None or first is None:
            self._waiting_for = "no image with a mask yet" if self._halves else "no image yet"
            return False
        if self._reading.stored_times and not self._point_clock.scans:
            self._waiting_for = "no cloud yet"
            return False
        if self._point_clock.waiting:
            self._waiting_for = self._point_clock.waiting
            return False
        try:
            if self._geometry is None:
                self._geometry = self._geometry_of(first)
            initial, time_offset_s, why = self._start(self._geometry)
        except Exception as error:
            self._waiting_for = _reason(error)
            self.camera.refuse(self._waiting_for, now_ns)
            self._queue.drop(first)
            return False
        if initial is None and self.settings.init != INIT_NONE:
            self._waiting_for = f"no start yet: {why} (or set init to none or a file)"
            return False
        model = self._geometry.model
        self._rectification = None if model.is_pinhole else Rectification.of(model)
        camera = model.intrinsics if self._rectification is None else self._rectification.camera
        self.tracker = Tracker(camera, self._config, initial, time_offset_s)
        self._waiting_for = "no cloud could be used yet"
        return True

    def _geometry_of(self, first: Waiting) -> ImageGeometry:
        message, type_name = first.content["image"]
        height, width = picture_of(message, type_name, self.camera.topic).shape[:2]
        place = self.settings.info_topic
        return image_geometry(self._info, self.camera.topic, (width, height), place)

    def _start(self, geometry: ImageGeometry) -> tuple[gtsam.Pose3 | None, float, str]:
        """cTl, time offset [s], and why there is none."""
        if self._given is not None:
            return *self._given, ""
        if self.settings.init == INIT_NONE:
            return None, 0.0, ""
        if not self.lidar.frame:
            return None, 0.0, "no cloud yet"
        oTl, why = self._transforms.pose(self.camera.frame, self.lidar.frame)
        if oTl is None:
            return None, 0.0, why
        if (points := self._waiting_points()) is None:
            return None, 0.0, "no cloud that can be used"
        self._images_in_link = is_link(self.camera.frame, oTl, points, geometry.model)
        if self._images_in_link:
            oTl = LINK_FROM_OPTICAL.inverse() * oTl
        if self._T_cloud_lidar is not None:
            oTl = oTl * self._T_cloud_lidar
        return geometry.extrinsic(oTl), 0.0, ""

    def _waiting_points(self) -> NDArray[np.float32] | None:
        """Points (n, 3) of the first cloud that waits and can be used, not all but empty [m]; what is wrong
        with others is said when they are."""
        for one in self._queue.peek():
            if one.is_scan:
                with suppress(Exception):
                    points = cloud_of(one.content, one.stamp_ns, self.lidar.topic, times=False).points
                    if len(points) >= LEAST_SEEN:
                        return points
        return None

    def _use(self, one: Waiting, now_ns: int) -> TrackUpdate | None:
        """Decode a message and give it to the tracker; its update, or None where it cannot be decoded."""
        assert self.tracker is not None
        sensor = self.lidar if one.is_scan else self.camera
        try:
            update = self.tracker.add(self._frame(one, now_ns))
        except Exception as error:
            sensor.refuse(_reason(error), now_ns)
            return None
        if update.refused:
            sensor.refuse(update.reason, now_ns)
        else:
            sensor.used += 1
        return update

    def _frame(self, one: Waiting, now_ns: int) -> Frame:
        """A message as a frame with one sensor, numbered as it came."""
        if not one.is_scan:
            return Frame(one.number, None, self._image(one, now_ns))
        reading = dataclasses.replace(self._reading, clock=self._point_clock.clock)
        scan = scan_of(one.content, one.stamp_ns, self.lidar.topic, reading)
        if self._T_cloud_lidar is not None:
            scan = in_lidar_axes(scan, self._T_cloud_lidar)
        return Frame(one.number, scan, None)

    def _image(self, one: Waiting, now_ns: int) -> CameraImage:
        assert self._geometry is not None
        message, type_name = one.content["image"]
        model = self._geometry.model
        size = model.width, model.height
        pixels = picture_of(message, type_name, self.camera.topic)
        check_size(pixels, size, self.camera.topic)
        mask = np.full(pixels.shape[:2], SemanticClass.IGNORE, np.uint8)
        if "mask" in one.content:
            labels, labels_type = one.content["mask"]
            try:
                mask = mask_classes(labels, labels_type, self._encoding, size, self.masks.topic)
            except Exception as error:
                self.masks.refuse(_reason(error), now_ns)
                raise
            self.masks.used += 1
        image = CameraImage(one.stamp_ns, mask, pixels)
        return image if self._rectification is None else self._rectification.image(image)

    def _with_camera_infos(self, camera: Diagnosis, now_ns: int) -> Diagnosis:
        """The diagnosis of the camera with what its CameraInfo say: those refused, and of another camera."""
        others, info = self._other_infos, self.info
        words = [f"CameraInfo refused: {info.error}"] if info.has_recent_error(now_ns) else []
        if others:
            count = count_of(others, "CameraInfo", "CameraInfo")
            words.append(
                f"{count} of another camera than the first, whose model is used: "
                "restart the node if the camera changed"
            )
        values = {**camera.values, "other_camera_infos": others, "refused_camera_infos": info.refused}
        if self._images_in_link:
            values["axes"] = f"{self.camera.frame} shows to be the camera's link ({LINK_AXES})"
        if not words:
            return dataclasses.replace(camera, values=values)
        if camera.level != OK:
            words.insert(0, camera.message)
        return Diagnosis(camera.name, max(camera.level, WARN), "; ".join(words), values)

    def _diagnosis_of_queue(self, behind_s: float) -> Diagnosis:
        """What waits here, and whether more waits to be taken: for how long is ``behind_s`` [s]."""
        dropped = self._queue.dropped
        values = {
            "waiting": len(self._queue),
            "dropped": dropped,
            "without_partner": self._unpaired,
            "behind_s": f"{behind_s:.1f}",
        }
        words = [f"{count_of(dropped, 'message')} dropped"]
        if behind_s > _BEHIND_S:
            words.append(f"{behind_s:.1f} s behind: messages come faster than they are used")
        return Diagnosis("queue", WARN if dropped or len(words) > 1 else OK, "; ".join(words), values)

    def _diagnosis_of_tf(self) -> Diagnosis:
        """Whether another node gives the frame that is published a parent: tf allows one."""
        names = self.camera.frame, self.lidar.frame
        parent, child = names if self.settings.parent == "camera" else names[::-1]
        others = self._transforms.parents(child)
        if not others:
            return Diagnosis("tf", OK, f"{child} in {parent}" if parent and child else "no frames yet", {})
        words = (
            f"{child} is in {', '.join(others)} already (/tf_static): set publish to none, or take that out"
        )
        return Diagnosis("tf", WARN, words, {})

    def _published(self, update: TrackUpdate) -> Published:
        self.update = update
        return Published(self._make.status(update), self._transform(update))

    def _transform(self, update: TrackUpdate) -> Any:
        """The calibration for /tf; None where there is none to publish."""
        assert self.tracker is not None
        if self.settings.publish == "none":
            return None
        if self.settings.publish == "latest":
            cTl = None if update.covariance is None else update.T_camera_lidar
        else:
            adopted = self.tracker.monitor.adoption.adopted
            cTl = None if adopted is None else adopted.cTl
        if cTl is None:
            return None
        camera, lidar = self.camera.frame, self.lidar.frame
        # The frame of the images, which may be turned against that of the camera model.
        assert self._geometry is not None
        oTl = gtsam.Pose3(self._geometry.cRo, np.zeros(3)).inverse() * cTl
        if self._images_in_link:
            oTl = LINK_FROM_OPTICAL * oTl
        if self._T_cloud_lidar is not None:
            oTl = oTl * self._T_cloud_lidar.inverse()  # The frame that the clouds' headers name.
        if self.settings.parent == "lidar":
            return self._make.transforms({(lidar, camera): oTl.inverse()}, update.stamp_ns)
        return self._make.transforms({(camera, lidar): oTl}, update.stamp_ns)


def image_type(topic: str) -> str:
    """Type of the messages of a topic of images, by its name."""
    return COMPRESSED if topic.endswith("/compressed") else IMAGE


def _reading(settings: NodeSettings) -> CloudReading:
    timing = None
    if settings.sweep in TURNS:
        timing = SweepTiming(TURNS[settings.sweep], np.pi, settings.sweep_period_s, settings.sweep_stamp)
        if settings.lidar_pose:
            timing = TimingFromCloud.of(timing, parse_lidar_pose(settings.lidar_pose))
    return CloudReading(timing, settings.sweep == "auto", bool(settings.mask_topic))


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, DataError) else f"{type(error).__name__}: {error}"
