"""``method=auto``: by labels where both sensors have some, by edges where none are, both where some drives
have labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from sst_graph.batch.by_edges.label_parts import labelled_stamps
from sst_graph.batch.config import CalibrationConfig, Method
from sst_graph.data.frame_parts import RecentReader, image_positions, scan_positions
from sst_graph.drive.preparation import Drive
from sst_graph.quality.fit_of_solution import has_edges
from sst_graph.sampling import evenly_spread
from sst_graph.types import CameraImage, SemanticClass, Source

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
    sampled = [_SampledFrames(source) for source in sources]
    return replace(config, method=_method(sampled, config))


def choice_for_cameras(
    config: CalibrationConfig, cameras: Sequence[Sequence[Source]]
) -> tuple[CalibrationConfig, list[int]]:
    """The settings with one method for all cameras on a LiDAR, where the method is auto: by labels where each
    of them has some, by edges otherwise; and the positions of the cameras for which method auto takes edges
    in the place of labels: a drive of theirs has pictures and no labels.

    Args:
        cameras: drives of each; the scans of the first are those of all, and are read from there.

    Raises:
        DataError: a frame cannot be read.
    """
    if config.method != "auto":
        return config, []
    first = cameras[0] if cameras else ()
    sampled = [
        [_SampledFrames(source, scans) for source, scans in zip(own, first, strict=False)] for own in cameras
    ]
    method = _method([each for own in sampled for each in own], config)
    chosen = replace(config, method="edges" if method == "both" else method)
    return chosen, [k for k, own in enumerate(sampled) if _without_labels(own)]


def with_method_of(config: CalibrationConfig, drives: Sequence[Drive]) -> CalibrationConfig:
    """The settings with the method that drives were prepared for, where the method is auto."""
    if config.method != "auto":
        return config
    if not has_edges(drives):
        return replace(config, method="joint")
    by_labels = any(all(labelled_stamps(drive)) for drive in drives)
    return replace(config, method="both" if by_labels else "edges")


class _SampledFrames:
    """What some frames of a drive hold. No more of them are read than an answer needs."""

    def __init__(self, source: Source, scans_of: Source | None = None) -> None:
        """scans_of: the source that has the same scans, to be read from there; None: the source itself."""
        self._drive = RecentReader(source)
        self._scans_of = self._drive if scans_of is None or scans_of is source else RecentReader(scans_of)

    @cached_property
    def labelled(self) -> bool:
        """Whether both sensors have labels."""
        return any(self._of_scans()) and any(self._of_images())

    @cached_property
    def pictures(self) -> bool:
        """Whether any image has a picture."""
        return any(image.has_picture for image in self._images())

    def on_both_sides(self, classes: frozenset[int]) -> bool:
        """Whether scans and images have labels of one of the classes."""
        of_scans, of_images = frozenset().union(*self._of_scans()), frozenset().union(*self._of_images())
        return bool(classes & of_scans & of_images)

    def _of_scans(self) -> Iterator[frozenset[int]]:
        """Classes of each scan that is looked at; none without labels."""
        drive = self._scans_of
        places = evenly_spread(scan_positions(drive.source), _MOST_SAMPLED)
        return (_classes(scan.classes) for k in places if (scan := drive.scan(k)) is not None)

    def _of_images(self) -> Iterator[frozenset[int]]:
        return (_classes(image.mask) for image in self._images())

    def _images(self) -> Iterator[CameraImage]:
        places = evenly_spread(image_positions(self._drive.source), _MOST_SAMPLED)
        return (image for k in places if (image := self._drive.image(k)) is not None)


def _without_labels(sampled: Sequence[_SampledFrames]) -> list[_SampledFrames]:
    return [each for each in sampled if not each.labelled and each.pictures]


def _method(sampled: Sequence[_SampledFrames], config: CalibrationConfig) -> Method:
    classes = frozenset(map(int, config.classes))
    if not _without_labels(sampled):
        return "joint"
    some_labels = any(each.on_both_sides(classes) for each in sampled)
    return "both" if some_labels and not config.time_offset_per_drive else "edges"


def _classes(labels: np.ndarray) -> frozenset[int]:
    """Classes that occur."""
    return frozenset(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist()) - {int(SemanticClass.IGNORE)}
