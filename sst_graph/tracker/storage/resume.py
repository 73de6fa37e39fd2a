"""Whether a stored tracker belongs to a drive, to its sensors and to the settings it is resumed with."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from sst_graph.config import to_dict
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.tracker.config import TrackerConfig
from sst_graph.types import CameraImage, Frame, Scan, Source
from sst_graph.validation import checked_image, checked_scan

if TYPE_CHECKING:
    from sst_graph.tracker.tracker import Tracker

_FIRST = 3
"""Scans and images, of each, by which a drive is recognized."""


@dataclass(frozen=True)
class Setup:
    """What a tracker is made with.

    Attributes:
        camera: of its images.
        config: all settings.
        initial: guess of cTl, or None.
        initial_time_offset_s: guess of the time offset [s].
    """

    camera: PinholeCamera
    config: TrackerConfig
    initial: gtsam.Pose3 | None
    initial_time_offset_s: float

    def differences(self, other: Setup) -> list[str]:
        """In what another one differs: "name, and not the other's"."""
        mine, others = _flat(to_dict(self.config)), _flat(to_dict(other.config))
        found = [
            f"setting {name} = {mine.get(name)}, not {others.get(name)}"
            for name in {**mine, **others}
            if mine.get(name) != others.get(name)
        ]
        if self.camera != other.camera:
            found.append(f"a camera {self.camera}, not {other.camera}")
        if (
            not _same(self.initial, other.initial)
            or self.initial_time_offset_s != other.initial_time_offset_s
        ):
            mine_text, other_text = (_start_text(setup) for setup in (self, other))
            found.append(f"a start from {mine_text}, not from {other_text}")
        return found


@dataclass
class FirstFrames:
    """Stamps and contents of the first scans and images that a tracker took in.

    Attributes:
        digests: by sensor and stamp [ns], SHA-256 of all arrays.
    """

    digests: dict[tuple[str, int], str] = field(default_factory=dict)

    def add(self, data: Scan | CameraImage) -> None:
        """A scan or an image that was used; the first ones are remembered."""
        sensor = _sensor(data)
        if sum(name == sensor for name, _ in self.digests) < _FIRST:
            self.digests[sensor, data.stamp_ns] = _digest(data)


def check_inputs(tracker: Tracker) -> None:
    """That a tracker's setup and inputs are what these functions compare.

    Raises:
        ValueError: it is not.
    """
    setup, inputs = tracker.setup, tracker.inputs
    newest = inputs.scan_order.newest_ns
    whole = isinstance(setup, Setup) and isinstance(inputs.first_frames, FirstFrames)
    whole = whole and (newest is None or isinstance(newest, int))
    if not whole or (setup.camera, setup.config.estimating) != (inputs.camera, inputs.config):
        raise ValueError("inputs of another tracker")


def check_setup(tracker: Tracker, setup: Setup, place: str | Path) -> None:
    """Refuse a tracker that was made with another camera, other settings or another guess.

    Raises:
        DataError: it was; each difference is named.
    """
    if found := tracker.setup.differences(setup):
        some = "; ".join(found[:5]) + (f"; and {len(found) - 5} more" if len(found) > 5 else "")
        raise DataError(place, f"a tracker with {some}", "what it was made with (or a new tracker)")


def frames_to_come(tracker: Tracker, source: Source, place: str | Path) -> Iterator[Frame]:
    """The frames of a drive behind the newest scan of a tracker that was resumed.

    Those up to it are read past, and compared with what the tracker remembers: its first scans and images,
    its newest scan and the masks of its window.

    Raises:
        DataError: the tracker was saved on another drive, or on other frames of it.
    """
    comparison, frames, following = _DriveComparison(tracker), iter(source), list[Frame]()
    newest_ns = tracker.inputs.scan_order.newest_ns
    for frame in frames:
        stamp_ns = _newest(frame)
        if newest_ns is None or (stamp_ns is not None and stamp_ns > newest_ns):
            following.append(frame)
            break
        comparison.compare(frame.scan, frame.image)
    if why := comparison.difference():
        drive = "that of the drive it is resumed on"
        raise DataError(place, f"a tracker of another drive ({why} in {source.name})", drive)
    return chain(following, frames)


class _DriveComparison:
    """A drive's frames against those that a tracker has used."""

    def __init__(self, tracker: Tracker) -> None:
        self._camera, self._newest = tracker.setup.camera, tracker.inputs.last_scan
        self._digests = dict(tracker.inputs.first_frames.digests)
        if self._newest is not None:
            self._digests["scan", self._newest.stamp_ns] = _digest(self._newest)
        self._masks = {image.stamp_ns: image.mask for image in tracker.inputs.window.images}
        self._others: list[str] = []

    def compare(self, scan: Scan | None, image: CameraImage | None) -> None:
        """One frame."""
        try:
            if scan is not None:
                self._compare(checked_scan(scan))
            if image is not None:
                checked = checked_image(image, self._camera)
                self._compare(checked)
                mask = self._masks.get(checked.stamp_ns)
                if mask is not None and not np.array_equal(mask, checked.mask):
                    self._others.append(f"another image of {checked.stamp_ns} ns")
        except DataError:
            return  # the tracker refused it, too

    def _compare(self, data: Scan | CameraImage) -> None:
        expected = self._digests.pop((_sensor(data), data.stamp_ns), None)
        if expected is not None and _digest(data) != expected:
            self._others.append(f"another {_sensor(data)} of {data.stamp_ns} ns")

    def difference(self) -> str:
        """Frames that differ or are missing, in words; empty where none does."""
        missing = [f"no {sensor} of {stamp_ns} ns" for sensor, stamp_ns in self._digests]
        return next(iter([*self._others, *missing]), "")


def _newest(frame: Frame) -> int | None:
    """Stamp of a frame's scan, or of its image where it has none."""
    data = frame.scan if frame.scan is not None else frame.image
    return None if data is None else data.stamp_ns


def _sensor(data: Scan | CameraImage) -> str:
    return "scan" if isinstance(data, Scan) else "image"


def _digest(data: Scan | CameraImage) -> str:
    """SHA-256 of all arrays, their names and shapes."""
    digest = hashlib.sha256()
    for name in [one.name for one in fields(data)]:
        value = getattr(data, name)
        if isinstance(value, np.ndarray):
            digest.update(f"{name} {value.dtype.str} {value.shape};".encode())
            digest.update(np.ascontiguousarray(value).data)
    return digest.hexdigest()


def _flat(table: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Nested settings by their whole names."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= _flat(value, f"{where}{name}.") if isinstance(value, dict) else {where + name: value}
    return found


def _same(a: gtsam.Pose3 | None, b: gtsam.Pose3 | None) -> bool:
    return a is b or (a is not None and b is not None and a.equals(b, 1e-9))


def _start_text(setup: Setup) -> str:
    if setup.initial is None:
        return "--init none"
    translation = ", ".join(f"{x:.4g}" for x in setup.initial.translation())
    turn = ", ".join(f"{x:.4g}" for x in gtsam.Rot3.Logmap(setup.initial.rotation()))
    return f"T_camera_lidar [{turn}] rad, [{translation}] m with {setup.initial_time_offset_s:.4g} s (--init)"
