"""The node's core on messages of a simulated street, made and read with rosbags."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from stored import written
from streets import SOON

pytest.importorskip("rosbags")

from bags import CAMERA_FRAME, CLOUD, EPOCH_NS, IMAGE, INFO, LIDAR_FRAME, MASK, Messages
from driver_bags import HALF_S, STREET, Driver, bag_of_driver
from rosbags.highlevel import AnyReader

import sst_graph.ros_node
from sst_graph.cli import main
from sst_graph.data import KittiSource, open_source
from sst_graph.errors import ConfigError, DataError
from sst_graph.metrics import LINK_FROM_OPTICAL
from sst_graph.ros_node import CalibrationNode, NodeSettings, Published
from sst_graph.ros_node.settings import node_settings, parameter_defaults
from sst_graph.tracker.config import TrackerConfig

SETTINGS = NodeSettings(
    image_topic=IMAGE, info_topic=INFO, cloud_topic=CLOUD, mask_topic=MASK, sweep="compensated"
)
FEW = 44
"""Messages of the first 14 frames."""


@pytest.fixture(scope="module")
def config() -> TrackerConfig:
    from sst_graph.config import with_overrides

    return with_overrides(TrackerConfig(), SOON)


@cache
def _messages(bag: Any) -> tuple[tuple[str, str, int, Any], ...]:
    """Topic, type, time of receipt [ns] and message, in the order of receipt."""
    with AnyReader([bag]) as reader:
        return tuple(
            (one.topic, one.msgtype, received_ns, reader.deserialize(data, one.msgtype))
            for one, received_ns, data in reader.messages()
        )


@pytest.fixture(scope="module")
def plain(bag: Any, config: TrackerConfig) -> list[Published]:
    """What the node publishes on the bag, with the solution at its end."""
    node = CalibrationNode(SETTINGS, config)
    return _play(node, _messages(bag)) + node.finish(EPOCH_NS)


def _play(node: CalibrationNode, messages: Any) -> list[Published]:
    """Give the node messages; what it publishes."""
    published = []
    for topic, type_name, now_ns, message in messages:
        if topic == IMAGE:
            published += node.add_image(message, now_ns, type_name)
        elif topic == MASK:
            published += node.add_mask(message, now_ns, type_name)
        elif topic == CLOUD:
            published += node.add_cloud(message, now_ns)
        elif topic == INFO:
            node.add_info(message, now_ns)
        else:
            node.add_transforms(message, now_ns)
    return published


def _line(published: Published) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(published.status.data)
    return found


def _diagnostics(node: CalibrationNode, now_ns: int) -> dict[str, Any]:
    """The node's statuses by name."""
    array = node.tick(now_ns).diagnostics
    return {one.name.removeprefix("sst_graph: "): one for one in array.status}


def _diagnostics_of(node: CalibrationNode, now_ns: int, name: str) -> Any:
    """One of the node's statuses by its whole name."""
    return next(one for one in node.tick(now_ns).diagnostics.status if one.name == name)


@pytest.mark.slow
def test_it_ends_where_track_ends(
    bag: Any, plain: list[Published], capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--mask-topic", MASK, "--sweep", "compensated"]
    main(["track", str(bag), *options, *(word for one in SOON for word in ("--set", one))])
    expected = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    lines = [_line(one) for one in plain]
    # A line for each scan, and one for the solution of the whole window, which is track's last.
    assert len(lines) == len(expected) + 1 == 21
    for line in (*lines, *expected):
        line.pop("frame", None)
    assert lines[:19] == expected[:19]
    assert lines[-1] == expected[-1] and lines[-1]["matches"] > 100


def test_the_transform_is_the_calibration(bag: Any, config: TrackerConfig, plain: list[Published]) -> None:
    latest = dataclasses.replace(SETTINGS, publish="latest")
    node = CalibrationNode(latest, config)
    last = _play(node, _messages(bag)[:FEW])[-1]
    (one,) = last.transforms.transforms
    assert (one.header.frame_id, one.child_frame_id) == (CAMERA_FRAME, LIDAR_FRAME)
    stamp_ns = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
    assert stamp_ns == _line(last)["stamp_ns"] > EPOCH_NS
    q, t = one.transform.rotation, one.transform.translation
    pose = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), [t.x, t.y, t.z])
    np.testing.assert_allclose(pose.matrix(), _line(last)["T_camera_lidar"], atol=1e-9)
    node.settings = dataclasses.replace(latest, parent="lidar")
    (back,) = node.finish(EPOCH_NS)[-1].transforms.transforms
    assert (back.header.frame_id, back.child_frame_id) == (LIDAR_FRAME, CAMERA_FRAME)
    t = back.transform.translation
    assert node.update is not None
    expected = node.update.T_camera_lidar.inverse().translation()
    np.testing.assert_allclose([t.x, t.y, t.z], expected, atol=1e-9)
    # What is adopted is published by default: nothing before the estimate is confirmed.
    assert plain[3].transforms is None


