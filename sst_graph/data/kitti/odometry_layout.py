"""Paths of the files of a KITTI drive, and whether they belong together."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sst_graph.data.arrays import check_stamped, listed, numbered_files, optional_files
from sst_graph.errors import ConfigError, DataError, count_of

LAYOUT = "KITTI odometry: PATH/sequences/NN with calib.txt, times.txt, velodyne, image_2"

_PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class KittiFiles:
    """Paths of a drive by frame number; some labels, pictures and masks may be missing.

    Attributes:
        scans: point clouds.
        labels: of the scans that have them.
        point_times: per-point times of every scan, or None.
        images: pictures.
        masks: semantic masks, of the same or of other numbers.
        instances: instance masks; empty where there is no folder of them.
    """

    scans: Mapping[int, Path]
    labels: Mapping[int, Path]
    point_times: Mapping[int, Path] | None
    images: Mapping[int, Path]
    masks: Mapping[int, Path]
    instances: Mapping[int, Path]

    @cached_property
    def image_numbers(self) -> frozenset[int]:
        """Numbers that have a picture or a mask."""
        return frozenset(self.images) | frozenset(self.masks)

    def missing(self) -> str:
        """What is missing, in words and numbers; empty where nothing is."""
        owners = (
            ("scan", "without labels", set(self.scans) - set(self.labels)),
            ("label", "without a scan", set(self.labels) - set(self.scans)),
            ("picture", "without a mask", set(self.images) - set(self.masks)),
            ("mask", "without a picture", set(self.masks) - set(self.images)),
        )
        return ", ".join(
            f"{count_of(len(lonely), what)} {without} (first: {min(lonely)})"
            for what, without, lonely in owners
            if lonely
        )


def is_kitti(path: Path) -> bool:
    """Whether a folder is a sequence in KITTI's layout, or holds some."""
    return (path / "sequences").is_dir() or _is_sequence(path)


def find_sequence(path: Path, sequence: str | None) -> Path:
    """Folder of the sequence: ``path`` itself, ``path/sequences/NN``, or the only one there is.

    Raises:
        DataError: no sequence.
        ConfigError: several and none named, or none of this name.
    """
    if not (path / "sequences").is_dir():
        if not path.is_dir():
            raise DataError(path, "no folder", LAYOUT)
        if not _is_sequence(path):
            raise DataError(path, "neither a folder sequences nor calib.txt", LAYOUT)
        if sequence not in (None, Path(os.path.realpath(path)).name):
            raise ConfigError(f"sequence {sequence!r}: {path} is itself the folder of a sequence")
        return path
    folders = listed(path / "sequences", "folders 00, 01, ...")
    names = [entry.name for entry in folders if entry.is_dir()]
    if not names:
        raise DataError(path / "sequences", "an empty folder", "folders 00, 01, ...")
    if sequence is None:
        if len(names) > 1:
            raise ConfigError(
                f"{path}: several sequences ({', '.join(names)}): name one of them (--sequence)"
            )
        return path / "sequences" / names[0]
    matches = [name for name in names if name in (sequence, sequence.zfill(2))]
    if not matches:
        raise ConfigError(f"sequence {sequence!r}: {path} has {', '.join(names)}")
    return path / "sequences" / matches[0]


@dataclass(frozen=True)
class FrameCounts:
    """Stamps of a drive: of its frames, and of its images where these have their own."""

    stamps: int
    image_stamps: int | None = None


def check_camera(folder: Path, camera: str) -> None:
    """Refuse a camera that the sequence has no folder of.

    Raises:
        ConfigError: the cameras there are listed.
    """
    if not camera.startswith("image_"):
        raise ConfigError(f"camera {camera!r}: expected image_N, as in image_2")
    if not os.path.lexists(folder / camera):
        there = sorted(name for name in os.listdir(folder) if re.fullmatch(r"image_\d+", name))
        if there:
            raise ConfigError(f"camera {camera!r}: {folder} has {', '.join(there)}")


def image_times_path(folder: Path, camera: str) -> Path | None:
    """File with the images' own stamps, ``times_2.txt`` of image_2, where there is one."""
    path = folder / f"times_{camera.removeprefix('image_').lstrip('0') or '0'}.txt"
    return path if os.path.lexists(path) else None


def find_files(folder: Path, camera: str, cloud: str, counts: FrameCounts) -> KittiFiles:
    """Files of a sequence, checked against each other and against the number of stamps.

    The folders of labels and of masks may be missing. A number that has neither a scan nor labels is a gap,
    and so is one with neither image nor mask. What has lost its partner is left to
    :meth:`KittiFiles.missing`. Labels may go on after the last scan of another ``cloud`` than "velodyne".

    Raises:
        DataError: an empty folder, no folder of scans or images, a scan without its times, more or fewer
            frames than stamps, labels of no scan, masks of no picture.
    """
    scans = numbered_files(folder / cloud, (".bin",))
    labels = optional_files(folder / "labels", (".label",))
    images = numbered_files(folder / camera, _PICTURES)
    masks = optional_files(folder / camera.replace("image", "semantic"), (".png",))
    if counts.image_stamps is None:
        _check_stamps(folder / "times.txt", counts.stamps, {**scans, **images, **masks}, "frames")
    else:
        _check_stamps(folder / "times.txt", counts.stamps, scans, "scans")
        times = image_times_path(folder, camera) or folder
        _check_stamps(times, counts.image_stamps, {**images, **masks}, "images")
    if cloud != "velodyne":
        labels = {k: path for k, path in labels.items() if k <= max(scans)}
    if labels:
        _check_some_partner(scans, labels, folder / "labels")
    if masks:
        _check_some_partner(images, masks, folder / camera.replace("image", "semantic"))
    return KittiFiles(
        scans=scans,
        labels=labels,
        point_times=_point_times(folder / f"{cloud}_times", scans),
        images=images,
        masks=masks,
        instances=optional_files(folder / camera.replace("image", "instance"), (".png",)),
    )


def _is_sequence(path: Path) -> bool:
    return (path / "calib.txt").is_file() or (path / "velodyne").is_dir()


def _check_stamps(times: Path, stamps: int, files: Mapping[int, Path], what: str) -> None:
    """Require a stamp for each number up to the last file's, and no more."""
    check_stamped(times, stamps, files, what)
    last = max(files)
    if stamps > last + 1:
        found = f"{count_of(stamps, 'stamp')} for {len(files)} {what}"
        raise DataError(times, found, f"{last + 1}: the last file's number is {files[last].stem}")


def _point_times(folder: Path, scans: Mapping[int, Path]) -> dict[int, Path] | None:
    """Times of the points: of every scan, or of none."""
    if not folder.is_dir():
        return None
    files = numbered_files(folder, (".bin",))
    lonely = sorted(set(scans) - set(files))
    if lonely:
        raise DataError(
            folder, f"no file for frame {lonely[0]}", f"one for each of {count_of(len(scans), 'frame')}"
        )
    return files


def _check_some_partner(owners: Mapping[int, Path], partners: Mapping[int, Path], folder: Path) -> None:
    if not set(owners) & set(partners):
        first = next(iter(owners.values()))
        raise DataError(folder, "no file with the number of one beside it", f"a partner of {first}")
