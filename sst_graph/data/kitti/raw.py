"""KITTI raw drives, ``_sync`` and ``_extract``: each sensor with the stamps of its own ``timestamps.txt``.

SemanticKITTI labels and Cityscapes masks stand beside them where there are any: ``labels/NNNNNNNNNN.label``
and ``semantic_0N/NNNNNNNNNN.png``, by the numbers of scans and images; ``groundtruth.json`` as in the
odometry layout. Pictures are rectified or not by their size, or else by the folder's name.

Points as measured (``sweep`` clockwise or counterclockwise) get their times from the start and the end of
their own sweep (``timestamps_start.txt``, ``timestamps_end.txt``); without these files from the median
period.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import CameraModel, Rectification
from sst_graph.data.arrays import MAX_POINTS, are_returns, check_metres, read_points
from sst_graph.data.images import picture_size
from sst_graph.data.kitti.raw_calib import (
    CAM_TO_CAM,
    VELO_TO_CAM,
    RawCalibration,
    raw_camera_number,
    read_raw_calibration,
)
from sst_graph.data.kitti.raw_layout import (
    LAYOUT,
    SweepTimes,
    calibration_folder,
    find_drive,
    find_raw_files,
    is_raw,
)
from sst_graph.data.kitti.truth import read_truth
from sst_graph.data.pictures import PictureFiles, mask_encoding, point_labels
from sst_graph.data.rectified import RectifiedSource
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source import Loader, SourceOptions
from sst_graph.data.two_clocks import DriveProperties, Sensor, merged
from sst_graph.errors import DataError, count_of, printable
from sst_graph.files.reading import FileKind, read_text
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import CameraImage, GroundTruth, Scan, Source, with_intensities

TEXT_SCAN = FileKind("a cloud of lines x y z r", 64 * 1024 * 1024)


@dataclass(frozen=True)
class TurnTimes:
    """Times of points by azimuth and by the start and end of their own sweep.

    Attributes:
        timing: of a turn of the median period.
        sweeps: starts and ends; None: a turn takes the period.
    """

    timing: SweepTiming
    sweeps: SweepTimes | None

    def offsets_s(self, number: int, stamp_ns: int, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Times (n,) of the points (n, 3) of a scan after its stamp [s]."""
        if self.sweeps is None:
            return self.timing.offsets_s(points)
        start_ns, end_ns = int(self.sweeps.starts_ns[number]), int(self.sweeps.ends_ns[number])
        turn = replace(self.timing, period_s=(end_ns - start_ns) * 1e-9, stamp="start")
        return turn.offsets_s(points) + np.float32((start_ns - stamp_ns) * 1e-9)


@dataclass(frozen=True)
class RawScans:
    """Scans of a drive by number.

    Attributes:
        scans, labels: paths; some labels may be missing.
        turn: times of the points, where they are asked for.
    """

    scans: Mapping[int, Path]
    labels: Mapping[int, Path]
    turn: TurnTimes | None

    def scan(self, number: int, stamp_ns: int) -> Scan:
        """Scan of a number.

        Raises:
            DataError: a file is damaged or holds what it must not.
        """
        path = self.scans[number]
        is_text = path.suffix.lower() != ".bin"
        points, intensities = read_text_points(path) if is_text else read_points(path)
        used = are_returns(points)
        classes, instances = point_labels(self.labels.get(number), used, path)
        points = np.ascontiguousarray(points[used])
        offsets_s = None if self.turn is None else self.turn.offsets_s(number, stamp_ns, points)
        left_out = len(used) - len(points)
        rings = rings_from_order(points)
        scan = Scan(stamp_ns, points, classes, instances, offsets_s, rings, left_out)
        return with_intensities(scan, None if intensities is None else intensities[used])