def test_clouds_in_axes_of_the_vehicle(bag: Any, config: TrackerConfig) -> None:
    """The LiDAR is found where it is in them, and /tf stays between the frames that the headers name."""
    T_vehicle_lidar = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.4), np.array([1.4, 0.1, 1.7]))
    R, t = T_vehicle_lidar.rotation().matrix(), T_vehicle_lidar.translation()
    make, messages = Messages(), []
    for topic, kind, now_ns, message in _messages(bag)[:FEW]:
        if topic == CLOUD:
            packed = np.array(message.data).reshape(-1, message.point_step)
            points = np.ascontiguousarray(packed[:, :12]).view("<f4").astype(float)
            packed[:, :12] = (points @ R.T + t).astype("<f4").view(np.uint8)
            header = dataclasses.replace(message.header, frame_id="vehicle")
            message = dataclasses.replace(message, header=header, data=packed.reshape(-1))
        messages.append((topic, kind, now_ns, message))
    pose = "1.4,0.1,1.7," + ",".join(f"{angle:.9f}" for angle in np.degrees([0.02, -0.03, 0.4]))
    moved = CalibrationNode(dataclasses.replace(SETTINGS, publish="latest", lidar_pose=pose), config)
    moved.add_transforms(make.transforms({(LIDAR_FRAME, "vehicle"): T_vehicle_lidar.inverse()}), 0)
    last = _play(moved, messages)[-1]
    plain = _play(CalibrationNode(SETTINGS, config), _messages(bag)[:FEW])[-1]
    # The points are rounded otherwise, and few frames tell the way along the road badly.
    cTl, expected = (np.array(_line(one)["T_camera_lidar"]) for one in (last, plain))
    sigmas = np.sqrt(np.diag(_line(plain)["covariance"]))
    away = gtsam.Pose3.Logmap(gtsam.Pose3(expected).between(gtsam.Pose3(cTl)))
    assert (np.abs(away) < 0.5 * sigmas[:6]).all() and np.abs(away[3:]).max() < 0.02
    (one,) = last.transforms.transforms
    assert (one.header.frame_id, one.child_frame_id) == (CAMERA_FRAME, "vehicle")
    q, t = one.transform.rotation, one.transform.translation
    oTv = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), [t.x, t.y, t.z])
    np.testing.assert_allclose((oTv * T_vehicle_lidar).matrix(), cTl, atol=1e-8)


