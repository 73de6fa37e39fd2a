"""Scenes of nuScenes: one LiDAR and one camera, key frames and sweeps, by the tables alone.

Each sensor has its own stamps [us]. The nominal extrinsic is that of the rig: both sensors' poses in the ego
vehicle, without its motion between the stamps. nuScenes has no masks of images; lidarseg labels stand at the
key frames. The LiDAR's x axis points to the right of the vehicle and y ahead, as stored.

Source: the schema in docs/schema_nuscenes.md of nutonomy/nuscenes-devkit.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import CameraModel, Rectification
from sst_graph.cameras.readers import camera_from_nuscenes
from sst_graph.classes import classes_of_lidarseg
from sst_graph.data.arrays import MAX_POINTS, are_returns, check_metres, listed
from sst_graph.data.nuscenes.tables import Record, pose_of, records, text_of, whole_of
from sst_graph.data.pictures import PictureFiles
from sst_graph.data.rectified import RectifiedSource
from sst_graph.data.source import Loader, SourceOptions
from sst_graph.data.two_clocks import DriveProperties, Sensor, merged
from sst_graph.errors import ConfigError, DataError, count_of, printable
from sst_graph.files.reading import FileKind, read_file
from sst_graph.types import CameraImage, GroundTruth, Scan, SemanticClass, Source, with_intensities

_LOG = logging.getLogger(__name__)

LAYOUT = "nuScenes: PATH with v1.0-*, samples, sweeps"
_LIDAR, _CAMERA = "LIDAR_TOP", "CAM_FRONT"
_NS_PER_US = 1000
_PCD_BIN = FileKind("a nuScenes cloud of x y z intensity ring in float32", 20 * MAX_POINTS)
_LIDARSEG = FileKind("lidarseg labels, one uint8 a point", MAX_POINTS)


@dataclass(frozen=True)
class Channel:
    """One sensor of a scene.

    Attributes:
        name: CAM_FRONT.
        calibration: its record of ``calibrated_sensor.json``.
        data: its records of ``sample_data.json``, by stamp.
    """

    name: str
    calibration: Record
    data: tuple[Record, ...]


@dataclass(frozen=True, eq=False)
class LidarFiles:
    """Scans of a scene in the order of their stamps.

    Attributes:
        stamps_ns: (n,) [ns].
        paths: of the clouds.
        labels: of the lidarseg labels, by position.
    """

    stamps_ns: NDArray[np.int64]
    paths: tuple[Path, ...]
    labels: Mapping[int, Path] = field(default_factory=dict)

    def scan(self, k: int) -> Scan:
        """Scan k.

        Raises:
            DataError: a damaged file, rings that are none, another number of labels than points.
        """
        path = self.paths[k]
        data = read_file(path, _PCD_BIN)
        if len(data) % 20:
            raise DataError(path, count_of(len(data), "byte"), f"a multiple of 20 ({_PCD_BIN.name})")
        values = np.frombuffer(data, "<f4").reshape(-1, 5)
        points = np.ascontiguousarray(values[:, :3])
        check_metres(points, path)
        used = are_returns(points)
        rings = values[used, 4]
        if not ((rings >= 0) & (rings < 256) & (rings == np.floor(rings))).all():
            raise DataError(path, "rings that are no whole numbers of 0 to 255", _PCD_BIN.name)
        points = np.ascontiguousarray(points[used])
        scan = Scan(
            stamp_ns=int(self.stamps_ns[k]),
            points=points,
            classes=self._classes(k, used),
            rings=rings.astype(np.uint16),
            left_out=len(used) - len(points),
        )
        return with_intensities(scan, np.ascontiguousarray(values[used, 3]))

    def _classes(self, k: int, used: NDArray[np.bool_]) -> NDArray[np.uint8]:
        path = self.labels.get(k)
        if path is None:
            return np.full(int(used.sum()), SemanticClass.IGNORE, np.uint8)
        labels = np.frombuffer(read_file(path, _LIDARSEG), np.uint8)
        if len(labels) != len(used):
            raise DataError(path, count_of(len(labels), "label"), f"{len(used)}, one a point of the scan")
        return classes_of_lidarseg(labels[used], path)


def is_nuscenes(path: Path) -> bool:
    """Whether a folder holds tables of nuScenes."""
    return os.path.isdir(path) and bool(_versions(path))


def open_nuscenes(path: Path, options: SourceOptions) -> Source:
    """Open a scene.

    Raises:
        DataError: a table or file is missing or damaged.
        ConfigError: no such scene or camera, or several and none named.
    """
    versions = _versions(path)
    if not versions:
        raise DataError(path, "no folder v1.0-* with sample_data.json", LAYOUT)
    if len(versions) > 1:
        named = ", ".join(version.name for version in versions)
        raise ConfigError(f"{path}: tables {named}: keep one of them in the folder")
    tables = versions[0]
    scene = _scene(tables, options.sequence)
    stored = _channels(tables, scene, _named(tables, options))
    lidar, camera = (_present(path, tables, channel) for channel in stored)
    model, nominal = _rig(tables, lidar, camera)
    size = (model.width, model.height)
    pictures = PictureFiles(size, dict(enumerate(_paths(path, tables, camera))))
    image_stamps = _stamps(tables, camera)
    scans = _lidar_files(path, tables, lidar)

    def image(k: int) -> CameraImage:
        return pictures.image(k, int(image_stamps[k]))

    name = f"nuscenes/{printable(text_of(scene, 'name', tables))}"
    notes = tuple(_left_out(before, after) for before, after in zip(stored, (lidar, camera), strict=True))
    properties = DriveProperties(
        name,
        model.intrinsics,
        nominal,
        GroundTruth(nominal, None),
        True,
        nominal_reason="by calibrated_sensor.json",
        notes=tuple(filter(None, notes)),
    )
    for note in properties.notes:
        _LOG.warning("%s: %s", printable(path), note)
    of_scans = Sensor(scans.stamps_ns, scans.scan, lidar.name)
    drive = merged(properties, of_scans, Sensor(image_stamps, image, camera.name), options, path)
    return drive if model.is_pinhole else RectifiedSource(drive, Rectification.of(model))


def _versions(path: Path) -> list[Path]:
    entries = listed(path, LAYOUT)
    return [p for p in entries if p.name.startswith("v1.0-") and os.path.isfile(p / "sample_data.json")]


def _scene(tables: Path, name: str | None) -> Record:
    """The scene of a name, scene-0061 or 61, or the only one."""
    path = tables / "scene.json"
    scenes = {text_of(scene, "name", path): scene for scene in records(path)}
    if name is None and len(scenes) == 1:
        return next(iter(scenes.values()))
    wanted = {name, f"scene-{name:0>4}"} if name is not None else set()
    found = [scene for key, scene in scenes.items() if key in wanted]
    if not found:
        some = ", ".join(list(scenes)[:12]) + (", ..." if len(scenes) > 12 else "")
        asked = "name one of them (--sequence)" if name is None else f"none is {name!r}"
        raise ConfigError(f"{tables}: {count_of(len(scenes), 'scene')} ({some}): {asked}")
    return found[0]


def _named(tables: Path, options: SourceOptions) -> tuple[str, str]:
    """Names of the LiDAR and of the camera: given, nuScenes' own, or those of the only ones.

    Raises:
        ConfigError: none of this name, or several and none named.
    """
    path, default = tables / "sensor.json", SourceOptions()
    found = []
    for modality, given, unnamed, usual in (
        ("lidar", options.cloud, default.cloud, _LIDAR),
        ("camera", options.camera, default.camera, _CAMERA),
    ):
        names = sorted({text_of(r, "channel", path) for r in records(path) if r.get("modality") == modality})
        name = given
        if given == unnamed:
            name = names[0] if len(names) == 1 else usual
        if name not in names:
            what = f"{modality} {name!r}" if given != unnamed else f"no {modality} is named"
            option = "--cloud" if modality == "lidar" else "--camera"
            raise ConfigError(f"{what}: {tables} has {', '.join(names) or 'none'} ({option})")
        found.append(name)
    return found[0], found[1]


def _channels(tables: Path, scene: Record, names: tuple[str, str]) -> tuple[Channel, Channel]:
    """LiDAR and camera of a scene, of some names.

    Raises:
        DataError: no data of one.
    """
    sensors, calibrated = tables / "sensor.json", tables / "calibrated_sensor.json"
    channels = {text_of(r, "token", sensors): text_of(r, "channel", sensors) for r in records(sensors)}
    calibrations = {text_of(r, "token", calibrated): r for r in records(calibrated)}
    samples_path, data_path = tables / "sample.json", tables / "sample_data.json"
    scene_token = text_of(scene, "token", tables / "scene.json")
    samples = {
        text_of(r, "token", samples_path)
        for r in records(samples_path)
        if r.get("scene_token") == scene_token
    }
    data: dict[str, list[Record]] = {name: [] for name in names}
    rigs: dict[str, set[str]] = {name: set() for name in names}
    for record in records(data_path):
        if text_of(record, "sample_token", data_path) not in samples:
            continue
        token = text_of(record, "calibrated_sensor_token", data_path)
        if token not in calibrations:
            raise DataError(data_path, f"calibrated_sensor_token {token!r:.60}", f"one of {calibrated.name}")
        channel = channels.get(str(calibrations[token].get("sensor_token")))
        if channel in data:
            data[channel].append(record)
            rigs[channel].add(token)
    found = []
    for name in names:
        if len(rigs[name]) != 1:
            raise DataError(
                data_path, f"{count_of(len(rigs[name]), 'calibration')} of {name} in the scene", "one"
            )
        rows = tuple(sorted(data[name], key=lambda row: whole_of(row, "timestamp", data_path)))
        found.append(Channel(name, calibrations[next(iter(rigs[name]))], rows))
    return found[0], found[1]


def _present(path: Path, tables: Path, channel: Channel) -> Channel:
    """The channel without the records whose file is missing: the sweeps are often not downloaded.

    Raises:
        DataError: no file is there.
    """
    there = [file.exists() for file in _paths(path, tables, channel)]
    if channel.data and not any(there):
        expected = f"the files of {channel.name} that {tables.name} names"
        raise DataError(_paths(path, tables, channel)[0], "no such file", expected)
    return replace(channel, data=tuple(row for row, here in zip(channel.data, there, strict=True) if here))


def _left_out(stored: Channel, present: Channel) -> str:
    """What of a channel is missing, in words; empty where nothing is."""
    count = len(stored.data) - len(present.data)
    return f"{count_of(count, 'file')} of {stored.name} missing and left out" if count else ""


def _rig(tables: Path, lidar: Channel, camera: Channel) -> tuple[CameraModel, gtsam.Pose3]:
    """The camera, and cTl by both sensors' poses in the ego vehicle."""
    path = tables / "calibrated_sensor.json"
    width, height = (
        whole_of(camera.data[0], side, tables / "sample_data.json") for side in ("width", "height")
    )
    eTc, eTl = pose_of(camera.calibration, path), pose_of(lidar.calibration, path)
    return camera_from_nuscenes(camera.calibration, width, height, path), eTc.inverse() * eTl


