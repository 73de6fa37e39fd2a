"""A drive with labels from networks in the place of its own."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sst_graph.data.source_view import ChangedSource
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import checked_callback
from sst_graph.segmentation.segmenter import ImageLabels, ImageSegmenter, PointLabels, ScanSegmenter
from sst_graph.segmentation.store import LabelStore, StoredModel, cache_folder
from sst_graph.types import CameraImage, Scan, SemanticClass, Source

_LOG = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True)
class Labelling:
    """Where labels come from.

    Attributes:
        store: where they are kept.
        images: network of the stored masks; None: masks stay those of the data.
        scans: network of the stored labels of points; None: they stay those of the data.
        image_segmenter, scan_segmenter: what makes labels that are not stored; None: they must be.
        counts: labels that were ``made`` and ``found``, for all drives that share this.
    """

    store: LabelStore
    images: StoredModel | None = None
    scans: StoredModel | None = None
    image_segmenter: ImageSegmenter | None = None
    scan_segmenter: ScanSegmenter | None = None
    counts: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(
        cls,
        store: LabelStore,
        image_segmenter: ImageSegmenter | None = None,
        scan_segmenter: ScanSegmenter | None = None,
        stored: bool = True,
    ) -> Labelling:
        """By networks that are given.

        Args:
            stored: whether a side without a network takes the stored labels of the only one there, if any.

        Raises:
            ConfigError: labels of several networks are stored, or of none and no network is given.
        """
        images = store.only_model("images") if stored and image_segmenter is None else None
        scans = store.only_model("scans") if stored and scan_segmenter is None else None
        if image_segmenter is not None:
            images = store.enter("images", image_segmenter)
        if scan_segmenter is not None:
            scans = store.enter("scans", scan_segmenter)
        if images is None and scans is None:
            raise ConfigError(
                f"{store.folder}: found no labels, expected those that sst-graph segment writes"
            )
        return cls(store, images, scans, image_segmenter, scan_segmenter)

    def image(self, image: CameraImage) -> CameraImage:
        """The image with its mask; one without a picture may be anything.

        Raises:
            DataError: no labels are stored and no network is given, or it fails.
        """
        model = self.images
        if model is None:
            return image
        if not image.has_picture:
            return replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE), instances=None)
        labels = self._labels_of_image(model, image)
        mask = labels.mask
        if image.valid is not None:
            mask = np.where(image.valid, mask, np.uint8(SemanticClass.IGNORE))
        return replace(image, mask=mask, instances=labels.instances)

    def scan(self, scan: Scan) -> Scan:
        """The scan with its labels.

        Raises:
            DataError: no labels are stored and no network is given, or it fails.
        """
        if self.scans is None:
            return scan
        labels = self._labels_of_scan(self.scans, scan)
        return replace(scan, classes=labels.classes, instances=labels.instances)

    def _labels_of_image(self, model: StoredModel, image: CameraImage) -> ImageLabels:
        segmenter, place = self.image_segmenter, f"the image stamped {image.stamp_ns} ns"
        found = self._stored(lambda: self.store.image(model.identity, image), segmenter is not None)
        if found is not None:
            return found
        if segmenter is None:
            raise self._missing(place, "--image-model")
        labels = segmenter.segment(image)
        _check_shape(labels.mask.shape, image.pixels.shape[:2], f"{segmenter.name}: {place}")
        self.store.put_image(model.identity, image, labels)
        self.counts["made"] += 1
        # As every later run finds them.
        return self.store.image(model.identity, image) or labels

    def _labels_of_scan(self, model: StoredModel, scan: Scan) -> PointLabels:
        segmenter, place = self.scan_segmenter, f"the scan stamped {scan.stamp_ns} ns"
        found = self._stored(lambda: self.store.scan(model.identity, scan), segmenter is not None)
        if found is not None:
            return found
        if segmenter is None:
            raise self._missing(place, "--lidar-model")
        labels = segmenter.segment(scan)
        _check_shape(labels.classes.shape, (len(scan.points),), f"{segmenter.name}: {place}")
        self.store.put_scan(model.identity, scan, labels)
        self.counts["made"] += 1
        return self.store.scan(model.identity, scan) or labels

    def _stored(self, read: Callable[[], T | None], can_be_made: bool) -> T | None:
        """What is stored; what is damaged is made again where that is possible."""
        try:
            found = read()
        except DataError as error:
            if not can_be_made:
                raise
            _LOG.warning("made again: %s", error)
            return None
        if found is not None:
            self.counts["found"] += 1
        return found

    def _missing(self, place: str, option: str) -> DataError:
        return DataError(
            self.store.folder,
            f"no labels of {place}",
            f"those of all the drive: give {option}, or segment it",
        )


class LabelledSource(ChangedSource):
    """A source whose images and scans are labelled as they are read (satisfies
    :class:`sst_graph.types.Source`).
    """

    def __init__(self, source: Source, labelling: Labelling) -> None:
        self.source, self.labelling = source, labelling

    def changed_scan(self, scan: Scan) -> Scan:
        """The scan with its labels."""
        return self.labelling.scan(scan)

    def changed_image(self, image: CameraImage) -> CameraImage:
        """The image with its mask."""
        return self.labelling.image(image)


def with_labels(
    source: Source,
    image_segmenter: ImageSegmenter | None = None,
    scan_segmenter: ScanSegmenter | None = None,
    folder: str | Path | None = None,
) -> LabelledSource:
    """The drive with labels of networks, made as its frames are read and kept.

    Args:
        source: any drive.
        image_segmenter, scan_segmenter: from :func:`~sst_graph.segmentation.open_image_segmenter` and
            :func:`~sst_graph.segmentation.open_scan_segmenter`, or what else satisfies their protocols; None:
            labels that are stored, or where there are none those of the data.
        folder: where labels are kept; None: :func:`~sst_graph.segmentation.store.cache_folder`.

    Raises:
        ConfigError: neither networks nor stored labels.
    """
    store = LabelStore(cache_folder() if folder is None else Path(folder))
    # In the cache are the labels of any network that was ever used.
    stored = folder is not None
    return LabelledSource(source, Labelling.of(store, image_segmenter, scan_segmenter, stored))


def segment_drive(drive: LabelledSource, progress: Callable[[int, int], None] | None = None) -> Counter[str]:
    """Make all labels of a drive that are not stored yet; numbers of those ``made`` and ``found``.

    Args:
        progress: called with (frames done, frames in all).

    Raises:
        DataError: a frame cannot be read or labelled; what was made before is stored.
        FactorError: ``progress`` cannot be called so.
    """
    checked_callback("progress", progress, ("done", "total"))
    before = Counter(drive.labelling.counts)
    for position in range(len(drive)):
        drive.read_image(position)
        drive.read_scan(position)
        if progress is not None:
            progress(position + 1, len(drive))
    return drive.labelling.counts - before


def _check_shape(found: tuple[int, ...], expected: tuple[int, ...], place: str) -> None:
    if found != expected:
        raise DataError(place, f"labels of shape {found}", f"{expected}")
