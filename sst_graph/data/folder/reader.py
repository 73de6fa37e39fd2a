"""A drive in a folder: ``images/``, ``clouds/`` and ``camera.yaml``, each sensor with stamps of its own.

Where present also ``masks/`` (.png, Cityscapes numbers, named as the images), ``labels/`` (.label as in
SemanticKITTI, named as the clouds; a field ``label`` of the clouds serves as well) and ``extrinsic.yaml``.
Of several cameras, each has a folder of its name with ``images/``, ``camera.yaml``, ``masks/`` and
``extrinsic.yaml``.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import Rectification
from sst_graph.classes import classes_of_points
from sst_graph.data.arrays import are_returns, listed
from sst_graph.data.folder.camera_file import read_camera, read_extrinsic
from sst_graph.data.folder.stamps import StampedFiles, stamped_files
from sst_graph.data.pictures import PictureFiles, mask_encoding, point_labels
from sst_graph.data.point_files import SUFFIXES, PointFields, read_cloud
from sst_graph.data.point_times import PointClock, ScanTimes, clock_of_points
from sst_graph.data.rectified import RectifiedSource
from sst_graph.data.source import Loader, SourceOptions
from sst_graph.data.two_clocks import DriveProperties, Sensor, merged
from sst_graph.errors import ConfigError, DataError, count_of, printable
from sst_graph.types import CameraImage, Scan, Source, with_intensities

_LOG = logging.getLogger(__name__)

LAYOUT = "a folder with images, clouds, camera.yaml; stamps as names or in images.csv, clouds.csv"
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_IMAGES, _CLOUDS, _CAMERA, _EXTRINSIC = "images", "clouds", "camera.yaml", "extrinsic.yaml"
_DEFAULT_CAMERA, _DEFAULT_CLOUD = SourceOptions().camera, SourceOptions().cloud


def is_folder(path: Path) -> bool:
    """Whether a folder holds images and clouds."""
    return os.path.isdir(path / _CLOUDS) and (os.path.isdir(path / _IMAGES) or bool(_cameras(path)))


def _cameras(path: Path) -> list[str]:
    """Names of the folders of cameras."""
    return sorted(entry.name for entry in listed(path, LAYOUT) if os.path.isdir(entry / _IMAGES))


@dataclass(frozen=True, eq=False)
class CloudFiles:
    """Clouds in the order of their stamps.

    Attributes:
        files: with their stamps.
        labels: paths of label files by position.
        stored_times: take the times that the clouds hold.
        clock: of these; None: that of the stamps.
    """

    files: StampedFiles
    labels: dict[int, Path]
    stored_times: bool
    clock: PointClock | None = None

    def scan(self, k: int) -> Scan:
        """Scan k; points that are NaN, inf or at the origin are left out.

        Raises:
            DataError: a file is damaged or holds what it must not.
        """
        stamp_ns = int(self.files.stamps_ns[k])
        cloud = read_cloud(self.files.paths[k])
        points = cloud.points()
        used = are_returns(points)
        classes, instances = self._labels(k, cloud, used)
        offsets_s = None
        if self.stored_times and (times := cloud.offsets_s(stamp_ns, used, self.clock)) is not None:
            offsets_s = times[used]
        rings, intensities = cloud.rings(), cloud.intensities()
        points = np.ascontiguousarray(points[used])
        scan = Scan(
            stamp_ns=stamp_ns,
            points=points,
            classes=classes,
            instances=instances,
            offsets_s=offsets_s,
            rings=None if rings is None else rings[used],
            left_out=len(used) - len(points),
        )
        return with_intensities(scan, None if intensities is None else intensities[used])

    def times(self, k: int) -> ScanTimes | None:
        """Times of the points of scan k; errors as of a scan."""
        cloud = read_cloud(self.files.paths[k])
        values, used = cloud.times(), are_returns(cloud.points())
        return None if values is None else ScanTimes(int(self.files.stamps_ns[k]), values[used])

    def _labels(
        self, k: int, cloud: PointFields, used: NDArray[np.bool_]
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        path = self.labels.get(k)
        if path is None and (labels := cloud.labels()) is not None:
            return classes_of_points(labels[used], cloud.path)
        return point_labels(path, used, cloud.path)


def open_folder(path: Path, options: SourceOptions) -> Source:
    """Open a drive in a folder; images of a lens that distorts are rectified as they are read.

    Raises:
        DataError: a folder or file is missing or damaged, a name that is no stamp, stamps that do not rise.
        ConfigError: an option that the layout does not have, or frames that the drive has not.
        MissingDependencyError: PyYAML is not installed.
    """
    _check_options(path, options)
    own = path if options.camera in (_DEFAULT_CAMERA, _IMAGES) else path / options.camera
    images = stamped_files(own / _IMAGES, PICTURES)
    clouds = stamped_files(path / _CLOUDS, SUFFIXES)
    for what, files in ((_IMAGES, images), (_CLOUDS, clouds)):
        if files.without_stamp:
            found = count_of(files.without_stamp, what.removesuffix("s"))
            _LOG.warning("%s: %s without a stamp left out", printable(path), found)
        if files.without_file:
            found = f"{count_of(files.without_file, 'line')} of {what}.csv"
            _LOG.warning("%s: %s left out, whose files are missing", printable(path), found)
    model = read_camera(own / _CAMERA, "" if own == path else options.camera)
    extrinsic = own / _EXTRINSIC
    nominal = read_extrinsic(extrinsic) if os.path.lexists(extrinsic) else None
    size = (model.width, model.height)
    masks = _beside(images, own / "masks", (".png",))
    encoding = mask_encoding(masks, options.label_encoding, size)
    pictures = PictureFiles(size, dict(enumerate(images.paths)), masks, encoding)
    scans = CloudFiles(clouds, _beside(clouds, path / "labels", (".label",)), options.sweep == "auto")
    clock, of_clock = clock_of_points(scans.times, len(clouds.paths), options)
    scans = replace(scans, clock=clock)

    def image(k: int) -> CameraImage:
        return pictures.image(k, int(images.stamps_ns[k]))

    reason = f"by {_EXTRINSIC}" if nominal is not None else f"no {_EXTRINSIC}"
    name = printable(path.resolve().name)
    remarks = (of_clock,) * bool(of_clock)
    properties = DriveProperties(name, model.intrinsics, nominal, nominal_reason=reason, remarks=remarks)
    of_scans = Sensor(clouds.stamps_ns, scans.scan, _CLOUDS)
    of_images = Sensor(images.stamps_ns, image, _IMAGES)
    drive = merged(properties, of_scans, of_images, options, path)
    return drive if model.is_pinhole else RectifiedSource(drive, Rectification.of(model))


def _check_options(path: Path, options: SourceOptions) -> None:
    wrong = {
        "sequence": options.sequence is not None,
        "cloud": options.cloud not in (_DEFAULT_CLOUD, _CLOUDS),
    }
    for name, is_wrong in wrong.items():
        if is_wrong:
            raise ConfigError(f"{name} {getattr(options, name)!r}: {path} has images and clouds only")
    cameras = [_IMAGES] * os.path.isdir(path / _IMAGES) + _cameras(path)
    named = _IMAGES if options.camera == _DEFAULT_CAMERA else options.camera
    if named not in cameras and cameras:
        given = "none is named" if options.camera == _DEFAULT_CAMERA else f"none is {options.camera!r}"
        raise ConfigError(f"{path}: cameras {', '.join(cameras)}: {given} (--camera)")


def _beside(files: StampedFiles, folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files of another folder by the position of the file with the same name.

    Raises:
        DataError: the folder is there, and holds none.
    """
    if not folder.is_dir():
        return {}
    named = {entry.stem: entry for entry in listed(folder, "files") if entry.suffix.lower() in suffixes}
    found = {k: named[path.stem] for k, path in enumerate(files.paths) if path.stem in named}
    if not found:
        raise DataError(folder, "no file with the name of one beside it", f"a partner of {files.paths[0]}")
    return found


FOLDER_LOADER = Loader(recognizes=is_folder, open=open_folder, layout=LAYOUT)
