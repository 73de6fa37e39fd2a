"""Scans and masks of messages, in our classes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import MaskEncoding, classes_of_mask, classes_of_points
from sst_graph.data.point_times import PointClock
from sst_graph.data.ros.clouds import cloud_of
from sst_graph.data.ros.images import mask_of
from sst_graph.data.scan_order import rings_from_order
from sst_graph.errors import DataError
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import Scan, SemanticClass, with_intensities


@dataclass(frozen=True)
class CloudReading:
    """How clouds are read.

    Attributes:
        timing: times of the points by azimuth, where a sense of rotation is given.
        stored_times: take the times that the clouds hold.
        labels: take the labels that the clouds hold.
        clock: of the stored times; None: that of the stamps.
    """

    timing: SweepTiming | None = None
    stored_times: bool = True
    labels: bool = False
    clock: PointClock | None = None


def scan_of(message: Any, stamp_ns: int, place: str, reading: CloudReading) -> Scan:
    """The scan of a PointCloud2.

    Raises:
        DataError: as :func:`~sst_graph.data.ros.clouds.cloud_of`, or a label that SemanticKITTI has not.
    """
    cloud = cloud_of(message, stamp_ns, place, reading.stored_times, reading.labels, reading.clock)
    count = len(cloud.points)
    classes, instances = np.full(count, SemanticClass.IGNORE, np.uint8), np.zeros(count, np.uint16)
    if cloud.labels is not None:
        classes, instances = classes_of_points(cloud.labels, place)
    offsets_s = cloud.offsets_s if reading.timing is None else reading.timing.offsets_s(cloud.points)
    rings = rings_from_order(cloud.points) if cloud.rings is None else cloud.rings
    scan = Scan(stamp_ns, cloud.points, classes, instances, offsets_s, rings, cloud.left_out)
    return with_intensities(scan, cloud.intensities)


def mask_classes(
    message: Any, type_name: str, encoding: MaskEncoding, size: tuple[int, int], place: str
) -> NDArray[np.uint8]:
    """Classes (h, w) of a mask's message.

    Args:
        size: width and height that it must have [px].

    Raises:
        DataError: as :func:`~sst_graph.data.ros.images.mask_of`, another size, or a number that the encoding
            has not.
    """
    numbers = mask_of(message, type_name, place)
    check_size(numbers, size, place)
    return classes_of_mask(numbers, encoding, place)


def check_size(array: NDArray[np.uint8], size: tuple[int, int], place: str) -> None:
    """Refuse a picture or mask of another size than the first image's (width, height) [px].

    Raises:
        DataError: it is.
    """
    width, height = size
    if array.shape[:2] != (height, width):
        found = f"{array.shape[1]}x{array.shape[0]} px"
        raise DataError(place, found, f"{width}x{height} px, as the first image")
