"""Drives in the layout of KITTI odometry with SemanticKITTI labels and Cityscapes masks.

Below ``PATH/sequences/NN`` (or below PATH itself): ``calib.txt``, ``times.txt``, ``velodyne``, ``labels``,
``image_2`` and ``semantic_2``; where present also ``instance_2`` (uint16, class * 256 + instance),
``velodyne_times`` (float32 seconds relative to the stamp, one a point) and ``groundtruth.json``.

Some labels, masks and pictures may be missing: where nothing is labelled nothing is associated, and an image
without its picture has no features. Points that are NaN or inf are left out and counted.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import MaskEncoding, classes_of_mask, classes_of_points, guess_mask_encoding
from sst_graph.data.arrays import read_labels, read_offsets, read_points
from sst_graph.data.calib import read_calibration
from sst_graph.data.images import picture_size, read_instances, read_mask, read_picture
from sst_graph.data.info.facts import SensorFacts, SourceFacts
from sst_graph.data.kitti_layout import LAYOUT, KittiFiles, find_files, find_sequence, is_kitti
from sst_graph.data.kitti_truth import drive_truth
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source import TURNS, Loader, SourceOptions, Sweep
from sst_graph.errors import ConfigError, printable
from sst_graph.factors.camera import PinholeCamera
from sst_graph.sweep_timing import SweepStamp, SweepTiming
from sst_graph.timestamps import read_times
from sst_graph.types import NO_PICTURE, CameraImage, Frame, GroundTruth, Scan, SemanticClass

_LOG = logging.getLogger(__name__)

_MASKS_TO_JUDGE = 8
"""How many masks, spread over the drive, decide on their encoding."""


@dataclass(frozen=True, eq=False)
class KittiDrive:
    """What holds for every frame of a drive.

    Attributes:
        camera: intrinsics of the chosen camera.
        nominal: cTl of ``calib.txt``.
        truth: from ``groundtruth.json``, or else the published calibration as a reference.
        truth_is_reference: the truth is the published calibration: itself good to a tenth of a
            degree or so, not known to hold.
        encoding: of the masks.
        timing: times of the points by azimuth, where the options name a sense of rotation.
    """

    camera: PinholeCamera
    nominal: gtsam.Pose3
    truth: GroundTruth
    truth_is_reference: bool
    encoding: MaskEncoding
    timing: SweepTiming | None = None


@dataclass(frozen=True, eq=False)
class KittiSource:
    """A KITTI drive that satisfies :class:`~sst_graph.types.Source`; a slice of it is one as well.

    Made by :func:`open_kitti`.

    Attributes:
        name: data set and sequence, "kitti/00".
        drive: what holds for every frame.
        files: paths of the drive.
        stamps_ns: (n,) stamps of times.txt [ns]; scan k and image k share the stamp k.
        indices: scan index of each frame.
        options: how the drive is read: frame k shows image k + ``options.image_shift``.
    """

    name: str
    drive: KittiDrive
    files: KittiFiles
    stamps_ns: NDArray[np.int64]
    indices: tuple[int, ...]
    options: SourceOptions

    @property
    def camera(self) -> PinholeCamera:
        return self.drive.camera

    @property
    def nominal(self) -> gtsam.Pose3:
        return self.drive.nominal

    @property
    def truth(self) -> GroundTruth:
        return self.drive.truth

    @property
    def truth_is_reference(self) -> bool:
        """Whether the truth is the published calibration, not known to hold."""
        return self.drive.truth_is_reference

    @property
    def sweep(self) -> Sweep:
        """How the times of the points are found."""
        return self.options.sweep

    @property
    def sweep_stamp(self) -> SweepStamp:
        """The instant that a scan's stamp names where times follow from azimuths."""
        return self.options.sweep_stamp

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> KittiSource: ...
    def __getitem__(self, position: int | slice) -> Frame | KittiSource:
        """Frame at a position (read from disk), or the drive restricted to a slice of positions.

        Raises:
            DataError: a file of the frame is truncated, damaged or holds what it must not.
            IndexError: no frame at this position.
        """
        if isinstance(position, slice):
            return replace(self, indices=self.indices[position])
        index = self.indices[position]
        scan, image = self._scan(index), self._image(index)
        if image is not None:
            image = replace(image, instances=self._instances(index))
        return Frame(index, scan, image)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def frame_number(self, position: int) -> int:
        """Scan index of the frame at a position; nothing is read."""
        return self.indices[position]

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position; errors as of the frame."""
        return self._scan(self.indices[position])

    def read_image(self, position: int) -> CameraImage | None:
        """Image of the frame at a position, without instances; errors as of the frame."""
        return self._image(self.indices[position])

    def facts(self) -> SourceFacts:
        """Folders and stamps."""
        shift, images = self.options.image_shift, self.files.images or self.files.masks
        with_scan = [k for k in self.indices if k in self.files.scans]
        with_image = [k for k in self.indices if k + shift in self.files.image_numbers]
        missing = self.files.missing()
        return SourceFacts(
            scan=SensorFacts(_folder(self.files.scans), self.stamps_ns[with_scan]),
            image=SensorFacts(_folder(images), self.stamps_ns[with_image]),
            nominal="by calib.txt",
            notes=(
                "scans and images have the same stamps, those of times.txt",
                *([missing] if missing else []),
            ),
        )

    def _scan(self, index: int) -> Scan | None:
        path = self.files.scans.get(index)
        if path is None:
            return None
        points = read_points(path)
        # Beams without a return come as NaN from many drivers.
        used: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
        classes, instances = self._labels(index, used)
        offsets_s = self._offsets(index, points, used)
        points = np.ascontiguousarray(points[used])
        return Scan(
            stamp_ns=int(self.stamps_ns[index]),
            points=points,
            classes=classes,
            instances=instances,
            offsets_s=None if offsets_s is None else offsets_s[used],
            rings=rings_from_order(points),
            left_out=len(used) - len(points),
        )

    def _labels(self, index: int, used: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Classes and instances of a scan's used points; where it has no labels they may be anything."""
        path = self.files.labels.get(index)
        if path is None:
            count = int(used.sum())
            return np.full(count, SemanticClass.IGNORE, np.uint8), np.zeros(count, np.uint16)
        return classes_of_points(read_labels(path, len(used))[used], path)

    def _offsets(
        self, index: int, points: NDArray[np.float32], used: NDArray[np.bool_]
    ) -> NDArray[np.float32] | None:
        if self.drive.timing is not None:
            return self.drive.timing.offsets_s(points)
        if self.sweep == "auto" and self.files.point_times is not None:
            return read_offsets(self.files.point_times[index], used)
        return None

    def _image(self, index: int) -> CameraImage | None:
        number = index + self.options.image_shift
        if number not in self.files.image_numbers:
            return None
        return CameraImage(
            stamp_ns=int(self.stamps_ns[index]),
            mask=self._mask(self.files.masks.get(number)),
            pixels=self._pixels(self.files.images.get(number)),
        )

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height

    def _mask(self, path: Path | None) -> NDArray[np.uint8]:
        """Classes (h, w); where there is no mask every pixel may be anything."""
        if path is None:
            return np.full((self.camera.height, self.camera.width), SemanticClass.IGNORE, np.uint8)
        return classes_of_mask(read_mask(path, self._size), self.drive.encoding, path)

    def _pixels(self, path: Path | None) -> NDArray[np.uint8]:
        return NO_PICTURE if path is None else read_picture(path, self._size)

    def _instances(self, index: int) -> NDArray[np.uint16] | None:
        path = self.files.instances.get(index + self.options.image_shift)
        return None if path is None else read_instances(path, self._size)


