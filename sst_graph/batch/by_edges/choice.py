"""``method=auto``: by labels where both sensors have some, by edges where none are, both where some drives
have labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.batch.by_edges.label_parts import labelled_stamps
from sst_graph.batch.config import CalibrationConfig, Method
from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.drive.preparation import Drive
from sst_graph.sampling import evenly_spread
from sst_graph.types import SemanticClass, Source

_MOST_SAMPLED = 8
"""Most scans and images of a drive that are looked at, spread over it."""


def with_method_for(config: CalibrationConfig, sources: Sequence[Source]) -> CalibrationConfig:
    """The settings with the method that the sources allow, where the method is auto.

    Labels of other classes than those that are aligned count, too, where no drive has any of those: method
    joint then says what is wrong.

    Raises:
        DataError: a frame cannot be read.
    """
    if config.method != "auto":
        return config
    sampled = [_SampledFrames.of(source) for source in sources]
    return replace(config, method=_method(sampled, config))


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
class _SampledFrames:
    """What some frames of a drive hold.

    Attributes:
        scans, images: classes of each scan and image that was looked at; none without labels.
        pictures: whether any image has a picture.
    """

    scans: tuple[frozenset[int], ...]
    images: tuple[frozenset[int], ...]
    pictures: bool

    @classmethod
    def of(cls, source: Source) -> _SampledFrames:
        places = evenly_spread(image_positions(source), _MOST_SAMPLED)
        images = [image for k in places if (image := image_at(source, k)) is not None]
        places = evenly_spread(scan_positions(source), _MOST_SAMPLED)
        scans = [scan for k in places if (scan := scan_at(source, k)) is not None]
        return cls(
            tuple(_classes(scan.classes) for scan in scans),
            tuple(_classes(image.mask) for image in images),
            any(image.has_picture for image in images),
        )

    @property
    def labelled(self) -> bool:
        """Whether both sensors have labels."""
        return any(self.scans) and any(self.images)

    def on_both_sides(self, classes: frozenset[int]) -> bool:
        """Whether scans and images have labels of one of the classes."""
        return bool(classes & frozenset().union(*self.scans) & frozenset().union(*self.images))


def _method(sampled: Sequence[_SampledFrames], config: CalibrationConfig) -> Method:
    without = [each for each in sampled if not each.labelled and each.pictures]
    classes = frozenset(map(int, config.classes))
    if not without:
        return "joint"
    some_labels = any(each.on_both_sides(classes) for each in sampled)
    return "both" if some_labels and not config.time_offset_per_drive else "edges"


def _classes(labels: np.ndarray) -> frozenset[int]:
    """Classes that occur."""
    return frozenset(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist()) - {int(SemanticClass.IGNORE)}
