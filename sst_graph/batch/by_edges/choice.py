"""``method=auto``: by labels where both sensors have some, else by edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sst_graph.batch.config import CalibrationConfig
from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.drive.preparation import Drive
from sst_graph.types import SemanticClass, Source

_LOOKS = 8
"""Most scans and images of a drive that are looked at, spread over it."""


def with_method_for(config: CalibrationConfig, sources: Sequence[Source]) -> CalibrationConfig:
    """The settings with the method that the sources allow, where the method is auto.

    Labels of other classes than those that are aligned count, too: method joint then says what is wrong.

    Raises:
        DataError: a frame cannot be read.
    """
    if config.method != "auto":
        return config
    return replace(config, method="edges" if any(map(_must_do_without, sources)) else "joint")


def with_method_of(config: CalibrationConfig, drives: Sequence[Drive]) -> CalibrationConfig:
    """The same, by what drives were prepared for."""
    if config.method != "auto":
        return config
    by_edges = any(SemanticClass.OBJECT in scan.boundaries for drive in drives for scan in drive.scans)
    return replace(config, method="edges" if by_edges else "joint")


def _must_do_without(source: Source) -> bool:
    """Whether one sensor of a drive has no label, and the camera has pictures."""
    images = [image for k in _some(image_positions(source)) if (image := image_at(source, k)) is not None]
    if not any(image.has_picture for image in images):
        return False
    if not any(image.has_mask for image in images):
        return True
    scans = (scan_at(source, k) for k in _some(scan_positions(source)))
    return not any(scan is not None and scan.has_labels for scan in scans)


def _some(positions: Sequence[int]) -> list[int]:
    """Evenly spread ones."""
    count = len(positions)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _LOOKS)).round().astype(int)) if count else ()
    return [positions[int(k)] for k in chosen]