def open_kitti(path: Path, options: SourceOptions) -> KittiSource:
    """Open a drive in KITTI's layout.

    Raises:
        DataError: a file or line is missing, counts disagree, stamps do not rise.
        ConfigError: no such sequence, camera or range of frames.
    """
    folder = find_sequence(path, options.sequence)
    calibration = read_calibration(folder / "calib.txt")
    nominal = calibration.cTl(options.camera)
    stamps_ns = read_times(folder / "times.txt")
    files = find_files(folder, options.camera, options.cloud, len(stamps_ns))
    if options.sweep in TURNS and len(stamps_ns) < 2:
        raise ConfigError(f"sweep {options.sweep!r}: the period of a turn needs two stamps or more")
    indices = _select(files, options, len(stamps_ns))
    size = picture_size(next(iter(files.images.values())))
    if missing := files.missing():
        _LOG.info("%s: %s", printable(folder), missing)
    truth, is_reference = drive_truth(folder, calibration, options.camera)
    pairs = [k for k in indices if k in files.scans and k + options.image_shift in files.image_numbers]
    drive = KittiDrive(
        camera=calibration.camera(options.camera, *size),
        nominal=nominal,
        truth=_shifted(truth, stamps_ns, pairs, options.image_shift),
        truth_is_reference=is_reference,
        encoding=_encoding(files, options, size),
        timing=_timing(options, stamps_ns),
    )
    return KittiSource(_name(folder), drive, files, stamps_ns, indices, options)


