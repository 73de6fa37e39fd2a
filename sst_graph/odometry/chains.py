"""Corners followed over many images: for what two images cannot tell, such as a lens that bends."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sst_graph.odometry.features import (
    UNTRACKED_CLASSES,
    FeatureConfig,
    detect_corners,
    follow_corners,
    gray_of,
    trackable_area,
)
from sst_graph.types import CameraImage

FloatArray = NDArray[np.float64]

CHAIN_FEATURES = FeatureConfig(threshold=15, cell_px=48, per_cell=2, window_px=21)
"""Fewer and stronger corners than motion between two images asks for: each is followed for long."""
_FEW = 0.7
"""New corners are sought where fewer than this share of the last search's are left."""
_LEAST_IMAGES = 4
"""Shorter chains are dropped: two views always agree, a third tells little."""
_MOST_CHAINS = 3000
"""Chains kept; the shortest are dropped beyond it."""


@dataclass(frozen=True)
class FeatureChain:
    """One corner in consecutive images.

    Attributes:
        first: number of the first image.
        uvs: (n, 2) its pixel in that image and the following ones [px].
    """

    first: int
    uvs: FloatArray

    def __len__(self) -> int:
        return len(self.uvs)


@dataclass
class ChainTracker:
    """Follows corners from image to image until they are lost."""

    config: FeatureConfig = CHAIN_FEATURES
    _images: int = 0
    _gray: NDArray[np.uint8] | None = None
    _live: list[tuple[int, list[FloatArray]]] = field(default_factory=list)
    _sought: int = 0
    _done: list[FeatureChain] = field(default_factory=list)

    def add(self, image: CameraImage) -> None:
        """Take the next image of a drive."""
        gray = gray_of(image)
        if self._gray is not None and self._gray.shape == gray.shape and self._live:
            self._follow(self._gray, gray, image)
        else:
            self._lose(np.zeros(len(self._live), np.bool_))
        if len(self._live) < _FEW * self._sought or self._sought == 0:
            self._seek(gray, image)
        self._gray, self._images = gray, self._images + 1

    def chains(self) -> tuple[FeatureChain, ...]:
        """All chains so far that are long enough."""
        live = [_chain(first, uvs) for first, uvs in self._live]
        return tuple(self._done + [chain for chain in live if len(chain) >= _LEAST_IMAGES])

    def _follow(self, before: NDArray[np.uint8], gray: NDArray[np.uint8], image: CameraImage) -> None:
        corners = np.array([uvs[-1] for _, uvs in self._live], np.float32)
        there, good = follow_corners(before, gray, corners, self.config)
        column, row = np.rint(np.where(good[:, None], there, 0.0)).astype(np.intp).T
        good &= ~np.isin(image.mask[row, column], UNTRACKED_CLASSES)
        for (_, uvs), uv, ok in zip(self._live, there, good, strict=True):
            if ok:
                uvs.append(uv)
        self._lose(good)

    def _lose(self, kept: NDArray[np.bool_]) -> None:
        """End the chains that are not kept."""
        ended = [_chain(*live) for live, keep in zip(self._live, kept, strict=True) if not keep]
        self._done += [chain for chain in ended if len(chain) >= _LEAST_IMAGES]
        self._done = sorted(self._done, key=len, reverse=True)[:_MOST_CHAINS]
        self._live = [live for live, keep in zip(self._live, kept, strict=True) if keep]

    def _seek(self, gray: NDArray[np.uint8], image: CameraImage) -> None:
        """New corners in the cells that hold none."""
        free = trackable_area(image, self.config)
        for _, uvs in self._live:
            column, row = (uvs[-1] // self.config.cell_px).astype(np.intp) * self.config.cell_px
            free[row : row + self.config.cell_px, column : column + self.config.cell_px] = 0
        corners = detect_corners(gray, free, self.config).astype(np.float64)
        self._live += [(self._images, [uv]) for uv in corners]
        self._sought = len(self._live)


def _chain(first: int, uvs: list[FloatArray]) -> FeatureChain:
    return FeatureChain(first, np.array(uvs, dtype=np.float64).reshape(-1, 2))
