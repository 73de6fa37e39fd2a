"""What labels pictures and scans: a network, or anything else that satisfies one of two protocols."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import ByValue, CameraImage, Scan, SemanticClass


@dataclass(frozen=True, eq=False)
class ImageLabels(ByValue):
    """Labels of a picture.

    Attributes:
        mask: (h, w) uint8 of :class:`~sst_graph.types.SemanticClass`.
        instances: (h, w) uint16 instance number within its class, at most 255 (0: none), or None.
    """

    mask: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None = None


@dataclass(frozen=True, eq=False)
class PointLabels(ByValue):
    """Labels of a scan.

    Attributes:
        classes: (n,) uint8 of :class:`~sst_graph.types.SemanticClass`.
        instances: (n,) uint16 instance number within its class (0: none), or None.
    """

    classes: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None = None


class Segmenter(Protocol):
    """What is common to both kinds."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def identity(self) -> str:
        """Hexadecimal digest of all that the labels depend on beside the data; labels are stored by it."""
        ...

    @property
    def known(self) -> frozenset[SemanticClass]:
        """Classes, of those that can be aligned, that it tells from others."""
        ...


class ImageSegmenter(Segmenter, Protocol):
    """Labels pictures."""

    def segment(self, image: CameraImage) -> ImageLabels:
        """Labels of an image that has a picture; its own mask is not looked at."""
        ...


class ScanSegmenter(Segmenter, Protocol):
    """Labels scans."""

    def segment(self, scan: Scan) -> PointLabels:
        """Labels of a scan; its own are not looked at."""
        ...