def test_images_stamped_with_the_camera_s_link(bag: Any, config: TrackerConfig) -> None:
    """The start is turned into the optical axes, and what is published is of the frame in the headers."""
    make, messages = Messages(), []
    cTl = open_source(bag, mask_topic=MASK).nominal
    assert cTl is not None
    for topic, kind, now_ns, message in _messages(bag)[:FEW]:
        if topic == "/tf_static":
            message = make.transforms({("camera_link", LIDAR_FRAME): LINK_FROM_OPTICAL * cTl})
        elif topic in (IMAGE, MASK):
            header = dataclasses.replace(message.header, frame_id="camera_link")
            message = dataclasses.replace(message, header=header)
        messages.append((topic, kind, now_ns, message))
    node = CalibrationNode(dataclasses.replace(SETTINGS, publish="latest"), config)
    last = _play(node, messages)[-1]
    plain = _play(CalibrationNode(SETTINGS, config), _messages(bag)[:FEW])[-1]
    found, expected = (np.array(_line(one)["T_camera_lidar"]) for one in (last, plain))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    (one,) = last.transforms.transforms
    assert (one.header.frame_id, one.child_frame_id) == ("camera_link", LIDAR_FRAME)
    q, t = one.transform.rotation, one.transform.translation
    linkTl = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), [t.x, t.y, t.z])
    np.testing.assert_allclose((LINK_FROM_OPTICAL.inverse() * linkTl).matrix(), found, atol=1e-8)
    values = {one.key: one.value for one in _diagnostics(node, EPOCH_NS)["camera"].values}
    assert values["axes"].startswith("camera_link shows to be the camera's link (x forward")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "init"),
    [(Driver(True), "tf"), (Driver(True, later_s=2 * HALF_S, arrives_s=0.004), "tf"), (Driver(True), "none")],
)
def test_times_of_points_by_the_lidar_s_own_clock(
    tmp_path: Path, config: TrackerConfig, driver: Driver, init: str
) -> None:
    """The difference is found from the first ten clouds, which wait; then all is as with times after the
    stamp."""
    source = open_source(written(STREET))
    assert isinstance(source, KittiSource)
    settings, lines = dataclasses.replace(SETTINGS, sweep="auto", init=init), []
    for own in (Driver(False), driver):
        node = CalibrationNode(settings, config)
        messages = _messages(bag_of_driver(source, tmp_path / str(own.own_clock), own))
        published = _play(node, messages[:20])
        assert bool(published) != own.own_clock
        assert ("scans have told the difference" in node.state) == own.own_clock
        published += _play(node, messages[20:]) + node.finish(EPOCH_NS)
        values = {one.key: one.value for one in _diagnostics(node, EPOCH_NS)["lidar"].values}
        assert ("of another clock" in values.get("times_of_points", "")) == own.own_clock
        assert values["refused"] == "0" and node.lidar.used == len(source)
        lines.append(_line(published[-1]))
    relative, found = lines
    sigmas = np.sqrt(np.diag(relative["covariance"]))
    poses = [gtsam.Pose3(np.array(line["T_camera_lidar"])) for line in lines]
    away = gtsam.Pose3.Logmap(poses[0].between(poses[1]))
    # With other stamps, other pairs and times between them tell the way along the road, badly.
    most = 1.0 if driver.later_s else 0.2
    assert (np.abs(away) < most * sigmas[:6]).all()
    assert abs(found["time_offset_s"] - relative["time_offset_s"]) < most * sigmas[6]


def test_what_is_published_can_be_serialized(bag: Any, config: TrackerConfig) -> None:
    from sst_graph.ros_node.published import NodeMessages

    node, make = (
        CalibrationNode(dataclasses.replace(SETTINGS, publish="latest"), config),
        NodeMessages("sst_graph"),
    )
    last = _play(node, _messages(bag)[:FEW])[-1]
    for message in (last.status, last.transforms, node.tick(EPOCH_NS).diagnostics):
        again = make.decoded(make.encoded(message), message.__msgtype__)
        assert again == message


def test_diagnostics_say_what_is_missing(bag: Any, config: TrackerConfig) -> None:
    node = CalibrationNode(SETTINGS, config)
    empty = _diagnostics(node, EPOCH_NS)
    assert empty["camera"].level == empty["lidar"].level == empty["masks"].level == 3
    assert empty["calibration"].message == f"no message on {INFO} yet"
    messages = _messages(bag)
    _play(node, [one for one in messages if one[0] not in ("/tf_static", INFO)][:12])
    assert _diagnostics(node, EPOCH_NS)["calibration"].message == f"no message on {INFO} yet"
    _play(node, [one for one in messages if one[0] == INFO])
    assert node.tracker is None
    _play(node, [one for one in messages if one[0] == CLOUD][:5])
    assert "no chain of transforms" in _diagnostics(node, EPOCH_NS)["calibration"].message
    _play(node, [one for one in messages if one[0] == "/tf_static"])
    _play(node, [one for one in messages if one[0] == CLOUD][5:6])
    assert node.tracker is not None
    well = _diagnostics(node, EPOCH_NS)
    assert well["calibration"].message.startswith("starting")
    values = {one.key: one.value for one in well["lidar"].values}
    assert values["topic"] == CLOUD and values["refused"] == "4"  # the first scans again