def read_text_points(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points (n, 3) float32 [m] and reflectances (n,) of a cloud in text: x y z r a line.

    Raises:
        DataError: a missing file, a line with other than four numbers, a coordinate that is no length.
    """
    text = read_text(path, TEXT_SCAN)
    if text.count("\n") > MAX_POINTS:
        raise DataError(path, count_of(text.count(chr(10)), "line"), f"at most {MAX_POINTS}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without lines
            values = np.loadtxt(io.StringIO(text), np.float32, comments=None, ndmin=2)
    except ValueError as error:
        raise DataError(path, f"no numbers ({str(error).splitlines()[0]})", "lines of x y z r") from None
    if values.size and values.shape[1] != 4:
        raise DataError(path, f"{count_of(values.shape[1], 'number')} a line", "4: x y z r")
    values = values.reshape(-1, 4)
    points = np.ascontiguousarray(values[:, :3])
    check_metres(points, path)
    return points, np.ascontiguousarray(values[:, 3])


def open_raw(path: Path, options: SourceOptions) -> Source:
    """Open a drive of KITTI raw; images of a lens that distorts are rectified as they are read.

    Raises:
        DataError: a file or line is missing or damaged, stamps do not rise.
        ConfigError: no such drive, camera or range of frames.
    """
    drive = find_drive(path, options.sequence)
    number = raw_camera_number(options.camera)
    calibration = read_raw_calibration(calibration_folder(drive))
    files = find_raw_files(drive, number)
    size = picture_size(next(iter(files.pictures.values())))
    model, nominal = _camera(calibration, drive, number, size)
    truth = _truth(drive, options.camera, nominal)
    encoding = mask_encoding(files.masks, options.label_encoding, size)
    pictures = PictureFiles(size, files.pictures, files.masks, encoding)
    timing = options.timing(files.scan_stamps_ns)
    turn = None if timing is None else TurnTimes(timing, files.sweeps)
    clouds = RawScans(files.scans, files.labels, turn)
    scans = np.array(list(files.scans))
    images = np.array(sorted({*files.pictures, *(k for k in files.masks if k < len(files.image_stamps_ns))}))
    scan_stamps, image_stamps = files.scan_stamps_ns[scans], files.image_stamps_ns[images]

    def scan(k: int) -> Scan:
        return clouds.scan(int(scans[k]), int(scan_stamps[k]))

    def image(k: int) -> CameraImage:
        return pictures.image(int(images[k]), int(image_stamps[k]))

    is_reference = not (drive / "groundtruth.json").exists()
    name = printable(drive.resolve().name)
    reason = f"by {VELO_TO_CAM} and {CAM_TO_CAM}"
    properties = DriveProperties(name, model.intrinsics, nominal, truth, is_reference, nominal_reason=reason)
    of_scans = Sensor(scan_stamps, scan, "velodyne_points")
    of_images = Sensor(image_stamps, image, f"image_{number:02d}")
    source = merged(properties, of_scans, of_images, options, drive, scans_are_complete=True)
    return source if model.is_pinhole else RectifiedSource(source, Rectification.of(model))


def _camera(
    calibration: RawCalibration, drive: Path, number: int, size: tuple[int, int]
) -> tuple[CameraModel, gtsam.Pose3]:
    """Camera and cTl for rectified pictures or for those as recorded, whichever have the size."""
    kinds = [rectified for rectified in (True, False) if calibration.size(number, rectified) == size]
    if not kinds:
        expected = " or ".join("{}x{} px".format(*calibration.size(number, kind)) for kind in (True, False))
        raise DataError(drive / f"image_{number:02d}", "pictures of {}x{} px".format(*size), expected)
    rectified = kinds[0] if len(kinds) == 1 else not drive.resolve().name.endswith("_extract")
    return calibration.rectified(number, *size) if rectified else calibration.as_recorded(number)


def _truth(drive: Path, camera: str, nominal: gtsam.Pose3) -> GroundTruth:
    """``groundtruth.json``, or the published calibration; its clocks are near, but not known to agree."""
    stored = read_truth(drive / "groundtruth.json")
    if stored is None:
        return GroundTruth(nominal, None)
    if raw_camera_number(stored.camera) != raw_camera_number(camera):
        found = f"the truth of {stored.camera}"
        raise DataError(drive / "groundtruth.json", found, f"that of {camera}")
    return stored.truth


RAW_LOADER = Loader(recognizes=is_raw, open=open_raw, layout=LAYOUT)
