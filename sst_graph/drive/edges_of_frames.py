"""Some frames of a drive, read again for what edges compare: objects of no class, gradients of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sst_graph.drive.preparation import Drive, PrepareConfig, ScanFeatures, scan_features
from sst_graph.features.picture_gradients import PictureGradients
from sst_graph.files.array_store import ArrayStore
from sst_graph.types import SemanticClass


def with_edges(drive: Drive, pairs: Sequence[tuple[int, int]], config: PrepareConfig) -> Drive | None:
    """The drive with edges of some pairs alone: objects that geometry finds in their scans, and gradients of
    their pictures. All other scans and images are empty, for the drive's motions lead from scan to scan. None
    where its frames cannot be read again, or have no picture.

    Args:
        pairs: positions of scan and image.

    Raises:
        DataError: a frame cannot be read, or cannot be used.
    """
    if drive.frames is None:
        return None
    store, objects = ArrayStore(config.in_memory_bytes), (SemanticClass.OBJECT,)
    images, scans = [image.with_contours({}) for image in drive.images], [*map(_empty, drive.scans)]
    for k in sorted({image for _, image in pairs}):
        image = drive.frames.image(images[k].index)
        if image is not None and image.has_picture and image.stamp_ns == images[k].stamp_ns:
            gradients = PictureGradients.of(image.pixels, image.valid).stored_in(store)
            images[k].contours[SemanticClass.OBJECT] = gradients
    for k, image_number in pairs:
        if not images[image_number].contours:
            continue
        scan = drive.frames.scan(scans[k].index)
        if scan is not None and scan.stamp_ns == scans[k].stamp_ns:
            scans[k] = scan_features(scans[k].index, scan, objects, config, False, False).stored_in(store)
    if not any(scan.boundaries for scan in scans):
        return None
    return replace(drive, scans=tuple(scans), images=tuple(images))


def _empty(scan: ScanFeatures) -> ScanFeatures:
    """The scan without points."""
    lPs, classes, offsets_s = np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0)
    deep = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    return ScanFeatures(scan.index, scan.stamp_ns, {}, lPs, classes, offsets_s, *deep)
