"""Paths and stamps of a KITTI raw drive."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import check_stamped, listed, numbered_files, optional_files
from sst_graph.data.kitti.raw_calib import CAM_TO_CAM
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.files.reading import FileKind, read_text
from sst_graph.timestamps import MAX_STAMPS, NS_PER_S, check_rising, checked_ns

LAYOUT = f"KITTI raw: DATE with {CAM_TO_CAM} and DATE_drive_NNNN_sync with velodyne_points, image_0N"
TIMESTAMPS = FileKind("timestamps of KITTI raw, one a line", 64 * 1024 * 1024)

_CLOUD = "velodyne_points"
_DRIVE = re.compile(r".*_drive_(\d{4})_(sync|extract)", re.ASCII)
_STAMP = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?", re.ASCII)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, eq=False)
class SweepTimes:
    """Starts and ends of the sweeps (n,) [ns]; line k is that of scan k."""

    starts_ns: NDArray[np.int64]
    ends_ns: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RawFiles:
    """A drive's files by number, and the stamps of all numbers.

    Attributes:
        scans: point clouds, .bin or .txt.
        labels, pictures, masks: of the numbers that have them.
        scan_stamps_ns, image_stamps_ns: (n,) of the numbers 0 to n - 1 [ns].
        sweeps: starts and ends of the sweeps, where the drive has them.
    """

    scans: Mapping[int, Path]
    labels: Mapping[int, Path]
    pictures: Mapping[int, Path]
    masks: Mapping[int, Path]
    scan_stamps_ns: NDArray[np.int64]
    image_stamps_ns: NDArray[np.int64]
    sweeps: SweepTimes | None


def is_raw(path: Path) -> bool:
    """Whether a folder is a drive of KITTI raw, or holds some."""
    return (path / _CLOUD).is_dir() or (path.is_dir() and bool(_drives(path)))


def find_drive(path: Path, sequence: str | None) -> Path:
    """Folder of the drive: ``path`` itself, or the only one below it, or the one of a name or number.

    Raises:
        DataError: no drive.
        ConfigError: several and none named, or none of this name.
    """
    if (path / _CLOUD).is_dir():
        if sequence is not None and sequence not in _names(path):
            raise ConfigError(f"sequence {sequence!r}: {path} is itself the folder of a drive")
        return path
    drives = _drives(path)
    if not drives:
        raise DataError(path, "no drive", LAYOUT)
    found = [drive for drive in drives if sequence is None or sequence in _names(drive)]
    if len(found) != 1:
        named = ", ".join(drive.name for drive in drives)
        asked = "name one of them (--sequence)" if sequence is None else f"{len(found)} are {sequence!r}"
        raise ConfigError(f"{path}: drives {named}: {asked}")
    return found[0]


def calibration_folder(drive: Path) -> Path:
    """Folder with the calibration of a drive: the drive's own, or that of its day.

    Raises:
        DataError: neither has one.
    """
    for folder in (drive, drive.resolve().parent):
        if (folder / CAM_TO_CAM).exists():
            return folder
    raise DataError(drive, f"no {CAM_TO_CAM} in it or beside it", LAYOUT)


def find_raw_files(drive: Path, camera: int) -> RawFiles:
    """Files and stamps of a drive; a number without its file was dropped.

    Raises:
        DataError: no scan, no image, a file without its stamp, stamps that do not rise.
        ConfigError: no such camera, where there are others.
    """
    cloud, images = drive / _CLOUD, drive / f"image_{camera:02d}"
    there = [entry.name for entry in listed(drive, LAYOUT) if re.fullmatch(r"image_\d\d", entry.name)]
    if there and images.name not in there:
        raise ConfigError(f"camera {images.name!r}: {drive} has {', '.join(there)} (--camera)")
    scans = numbered_files(cloud / "data", (".bin", ".txt"))
    pictures = numbered_files(images / "data", (".png", ".jpg", ".jpeg"))
    scan_stamps, image_stamps = (read_timestamps(folder / "timestamps.txt") for folder in (cloud, images))
    check_stamped(cloud / "timestamps.txt", len(scan_stamps), scans, "scans")
    check_stamped(images / "timestamps.txt", len(image_stamps), pictures, "images")
    return RawFiles(
        scans=scans,
        labels=optional_files(drive / "labels", (".label",)),
        pictures=pictures,
        masks=optional_files(drive / f"semantic_{camera:02d}", (".png",)),
        scan_stamps_ns=scan_stamps,
        image_stamps_ns=image_stamps,
        sweeps=_sweeps(cloud, len(scan_stamps)),
    )


def read_timestamps(path: Path) -> NDArray[np.int64]:
    """Stamps (n,) [ns] since 1970 of lines "2011-09-26 13:02:25.964389445", strictly rising.

    Raises:
        DataError: a missing or empty file, a line that is no such stamp, stamps that do not rise.
    """
    lines = read_text(path, TIMESTAMPS).rstrip().splitlines()
    if not 1 <= len(lines) <= MAX_STAMPS:
        raise DataError(path, count_of(len(lines), "line"), f"1 to {MAX_STAMPS} stamps")
    stamps_ns = np.array([_stamp(line, f"{path}:{k}") for k, line in enumerate(lines, 1)], np.int64)
    check_rising(stamps_ns, path)
    return stamps_ns


def _stamp(line: str, place: str) -> int:
    match = _STAMP.fullmatch(line.strip())
    try:
        if match is None:
            raise ValueError
        moment = datetime.fromisoformat(match.group(1)).replace(tzinfo=UTC)
    except ValueError:
        raise DataError(place, f"{line!r:.60}", "a stamp as 2011-09-26 13:02:25.964389445") from None
    since = moment - _EPOCH
    seconds = since.days * 86400 + since.seconds
    return checked_ns(seconds * NS_PER_S + int((match.group(2) or "0").ljust(9, "0")), place)


def _sweeps(cloud: Path, count: int) -> SweepTimes | None:
    paths = (cloud / "timestamps_start.txt", cloud / "timestamps_end.txt")
    if not all(path.exists() for path in paths):
        return None
    starts, ends = (read_timestamps(path) for path in paths)
    for path, stamps in zip(paths, (starts, ends), strict=True):
        if len(stamps) != count:
            raise DataError(path, count_of(len(stamps), "stamp"), f"{count}, as in timestamps.txt")
    lengths = ends - starts
    if not ((lengths > 0) & (lengths < NS_PER_S)).all():
        k = int(np.argmin((lengths > 0) & (lengths < NS_PER_S)))
        raise DataError(f"{paths[1]}:{k + 1}", f"a sweep of {lengths[k] * 1e-9:g} s", "0 to 1 s")
    return SweepTimes(starts, ends)


def _drives(path: Path) -> list[Path]:
    """Drives in a folder, or in the folders of days in it."""
    entries = listed(path, LAYOUT)
    below = [drive for day in entries if os.path.isfile(day / CAM_TO_CAM) for drive in listed(day, LAYOUT)]
    return [
        entry
        for entry in (*entries, *below)
        if _DRIVE.fullmatch(entry.name) and os.path.isdir(entry / _CLOUD)
    ]


def _names(drive: Path) -> tuple[str, ...]:
    """Names by which a drive may be asked for: its folder's name, its number, both with its kind."""
    name = drive.resolve().name
    match = _DRIVE.fullmatch(name)
    if match is None:
        return (name,)
    number, kind = match.groups()
    return (name, number, number.lstrip("0") or "0", f"{number}_{kind}")
