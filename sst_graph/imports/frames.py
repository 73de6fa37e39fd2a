"""Camera and LiDAR among the frames of a file, and the extrinsic between them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gtsam

from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import ConfigError, DataError
from sst_graph.files.checked_values import checked_time_offset_s
from sst_graph.files.yaml_file import number
from sst_graph.metrics import LINK_FROM_OPTICAL

TIME_OFFSET_SENTENCE = (
    "time offset of {frame}: t_lidar = t_camera_stamp + time_offset_s, time_offset_s = {value}"
)
"""How a comment states the time offset of a camera's frame [s]; the exports write it, the imports read it."""

_SENTENCE = re.compile(
    re.escape(TIME_OFFSET_SENTENCE).replace(r"\{frame\}", r"(\S+)").replace(r"\{value\}", r"([^\s,;<]+)")
)
_LIDAR = re.compile(
    r"lidar|laser|velodyne|ouster|livox|hesai|pandar|rslidar|robosense|(^|_)(vlp|hdl|os)[-_]?\d", re.I
)
_CAMERA = re.compile(r"cam|optical|image", re.I)


class Found(NamedTuple):
    """What a reader of one format finds in a file.

    Attributes:
        cTl: pose of the LiDAR in the camera's optical frame.
        time_offset_s: None where the file does not say it.
        taken: what was taken for what, in words.
    """

    cTl: gtsam.Pose3
    time_offset_s: float | None
    taken: str


@dataclass(frozen=True)
class ImportOptions:
    """What a file does not say by itself.

    Attributes:
        camera: name of the camera, for a file with several; None takes the only one.
        camera_frame: name of the camera's optical frame (x right, y down, z forward).
        camera_link: name of the camera's link (x forward, y left, z up), where the file has no optical frame.
        lidar_frame: name of the LiDAR's frame.
        parent: frame in the place of the IMU, of a chain of cameras on an IMU; None: the LiDAR itself.
        tree: further transforms, such as that of the LiDAR in ``parent``; the file's replace those of the
            same child.
    """

    camera: str | None = None
    camera_frame: str | None = None
    camera_link: str | None = None
    lidar_frame: str | None = None
    parent: str | None = None
    tree: Transforms | None = None

    def __post_init__(self) -> None:
        if self.camera_frame is not None and self.camera_link is not None:
            raise ConfigError(
                f"--camera-frame {self.camera_frame} and --camera-link {self.camera_link}: found both, "
                "expected the optical frame (z forward) or the link (x forward)"
            )

    def check_effect(self, allowed: Collection[str], why: str) -> None:
        """Refuse frames that are named in vain.

        Args:
            allowed: names of the fields that have an effect.
            why: the others have none, in words.

        Raises:
            ConfigError: another one is given.
        """
        for name in _FRAME_FIELDS:
            if name not in allowed and getattr(self, name) is not None:
                raise ConfigError(f"--{name.replace('_', '-')} would change nothing: {why}")


_FRAME_FIELDS = ("camera_frame", "camera_link", "lidar_frame", "parent", "tree")


def extrinsic_between(
    transforms: Transforms, options: ImportOptions, path: Path
) -> tuple[gtsam.Pose3, str, str]:
    """cTl by the transforms of a file, and the names of the camera's frame and of the LiDAR's.

    Frames that the options do not name are found by their names, where one frame alone can be meant.

    Raises:
        DataError: a frame is missing or ambiguous, or no chain of transforms joins them.
    """
    lidar = _lidar(transforms.frames, options, path)
    camera, optical = _camera(transforms.frames, options, path)
    pose, why = transforms.pose(camera, lidar)
    if pose is None:
        raise DataError(path, why, f"constant transforms from {camera!r} to {lidar!r}")
    return (pose if optical else LINK_FROM_OPTICAL.inverse() * pose), camera, lidar


def stated_time_offset_s(text: str, camera_frame: str, path: Path) -> float | None:
    """The time offset [s] that a comment states for a camera's frame; None where there is no such comment.

    Raises:
        DataError: it is no time offset.
    """
    stated: dict[str, str] = dict(_SENTENCE.findall(text))
    value = next(iter(stated.values())) if len(stated) == 1 else stated.get(camera_frame)
    if value is None:
        return None
    place = f"{path} (time_offset_s)"
    return checked_time_offset_s(number(value, place), place)


def _lidar(frames: Sequence[str], options: ImportOptions, path: Path) -> str:
    if options.lidar_frame is not None:
        return _named(frames, options.lidar_frame, path)
    found = [frame for frame in frames if _LIDAR.search(frame) and not _CAMERA.search(frame)]
    return _only(found, frames, "the LiDAR's frame: --lidar-frame NAME", path)


def _camera(frames: Sequence[str], options: ImportOptions, path: Path) -> tuple[str, bool]:
    """The camera's frame, and whether it is the optical one."""
    if options.camera_frame is not None:
        return _named(frames, options.camera_frame, path), True
    if options.camera_link is not None:
        return _named(frames, options.camera_link, path), False
    cameras = [frame for frame in frames if _CAMERA.search(frame)]
    for word, optical in (("optical", True), ("link", False)):
        found = [frame for frame in cameras if word in frame.lower()]
        if len(found) > 1 and options.camera is not None:
            named = [frame for frame in found if is_of_camera(frame, options.camera)]
            found = named or found
        if found:
            asked = f"one camera: --camera-{'frame' if optical else 'link'} NAME"
            return _only(found, frames, asked, path), optical
    asked = "the camera's: --camera-frame NAME (optical: z forward) or --camera-link NAME (x forward)"
    return _only([], frames, asked, path), True


def is_of_camera(frame: str, camera: str) -> bool:
    """Whether a frame is named after a camera: ``image_2_optical_frame`` after ``image_2``."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", camera).strip("_").lower()
    return bool(plain) and bool(re.match(rf"{plain}(?![0-9])", re.sub(r"[^a-z0-9]+", "_", frame.lower())))


def _named(frames: Sequence[str], name: str, path: Path) -> str:
    plain = name.lstrip("/")
    if plain not in frames:
        raise DataError(path, f"no frame {name!r} among {_listed(frames)}", "a frame of the file")
    return plain


def _only(found: Sequence[str], frames: Sequence[str], asked: str, path: Path) -> str:
    if len(found) != 1:
        raise DataError(path, f"the frames {_listed(found or frames)}", asked)
    return found[0]


def _listed(frames: Sequence[str]) -> str:
    return ", ".join(f"{frame:.60}" for frame in frames[:12]) + (", ..." if len(frames) > 12 else "")