def test_a_silent_sensor_is_named_and_the_tracker_goes_on(bag: Any, config: TrackerConfig) -> None:
    node = CalibrationNode(SETTINGS, config)
    messages = _messages(bag)
    middle = messages[len(messages) // 2][2]
    # No image and no mask for a second in the middle of the drive.
    gap = [one for one in messages if one[0] == CLOUD or not middle - 4e8 < one[2] < middle + 6e8]
    half = [one for one in gap if one[2] <= middle + 5e8]
    published = _play(node, half)
    now_ns = half[-1][2] + 1_500_000_000
    # A node that was busy for so long does not know yet whether messages wait.
    assert _diagnostics(node, now_ns)["lidar"].level == 0
    silent = _diagnostics(node, now_ns)
    assert silent["camera"].level == 3 and "for 2." in silent["camera"].message
    assert silent["lidar"].level == 3 and "for 1.5 s" in silent["lidar"].message
    published += _play(node, gap[len(half) :]) + node.finish(now_ns)
    assert len([one for one in published if _line(one)["accepted"]]) > 5
    assert _line(published[-1])["matches"] > 50


def test_wrong_contents_are_reported_and_change_nothing(
    bag: Any, config: TrackerConfig, plain: list[Published]
) -> None:
    messages = _messages(bag)[:FEW]
    make = Messages()
    nothing = make.image(EPOCH_NS + 5, np.zeros((4, 4), np.uint8), "mono8")
    cloud = next(one[3] for one in messages if one[0] == CLOUD)
    image = next(one[3] for one in messages if one[0] == IMAGE)
    mask = next(one[3] for one in messages if one[0] == MASK)
    late = make.header(EPOCH_NS + 300_000_123, "front_optical")
    bad = [
        (CLOUD, "", dataclasses.replace(cloud, point_step=3)),
        (CLOUD, "", dataclasses.replace(cloud, data=cloud.data[:10], header=late)),
        (CLOUD, "", dataclasses.replace(cloud, header=make.header(0, "lidar"))),
        (CLOUD, "", object()),
        (IMAGE, image.__msgtype__, object()),
        (IMAGE, image.__msgtype__, dataclasses.replace(image, encoding="16UC1", header=late)),
        (MASK, mask.__msgtype__, dataclasses.replace(mask, header=late)),
        (MASK, nothing.__msgtype__, nothing),
        (INFO, "", object()),
        ("/tf_static", "", object()),
    ]
    disturbed = CalibrationNode(SETTINGS, config)
    at = len(messages) // 3
    now_ns = messages[at][2]
    played = _play(disturbed, messages[:at])
    played += _play(disturbed, [(topic, kind, now_ns, message) for topic, kind, message in bad])
    found = _diagnostics(disturbed, now_ns)
    played += _play(disturbed, messages[at:])
    lines, expected = [_line(one) for one in played], [_line(one) for one in plain[: len(played)]]
    for line in (*lines, *expected):
        line.pop("frame", None)
    assert len(lines) == 12 and lines == expected and lines[-1]["matches"] > 50
    assert found["lidar"].level == 1 and found["camera"].level == 1
    refused = {one.key: one.value for one in _diagnostics(disturbed, now_ns)["lidar"].values}
    assert int(refused["refused"]) == 5  # four clouds and one message of transforms
    assert CLOUD in refused["last_error"] or "transforms" in refused["last_error"]


def test_wrong_first_messages_do_not_keep_it_from_starting(bag: Any, config: TrackerConfig) -> None:
    messages = list(_messages(bag))
    image = next(one[3] for one in messages if one[0] == IMAGE)
    mask = next(one[3] for one in messages if one[0] == MASK)
    early = Messages().header(EPOCH_NS - 100_000_000, CAMERA_FRAME)
    node = CalibrationNode(SETTINGS, config)
    _play(node, [one for one in messages if one[0] in (INFO, "/tf_static")])
    broken = dataclasses.replace(image, data=image.data[:9], header=early)
    node.add_image(broken, EPOCH_NS)
    node.add_mask(dataclasses.replace(mask, header=early), EPOCH_NS)
    assert "bytes" in _diagnostics(node, EPOCH_NS)["calibration"].message
    assert _line(_play(node, messages)[-1])["matches"] > 50


def test_the_sensor_whose_messages_cannot_be_used_is_named(bag: Any, config: TrackerConfig) -> None:
    """Masks of another size are the masks' fault; without a usable cloud it is clouds that are missing."""
    messages = [one for one in _messages(bag)[:FEW] if one[0] != "/tf_static"]
    small = Messages().image(EPOCH_NS, np.zeros((4, 4), np.uint8), "mono8")
    cloud = next(one[3] for one in messages if one[0] == CLOUD)
    start = dataclasses.replace(SETTINGS, init="none")
    for topic, content, calibration in (
        (MASK, small, "starting"),
        (CLOUD, dataclasses.replace(cloud, data=np.zeros(3, np.uint8)), "no cloud could be used"),
    ):
        node = CalibrationNode(start, config)
        for kind, type_name, now_ns, message in messages:
            wrong = dataclasses.replace(content, header=message.header) if kind == topic else message
            _play(node, [(kind, type_name, now_ns, wrong)])
        found = _diagnostics(node, messages[-1][2])
        assert found["calibration"].message.startswith(calibration)
        sensor = found["masks" if topic == MASK else "lidar"]
        assert sensor.level == 2 and topic in sensor.message


def test_a_start_is_of_the_node_s_camera_whatever_its_name(tmp_path: Path) -> None:
    """A rig's result is named for its topic."""
    start = {"T_camera_lidar": np.eye(4).tolist(), "time_offset_s": 0.01, "camera": {"name": "/cam1/image"}}
    (tmp_path / "calibration.json").write_text(json.dumps(start))
    CalibrationNode(dataclasses.replace(SETTINGS, init=str(tmp_path / "calibration.json")))
    with pytest.raises(DataError, match=r"nowhere\.json"):
        CalibrationNode(dataclasses.replace(SETTINGS, init=str(tmp_path / "nowhere.json")))


def test_a_camera_info_of_another_camera_is_warned_of(bag: Any, config: TrackerConfig) -> None:
    """Equal ones are silent; one that cannot be used is refused."""
    node = CalibrationNode(SETTINGS, config)
    messages = _messages(bag)[:FEW]
    info = next(one[3] for one in messages if one[0] == INFO)
    other_stamp = dataclasses.replace(info, header=Messages().header(EPOCH_NS + 1, "elsewhere"))
    now_ns = messages[-1][2]
    _play(node, [*messages, (INFO, "", now_ns, other_stamp)])
    assert _diagnostics(node, now_ns)["camera"].level == 0
    for number, change in enumerate(({"k": info.k + 5.0 * np.eye(3).ravel()}, {"width": info.width + 8}), 1):
        node.add_info(dataclasses.replace(info, **change), now_ns)
        camera = _diagnostics(node, now_ns)["camera"]
        assert camera.level == 1 and camera.message == (
            f"{number} CameraInfo of another camera than the first, whose model is used: "
            "restart the node if the camera changed"
        )
    wrong = ({"p": np.full(12, np.nan)}, {"k": np.zeros(9)}, {"width": 0, "height": 0, "binning_x": 2})
    for number, (change, words) in enumerate(zip(wrong, ("P", "K = 0", "binning"), strict=True), 1):
        node.add_info(dataclasses.replace(info, **change), now_ns)
        camera = _diagnostics(node, now_ns)["camera"]
        assert camera.message.startswith(f"CameraInfo refused: {INFO}") and words in camera.message
        values = {one.key: one.value for one in camera.values}
        assert (values["other_camera_infos"], values["refused_camera_infos"]) == ("2", str(number))


def test_queues_are_bounded(bag: Any, config: TrackerConfig) -> None:
    settings = dataclasses.replace(SETTINGS, queue=4)
    node = CalibrationNode(settings, config)
    messages = _messages(bag)
    _play(node, [one for one in messages if one[0] in (CLOUD, IMAGE)])
    values = {one.key: one.value for one in _diagnostics(node, EPOCH_NS)["queue"].values}
    # Without camera_info nothing is used; images wait for masks.
    assert values == {"waiting": "4", "dropped": "16", "without_partner": "16", "behind_s": "0.0"}
    # Too many to wait for hold_s: the oldest are used before that.
    hasty = CalibrationNode(dataclasses.replace(settings, hold_s=10.0), config)
    assert len(_play(hasty, messages)) == 18


@pytest.mark.parametrize(
    "changes",
    [
        {"sweep": "sideways"},
        {"publish": "all"},
        {"parent": "map"},
        {"label_encoding": "auto"},
        {"hold_s": -1.0},
        {"queue": 1},
        {"cloud_topic": ""},
        {"lidar_pose": "1.4,0"},
    ],
)
def test_wrong_parameters_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(changes)).replace("_", ".")):
        CalibrationNode(dataclasses.replace(SETTINGS, **changes))


