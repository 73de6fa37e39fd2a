"""``method=auto``: by labels where both sensors have some, by edges where none are, both where some frames
have labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.batch.by_edges.label_parts import labelled_stamps
from sst_graph.batch.config import CalibrationConfig, Method
from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.drive.preparation import Drive
from sst_graph.types import SemanticClass, Source

_LOOKS = 8
"""Most scans and images of a drive that are looked at, spread over it, and as many in succession: labels may
be in a part of the drive, or in every so many frames."""
_SOME, _FEWEST = 0.25, 4
"""Edges are used beside labels where so large a share of a drive's frames that are looked at, and so many of
them, have no labels: edges of few frames know much less than the labels of the others."""


def with_method_for(config: CalibrationConfig, sources: Sequence[Source]) -> CalibrationConfig:
    """The settings with the method that the sources allow, where the method is auto.

    Labels of other classes than those that are aligned count, too, where no drive has any of those: method
    joint then says what is wrong.

    Raises:
        DataError: a frame cannot be read.
    """
    if config.method != "auto":
        return config
    looks = [_Looks.at(source) for source in sources]
    return replace(config, method=_method(looks, config))


def with_method_of(config: CalibrationConfig, drives: Sequence[Drive]) -> CalibrationConfig:
    """The same, by what drives were prepared for."""
    if config.method != "auto":
        return config
    by_edges = any(SemanticClass.OBJECT in image.contours for drive in drives for image in drive.images)
    if not by_edges:
        return replace(config, method="joint")
    by_labels = any(all(labelled_stamps(drive)) for drive in drives)
    return replace(config, method="both" if by_labels else "edges")


@dataclass(frozen=True)
class _Looks:
    """What some frames of a drive hold.

    Attributes:
        scans, images: classes of each scan and image that was looked at; none without labels.
        pictures: whether any image has a picture.
    """

    scans: tuple[frozenset[int], ...]
    images: tuple[frozenset[int], ...]
    pictures: bool

    @classmethod
    def at(cls, source: Source) -> _Looks:
        images = [image for k in _some(image_positions(source)) if (image := image_at(source, k)) is not None]
        scans = [scan for k in _some(scan_positions(source)) if (scan := scan_at(source, k)) is not None]
        return cls(
            tuple(_classes(scan.classes) for scan in scans),
            tuple(_classes(image.mask) for image in images),
            any(image.has_picture for image in images),
        )

    @property
    def labelled(self) -> bool:
        """Whether both sensors have labels."""
        return any(self.scans) and any(self.images)

    def lacks_many(self, classes: frozenset[int]) -> bool:
        """Whether edges are worth while in the frames without labels."""
        lacking = 1.0 - self.share(classes)
        return lacking >= _SOME and lacking * min(len(self.scans), len(self.images)) >= _FEWEST

    def share(self, classes: frozenset[int]) -> float:
        """Share of the frames with labels on both sides; 0 where none of the classes is on both."""
        if not classes & frozenset().union(*self.scans) & frozenset().union(*self.images):
            return 0.0
        return min(sum(map(bool, side)) / len(side) for side in (self.scans, self.images))


def _method(looks: Sequence[_Looks], config: CalibrationConfig) -> Method:
    without = [each for each in looks if not each.labelled and each.pictures]
    classes = frozenset(map(int, config.classes))
    no_labels = not any(each.share(classes) for each in looks)
    if no_labels or config.time_offset_per_drive or not any(each.pictures for each in looks):
        return "edges" if without else "joint"
    return "both" if without or any(each.lacks_many(classes) for each in looks) else "joint"


def _classes(labels: np.ndarray) -> frozenset[int]:
    """Classes that occur."""
    return frozenset(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist()) - {int(SemanticClass.IGNORE)}


def _some(positions: Sequence[int]) -> list[int]:
    """Evenly spread ones, and some in succession."""
    count = len(positions)
    chosen = np.linspace(0, count - 1, min(count, _LOOKS)).round().astype(int) if count else np.zeros(0, int)
    middle = max(0, (count - _LOOKS) // 2)
    run = np.arange(middle, min(count, middle + _LOOKS))
    return [positions[int(k)] for k in np.unique(np.concatenate([chosen, run]))]