def _timing(options: SourceOptions, stamps_ns: NDArray[np.int64]) -> SweepTiming | None:
    """Times by azimuth where the options name a sense of rotation."""
    if options.sweep not in TURNS:
        return None
    start_rad, period_s = np.radians(options.sweep_start_deg), float(np.median(np.diff(stamps_ns))) * 1e-9
    return SweepTiming(TURNS[options.sweep], float(start_rad), period_s, options.sweep_stamp)


def _select(files: KittiFiles, options: SourceOptions, count: int) -> tuple[int, ...]:
    """Scan indices of the frames asked for that have a scan or an image."""
    chosen = options.frames or slice(None)
    first, last = chosen.start or 0, count if chosen.stop is None else chosen.stop
    if first >= count or last > count:
        raise ConfigError(f"frames {first}:{last}: the drive has frames 0:{count}")
    shift = options.image_shift
    indices = tuple(k for k in range(first, last) if k in files.scans or k + shift in files.image_numbers)
    if not any(k in files.scans and k + shift in files.image_numbers for k in indices):
        raise ConfigError(f"frames {first}:{last} with image shift {shift}: no scan is left with an image")
    return indices


def _shifted(truth: GroundTruth, stamps_ns: NDArray[np.int64], pairs: list[int], shift: int) -> GroundTruth:
    """Truth after images are stamped as those ``shift`` before: the mean stamp difference is added."""
    if truth.time_offset_s is None:
        return truth
    ks = np.array(pairs)
    seconds = float(np.mean(stamps_ns[ks + shift] - stamps_ns[ks])) * 1e-9
    return replace(truth, time_offset_s=truth.time_offset_s + seconds)


def _encoding(files: KittiFiles, options: SourceOptions, size: tuple[int, int]) -> MaskEncoding:
    if options.label_encoding != "auto":
        return MaskEncoding(options.label_encoding)
    paths = list(files.masks.values())
    chosen = np.unique(np.linspace(0, len(paths) - 1, _MASKS_TO_JUDGE).round().astype(int))
    return guess_mask_encoding((read_mask(paths[k], size) for k in chosen), paths[0].parent)


def _folder(files: Mapping[int, Path]) -> str:
    return printable(next(iter(files.values())).parent) if files else ""


def _name(folder: Path) -> str:
    """Data set and sequence; bytes of a folder's name that are not UTF-8 are escaped."""
    folder = Path(os.path.realpath(folder))
    sequence = folder.parent.name == "sequences"
    name = f"{folder.parent.parent.name}/{folder.name}" if sequence else folder.name
    return printable(os.fsencode(name).decode("utf-8", "backslashreplace"))


KITTI_LOADER = Loader(recognizes=is_kitti, open=open_kitti, layout=LAYOUT)