@pytest.mark.parametrize(
    ("given", "tracker_settings"),
    [
        ({"hold_s": 1, "tracker_settings": ["window=40", "start_scans=8"]}, (40, 8)),
        ({"tracker_settings": "window=30"}, (30, TrackerConfig().start_scans)),
        ({"tracker_settings": [""]}, (TrackerConfig().window, TrackerConfig().start_scans)),
    ],
)
def test_parameters_are_of_the_kinds_that_ros_reads(
    given: dict[str, Any], tracker_settings: tuple[int, int]
) -> None:
    """A whole number in the place of another, a single setting without brackets."""
    settings, config = node_settings(given)
    assert settings.hold_s == given.get("hold_s", 0.2) and isinstance(settings.hold_s, float)
    assert (config.window, config.start_scans) == tracker_settings
    assert parameter_defaults().keys() >= given.keys()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"tracker_settings": [1, 2]}, "tracker_settings: found"),
        ({"tracker_settings": ["windo=4"]}, "unknown setting 'windo'"),
        ({"mask_topic": True}, "mask_topic: found True, expected text"),
        ({"image_topics": "x"}, "found a parameter 'image_topics', expected one of image_topic"),
    ],
)
def test_parameters_of_other_kinds_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        node_settings(given)


def test_messages_come_as_bytes(bag: Any, config: TrackerConfig, plain: list[Published]) -> None:
    """Those of another type, or cut short, are refused, and nothing else changes."""
    node, make = CalibrationNode(SETTINGS, config), Messages()
    parts = {record.topic: part for part, record in node.topics.items()}
    published: list[Published] = []
    for topic, _, now_ns, message in _messages(bag):
        data = make.encoded(message)
        for broken in (b"", data[: len(data) // 2], b"\xff" * 40):
            assert node.add_bytes(parts[topic], broken, now_ns) == []
        published += node.add_bytes(parts[topic], data, now_ns)
    assert [_line(one) for one in published] == [_line(one) for one in plain[: len(published)]]
    found = _diagnostics(node, EPOCH_NS)
    values = {one.key: one.value for one in found["camera"].values}
    assert (values["received"], values["refused"], values["used"]) == ("80", "60", "18")
    assert f"{IMAGE}: found no sensor_msgs/msg/Image in 40 bytes" in values["last_error"]


def test_diagnostics_say_what_the_network_shows(config: TrackerConfig) -> None:
    node = CalibrationNode(SETTINGS, config, "car/tracker")
    node.camera.published = frozenset({"sensor_msgs/msg/CompressedImage"})
    node.lidar.published = frozenset()
    node.info.published = frozenset({"sensor_msgs/msg/CameraInfo"})
    found = {one.name: one.message for one in node.tick(EPOCH_NS).diagnostics.status}
    wrong = "it is published as sensor_msgs/msg/CompressedImage, not sensor_msgs/msg/Image"
    assert found["car/tracker: camera"] == f"no message on {IMAGE} yet: {wrong}"
    assert found["car/tracker: lidar"] == f"no message on {CLOUD} yet: nothing publishes it"
    assert found["car/tracker: calibration"] == node.news() == f"no message on {INFO} yet"
    assert node.news() == ""
    node.lidar.received, node.lidar.last_ns = 1, EPOCH_NS
    node.lidar.lose(3, EPOCH_NS)
    lidar = _diagnostics_of(node, EPOCH_NS, "car/tracker: lidar")
    assert (lidar.level, lidar.message) == (1, "3 messages lost by the network")
    # A node that is behind says so once.
    node.lidar.wait(2.5)
    node.lidar.wait(0.5)
    for level, words in ((1, "0 messages dropped; 2.5 s behind: messages come"), (0, "0 messages dropped")):
        queue = _diagnostics_of(node, EPOCH_NS, "car/tracker: queue")
        assert queue.level == level and queue.message.startswith(words)
    # Long ago, or later than now where the clock was set back.
    for now_ns in (EPOCH_NS + 6 * 10**9, EPOCH_NS - 10**9):
        node.lidar.last_ns = now_ns
        assert _diagnostics_of(node, now_ns, "car/tracker: lidar").level == 0


def test_a_frame_with_another_parent_is_warned_of(bag: Any, config: TrackerConfig) -> None:
    for changes, words in (
        ({}, f"{LIDAR_FRAME} is in mast already"),
        ({"parent": "lidar"}, f"{CAMERA_FRAME} is in base_link already"),
    ):
        node = CalibrationNode(dataclasses.replace(SETTINGS, **changes), config)
        assert _diagnostics(node, EPOCH_NS)["tf"].level == 0
        _play(node, _messages(bag)[:5])
        warned = _diagnostics(node, EPOCH_NS)["tf"]
        assert warned.level == 1 and words in warned.message
    silent = CalibrationNode(dataclasses.replace(SETTINGS, publish="none"), config)
    _play(silent, _messages(bag)[:5])
    assert "tf" not in _diagnostics(silent, EPOCH_NS)


@pytest.mark.slow
def test_a_bag_that_begins_again(bag: Any, config: TrackerConfig) -> None:
    """The end of the first play is used before the second, in which the order is that of the stamps again."""
    messages = _messages(bag)
    node = CalibrationNode(SETTINGS, config)
    # More masks without an image than may wait for one: they stand in nobody's way.
    mask = next(one[3] for one in messages if one[0] == MASK)
    for k in range(SETTINGS.queue + 5):
        late = Messages().header(EPOCH_NS + 10**12 + k, CAMERA_FRAME)
        node.add_mask(dataclasses.replace(mask, header=late), EPOCH_NS)
    first = [_line(one)["stamp_ns"] for one in _play(node, messages)]
    second = [_line(one) for one in _play(node, messages) + node.finish(EPOCH_NS)]
    stamps = [line["stamp_ns"] for line in second]
    scans = sorted(
        {one[3].header.stamp.nanosec + one[3].header.stamp.sec * 10**9 for one in messages if one[0] == CLOUD}
    )
    assert first == scans[:18] and stamps[:2] == scans[18:]
    again = stamps[2:]
    assert again == sorted(again) and set(again) == set(scans)
    # The clock was set back, which is an alarm; then there is an estimate again.
    assert any(line["alarm"] for line in second) and second[-1]["matches"] > 50


def test_the_wrapper_is_short_and_all_that_needs_rclpy() -> None:
    folder = Path(sst_graph.ros_node.__file__).parent
    imports = re.compile(r"^\s*(?:from|import) (?:rcl\w*|rmw\w*|\w+_msgs|\w+_interfaces)\b", re.MULTILINE)
    needing = [path for path in sorted(folder.glob("*.py")) if imports.search(path.read_text("utf-8"))]
    assert [path.name for path in needing] == ["__main__.py"]
    assert 40 < _lines_of_code(needing[0]) < 80


def _lines_of_code(path: Path) -> int:
    """Lines with code on them: no docstrings, comments and blank lines."""
    layout = (tokenize.NL, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    lines, statement = set(), list[tokenize.TokenInfo]()
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type in (*layout, tokenize.ENCODING):
                continue
            if token.type != tokenize.NEWLINE:
                statement.append(token)
                continue
            if [one.type for one in statement] != [tokenize.STRING]:
                lines |= {k for one in statement for k in range(one.start[0], one.end[0] + 1)}
            statement = []
    return len(lines)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="rclpy is installed")
def test_the_wrapper_needs_rclpy_only_to_run() -> None:
    import sst_graph.ros_node.__main__ as wrapper

    with pytest.raises(ModuleNotFoundError, match="rclpy"):
        wrapper.main()
    done = subprocess.run([sys.executable, "-m", "sst_graph.ros_node"], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "rclpy is not installed" in done.stderr