def _stamps(tables: Path, channel: Channel) -> NDArray[np.int64]:
    path = tables / "sample_data.json"
    stamps = [whole_of(record, "timestamp", path) for record in channel.data]
    if stamps and not 0 <= stamps[0] <= stamps[-1] < 2**52:
        raise DataError(path, f"a timestamp {stamps[-1]}", "microseconds since 1970")
    return np.array(stamps, np.int64) * _NS_PER_US


def _paths(path: Path, tables: Path, channel: Channel) -> tuple[Path, ...]:
    return tuple(
        _inside(path, text_of(r, "filename", tables / "sample_data.json"), tables) for r in channel.data
    )


def _inside(path: Path, filename: str, tables: Path) -> Path:
    """The file of a table's entry.

    Raises:
        DataError: a name that leads out of the data set.
    """
    parts = Path(filename).parts
    if not parts or Path(filename).is_absolute() or ".." in parts:
        raise DataError(tables, f"filename {filename!r:.80}", "a file below the data set's folder")
    return path.joinpath(*parts)


def _lidar_files(path: Path, tables: Path, lidar: Channel) -> LidarFiles:
    stamps_ns = _stamps(tables, lidar)
    labels: dict[int, Path] = {}
    lidarseg = tables / "lidarseg.json"
    if lidarseg.exists():
        data = tables / "sample_data.json"
        position = {text_of(r, "token", data): k for k, r in enumerate(lidar.data)}
        for record in records(lidarseg):
            k = position.get(text_of(record, "sample_data_token", lidarseg))
            file = _inside(path, text_of(record, "filename", lidarseg), tables)
            if k is not None and file.exists():
                labels[k] = file
    return LidarFiles(stamps_ns, _paths(path, tables, lidar), labels)


NUSCENES_LOADER = Loader(recognizes=is_nuscenes, open=open_nuscenes, layout=LAYOUT)
