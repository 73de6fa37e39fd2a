"""Drives in the layout of KITTI odometry with SemanticKITTI labels and Cityscapes masks.

Below ``PATH/sequences/NN`` (or below PATH itself): ``calib.txt``, ``times.txt``, ``velodyne``, ``labels``,
``image_2`` and ``semantic_2``; where present also ``instance_2`` (uint16, class * 256 + instance),
``velodyne_times`` (float32 seconds relative to the stamp, one a point), ``groundtruth.json`` and
``times_2.txt``: stamps of the images of image_2 by a clock of their own, one a line. ``times.txt`` then
stamps the scans alone.

Some labels, masks and pictures may be missing: where nothing is labelled nothing is associated, and an image
without its picture has no features. Points that are NaN, inf or at the origin are left out and counted.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import are_returns, read_offsets, read_points
from sst_graph.data.images import picture_size, read_instances
from sst_graph.data.info.facts import SensorFacts, SourceFacts
from sst_graph.data.kitti.calib import read_calibration
from sst_graph.data.kitti.odometry_layout import (
    LAYOUT,
    FrameCounts,
    KittiFiles,
    check_camera,
    find_files,
    find_sequence,
    image_times_path,
    is_kitti,
)
from sst_graph.data.kitti.truth import drive_truth
from sst_graph.data.pictures import PictureFiles, check_scale, mask_encoding, point_labels
from sst_graph.data.point_times import tells_nothing
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source import Loader, SourceOptions
from sst_graph.data.two_clocks import DriveProperties, IndexedSource, Sensor, TwoClockSource, merged
from sst_graph.errors import ConfigError, printable
from sst_graph.sweep_timing import SweepTiming
from sst_graph.timestamps import read_times
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, with_intensities

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class KittiSource(IndexedSource):
    """A KITTI drive that satisfies :class:`~sst_graph.types.Source`; a slice of it is one as well.

    Made by :func:`open_kitti`. ``indices`` are those of the scans.

    Attributes:
        files: paths of the drive.
        stamps_ns: (n,) stamps of times.txt [ns]; scan k and image k share the stamp k.
        options: how the drive is read: frame k shows image k + ``options.image_shift``.
        pictures: pictures and masks.
        timing: times of the points by azimuth, where the options name a sense of rotation.
    """

    files: KittiFiles
    stamps_ns: NDArray[np.int64]
    options: SourceOptions
    pictures: PictureFiles
    timing: SweepTiming | None = None

    def _frame(self, position: int) -> Frame:
        index = self._index(position)
        scan, image = self._scan(index), self._image(index)
        if image is not None:
            image = replace(image, instances=self.instances(index))
        return Frame(index, scan, image)

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position; errors as of the frame."""
        return self._scan(self._index(position))

    def read_image(self, position: int) -> CameraImage | None:
        """Image of the frame at a position, without instances; errors as of the frame."""
        return self._image(self._index(position))

    def facts(self) -> SourceFacts:
        """Folders and stamps."""
        shift, images = self.options.image_shift, self.files.images or self.files.masks
        with_scan = [k for k in self.indices if k in self.files.scans]
        with_image = [k for k in self.indices if k + shift in self.files.image_numbers]
        missing = self.files.missing()
        return SourceFacts(
            scan=SensorFacts(_folder(self.files.scans), self.stamps_ns[with_scan]),
            image=SensorFacts(_folder(images), self.stamps_ns[with_image]),
            nominal=self.properties.nominal_reason,
            notes=(
                "scans and images have the same stamps, those of times.txt",
                *([missing] if missing else []),
            ),
        )

    def _scan(self, index: int) -> Scan | None:
        return self.scan(index) if index in self.files.scans else None

    def scan(self, index: int) -> Scan:
        """Scan of an index that has one; errors as of the frame."""
        path = self.files.scans[index]
        points, intensities = read_points(path)
        used = are_returns(points)
        classes, instances = point_labels(self.files.labels.get(index), used, path)
        offsets_s = self._offsets(index, points, used)
        points = np.ascontiguousarray(points[used])
        scan = Scan(
            stamp_ns=int(self.stamps_ns[index]),
            points=points,
            classes=classes,
            instances=instances,
            offsets_s=None if offsets_s is None else offsets_s[used],
            rings=rings_from_order(points),
            left_out=len(used) - len(points),
        )
        return with_intensities(scan, None if intensities is None else intensities[used])

    def _offsets(
        self, index: int, points: NDArray[np.float32], used: NDArray[np.bool_]
    ) -> NDArray[np.float32] | None:
        if self.timing is not None:
            return self.timing.offsets_s(points)
        if self.sweep == "auto" and self.files.point_times is not None:
            offsets_s = read_offsets(self.files.point_times[index], used)
            return None if tells_nothing(offsets_s[used]) else offsets_s
        return None

    def _image(self, index: int) -> CameraImage | None:
        number = index + self.options.image_shift
        if number not in self.files.image_numbers:
            return None
        return self.pictures.image(number, int(self.stamps_ns[index]))

    def instances(self, index: int) -> NDArray[np.uint16] | None:
        """Instances (h, w) of the image of an index, or None; errors as of the frame."""
        path = self.files.instances.get(index + self.options.image_shift)
        return None if path is None else read_instances(path, (self.camera.width, self.camera.height))


