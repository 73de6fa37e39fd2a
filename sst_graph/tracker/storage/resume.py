"""Whether a stored tracker belongs to a drive, to its sensors and to the settings it is resumed with."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, fields
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import to_dict
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.timestamps import LATEST_NS
from sst_graph.tracker.config import TrackerConfig
from sst_graph.types import CameraImage, Frame, Scan, Source
from sst_graph.validation import checked_image, checked_scan

if TYPE_CHECKING:
    from sst_graph.tracker.tracker import Tracker

_FIRST, MOST = 3, 50_000
"""First and latest scans, and images, by which a drive is recognized: 83 minutes at 10 Hz, 16 bytes each."""


@dataclass(frozen=True)
class Setup:
    """What a tracker is made with.

    Attributes:
        camera: of its images.
        config: all settings.
        initial: guess of cTl, or None.
        initial_time_offset_s: guess of the time offset [s].
        image_shift: of its drive (:func:`~sst_graph.data.open_source`): image k + image_shift has the stamp
            of image k.
    """

    camera: PinholeCamera
    config: TrackerConfig
    initial: gtsam.Pose3 | None
    initial_time_offset_s: float
    image_shift: int = 0

    def differences(self, other: Setup) -> list[str]:
        """In what another one differs: "name, and not the other's"."""
        mine, others = _flat(to_dict(self.config)), _flat(to_dict(other.config))
        found = [
            f"setting {name} = {mine.get(name)}, not {others.get(name)}"
            for name in {**mine, **others}
            if mine.get(name) != others.get(name)
        ]
        if self.image_shift != other.image_shift:
            found.append(f"--image-shift {self.image_shift}, not {other.image_shift}")
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
class SeenFrames:
    """Stamps and contents of the scans and images that a tracker took in, the first and the latest of them.

    Attributes:
        scans, images: (n, 2) stamp [ns], and CRC-32 of all arrays.
    """

    scans: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    images: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def add(self, data: Scan | CameraImage) -> None:
        """A scan or an image that was used."""
        row = np.array([[data.stamp_ns, _digest(data)]])
        if isinstance(data, Scan):
            self.scans = _with_row(self.scans, row)
        else:
            self.images = _with_row(self.images, row)

    @property
    def is_whole(self) -> bool:
        """Whether they are rows as they were made here."""
        return all(rows.dtype == np.int64 and rows.shape[1:] == (2,) for rows in (self.scans, self.images))

    def digests(self) -> dict[tuple[str, int], int]:
        """By sensor and stamp [ns]."""
        both = (("scan", self.scans), ("image", self.images))
        return {(sensor, stamp_ns): digest for sensor, rows in both for stamp_ns, digest in rows.tolist()}


def _with_row(rows: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
    kept = rows if len(rows) < _FIRST + MOST else np.delete(rows, _FIRST, axis=0)
    return np.concatenate([kept, row])


def check_inputs(tracker: Tracker) -> None:
    """Refuse a tracker whose setup or inputs are not what the functions here compare.

    Raises:
        ValueError: it is not.
    """
    setup, inputs = tracker.setup, tracker.inputs
    whole = isinstance(setup, Setup) and isinstance(inputs.seen, SeenFrames) and inputs.seen.is_whole
    orders = (inputs.scan_order, inputs.image_order)
    whole = whole and all(isinstance(order.newest_ns, int | None) for order in orders)
    if not whole or (setup.camera, setup.config.estimating) != (inputs.camera, inputs.config):
        raise ValueError("inputs of another tracker")


def check_setup(tracker: Tracker, setup: Setup, place: str | Path) -> None:
    """Refuse a tracker that was made with another camera, other settings, pairs or another guess.

    Raises:
        DataError: it was; each difference is named.
    """
    if found := tracker.setup.differences(setup):
        some = "; ".join(found[:5]) + (f"; and {len(found) - 5} more" if len(found) > 5 else "")
        raise DataError(place, f"a tracker with {some}", "what it was made with (or a new tracker)")


def frames_to_come(tracker: Tracker, source: Source, place: str | Path) -> Iterator[Frame]:
    """The frames of a drive behind the newest scan and the newest image of a tracker that was resumed.

    Those up to them are read past, and compared with what the tracker remembers: every scan and image that it
    used, of more than MOST the first and the latest.

    Raises:
        DataError: the tracker was saved on another drive, or on other frames of it.
    """
    comparison, frames, following = _DriveComparison(tracker), iter(source), list[Frame]()
    for frame in frames:
        if not comparison.is_past(frame):
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
        inputs = tracker.inputs
        self._camera, self._expected = tracker.setup.camera, inputs.seen.digests()
        orders = {"scan": inputs.scan_order, "image": inputs.image_order}
        self._newest_ns = {
            sensor: -LATEST_NS if order.newest_ns is None else order.newest_ns
            for sensor, order in orders.items()
        }
        self._read_past = set(self._expected)
        self._others: list[str] = []

    def is_past(self, frame: Frame) -> bool:
        """Whether the tracker has used a later one, or its scan or image; each sensor has its own clock."""
        given = [data for data in (frame.scan, frame.image) if data is not None]
        return any(data.stamp_ns <= self._newest_ns[_sensor(data)] for data in given)

    def compare(self, scan: Scan | None, image: CameraImage | None) -> None:
        """One frame; what cannot be used, the tracker has refused, too."""
        if scan is not None:
            with suppress(DataError):
                self._compare(checked_scan(scan))
        if image is not None:
            with suppress(DataError):
                self._compare(checked_image(image, self._camera))

    def _compare(self, data: Scan | CameraImage) -> None:
        key = _sensor(data), data.stamp_ns
        self._read_past.discard(key)
        if key in self._expected and _digest(data) != self._expected[key]:
            self._others.append(f"another {_sensor(data)} of {data.stamp_ns} ns")

    def difference(self) -> str:
        """Frames that differ or are missing, in words; empty where none does."""
        missing = [f"no {sensor} of {stamp_ns} ns" for sensor, stamp_ns in sorted(self._read_past)]
        return next(iter([*self._others, *missing]), "")


def _sensor(data: Scan | CameraImage) -> str:
    return "scan" if isinstance(data, Scan) else "image"


def _digest(data: Scan | CameraImage) -> int:
    """CRC-32 of all arrays, their names and shapes: it finds other data, not forgeries, in half of the time
    of a SHA-256."""
    digest = 0
    for name in [one.name for one in fields(data)]:
        value = getattr(data, name)
        if isinstance(value, np.ndarray):
            digest = zlib.crc32(f"{name} {value.dtype.str} {value.shape};".encode(), digest)
            digest = zlib.crc32(np.ascontiguousarray(value).data, digest)
    return digest


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