def open_kitti(path: Path, options: SourceOptions) -> KittiSource | TwoClockSource:
    """Open a drive in KITTI's layout; one with image stamps of its own has two clocks.

    Raises:
        DataError: a file or line is missing, counts disagree, stamps do not rise.
        ConfigError: no such sequence, camera or range of frames.
    """
    folder = find_sequence(path, options.sequence)
    check_camera(folder, options.camera)
    calibration = read_calibration(folder / "calib.txt")
    nominal = None if calibration.c0Tl is None else calibration.cTl(options.camera)
    stamps_ns = read_times(folder / "times.txt")
    image_times = image_times_path(folder, options.camera)
    image_stamps_ns = None if image_times is None else read_times(image_times)
    counts = FrameCounts(len(stamps_ns), None if image_stamps_ns is None else len(image_stamps_ns))
    files = find_files(folder, options.camera, options.cloud, counts)
    timing = options.timing(stamps_ns)
    first = next(iter(files.images.values()))
    size, P = picture_size(first), calibration.projection(options.camera)
    check_scale(first, size, files.masks, (float(P[0, 2]), float(P[1, 2])))
    if missing := files.missing():
        _LOG.info("%s: %s", printable(folder), missing)
    truth, is_reference = drive_truth(folder, calibration, options.camera)
    camera = calibration.camera(options.camera, *size)
    sweep = options.sweep, options.sweep_stamp
    reason = "calib.txt has no line Tr" if nominal is None else "by calib.txt"
    properties = DriveProperties(_name(folder), camera, nominal, truth, is_reference, *sweep, reason)
    encoding = mask_encoding(files.masks, options.label_encoding, size)
    pictures = PictureFiles(size, files.images, files.masks, encoding)
    if image_stamps_ns is not None:
        unshifted = replace(options, image_shift=0)
        source = KittiSource(properties, (), files, stamps_ns, unshifted, pictures, timing)
        return _with_image_stamps(source, image_stamps_ns, options, folder)
    indices = _select(files, options, len(stamps_ns))
    shift = options.image_shift
    pairs = [k for k in indices if k in files.scans and k + shift in files.image_numbers]
    properties = replace(properties, truth=_shifted(truth, stamps_ns, pairs, shift))
    return KittiSource(properties, indices, files, stamps_ns, options, pictures, timing)


def _with_image_stamps(
    source: KittiSource, image_stamps_ns: NDArray[np.int64], options: SourceOptions, folder: Path
) -> TwoClockSource:
    """The drive with images stamped by their own clock (n,) [ns], by number."""
    scans, images = np.array(list(source.files.scans)), np.array(sorted(source.files.image_numbers))
    pictures = source.pictures

    def scan(k: int) -> Scan:
        return source.scan(int(scans[k]))

    def image(k: int) -> CameraImage:
        return pictures.image(int(images[k]), int(image_stamps_ns[images[k]]))

    def instances(k: int) -> NDArray[np.uint16] | None:
        return source.instances(int(images[k]))

    files, missing = source.files, source.files.missing()
    of_scans = Sensor(source.stamps_ns[scans], scan, _folder(files.scans))
    place = _folder(files.images or files.masks)
    of_images = Sensor(image_stamps_ns[images], image, place, instances=instances)
    properties = replace(source.properties, notes=(missing,) if missing else ())
    return merged(properties, of_scans, of_images, options, folder, scans_are_complete=True)


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


def _shifted(
    truth: GroundTruth | None, stamps_ns: NDArray[np.int64], pairs: list[int], shift: int
) -> GroundTruth | None:
    """Truth after images are stamped as those ``shift`` before: the mean stamp difference is added."""
    if truth is None or truth.time_offset_s is None:
        return truth
    ks = np.array(pairs)
    seconds = float(np.mean(stamps_ns[ks + shift] - stamps_ns[ks])) * 1e-9
    return replace(truth, time_offset_s=truth.time_offset_s + seconds)


def _folder(files: Mapping[int, Path]) -> str:
    return printable(next(iter(files.values())).parent) if files else ""


def _name(folder: Path) -> str:
    """Data set and sequence; bytes of a folder's name that are not UTF-8 are escaped."""
    folder = Path(os.path.realpath(folder))
    sequence = folder.parent.name == "sequences"
    name = f"{folder.parent.parent.name}/{folder.name}" if sequence else folder.name
    return printable(os.fsencode(name).decode("utf-8", "backslashreplace"))


KITTI_LOADER = Loader(recognizes=is_kitti, open=open_kitti, layout=LAYOUT)
