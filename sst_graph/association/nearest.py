"""Nearest pixel of a class for each point, nearest point for each pixel: the matches of SST-Calib.

Both directions are exact: pixels by an index map of the mask, points by a KD-tree of their projections.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from sst_graph.factors import Alignment, CameraTwist, MotionModel, PinholeCamera
from sst_graph.factors.motion import moved_points
from sst_graph.types import FloatArray

_MOTION_MODEL: MotionModel = "translation"
"""The paper's: points move by v times the interval (:mod:`sst_graph.factors.motion`)."""


@dataclass(frozen=True)
class NearestPixels:
    """For every pixel of an image the nearest pixel of a class.

    Attributes:
        index: (h, w) int32, row * w + column of the nearest pixel of the class, by centres.
    """

    index: NDArray[np.int32]

    @classmethod
    def of(cls, shown: NDArray[np.bool_]) -> NearestPixels | None:
        """The map of the pixels (h, w) that show a class, or None where there is none."""
        outside = ~shown
        if outside.all():
            return None
        rows, columns = distance_transform_edt(outside, return_distances=False, return_indices=True)
        return cls(np.asarray(rows * np.int32(shown.shape[1]) + columns, dtype=np.int32))

    def at(self, uvs: FloatArray) -> FloatArray:
        """(n, 2) centre of the class's pixel nearest to the pixel that each of uvs (n, 2) lies in [px].

        uvs must lie on the image (:meth:`sst_graph.factors.camera.PinholeCamera.in_image`).
        """
        h, w = self.index.shape
        columns, rows = np.minimum((uvs.T + 0.5).astype(np.intp), [[w - 1], [h - 1]])
        nearest = self.index.take(rows * w + columns)
        nearest_rows = nearest // np.int32(w)
        return np.stack([nearest - nearest_rows * np.int32(w), nearest_rows], axis=1).astype(np.float64)


def nearest_points(uvs: FloatArray, pixels: FloatArray) -> NDArray[np.intp]:
    """(m,) number of the projected point among uvs (n, 2), n >= 1, nearest to each of pixels (m, 2) [px]."""
    tree = cKDTree(uvs, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(pixels)[1], dtype=np.intp)


def sample_pixels(shown: NDArray[np.bool_], share: float, rng: np.random.Generator) -> FloatArray:
    """(m, 2) a random share of the pixels (h, w) that show a class, at least one if there is any [px]."""
    rows, columns = np.nonzero(shown)
    count = min(len(rows), max(1, round(share * len(rows))))
    chosen = rng.choice(len(rows), count, replace=False) if len(rows) else np.zeros(0, dtype=np.intp)
    return np.stack([columns[chosen], rows[chosen]], axis=1).astype(np.float64)


@dataclass(frozen=True)
class ClassView:
    """One class in one scan and its image, ready to be matched again and again.

    Attributes:
        camera: of the image.
        lPs: (n, 3) points of the class [m].
        base_tau_s: image stamp minus scan stamp [s].
        nearest: nearest pixels of the class in the mask.
        pixels: (m, 2) a sample of the class's pixels [px].
    """

    camera: PinholeCamera
    lPs: FloatArray
    base_tau_s: float
    nearest: NearestPixels
    pixels: FloatArray

    @classmethod
    def of(
        cls,
        camera: PinholeCamera,
        lPs: FloatArray,
        base_tau_s: float,
        shown: NDArray[np.bool_],
        share: float,
        rng: np.random.Generator,
    ) -> ClassView | None:
        """A view, or None where the scan or the mask shows none of the class.

        Args:
            shown: (h, w) pixels of the mask that show it.
            share: of these pixels that is sampled.
        """
        nearest = NearestPixels.of(shown)
        if nearest is None or len(lPs) == 0:
            return None
        return cls(camera, lPs, base_tau_s, nearest, sample_pixels(shown, share, rng))


@dataclass(frozen=True)
class NearestMatches:
    """Frozen matches of a class, in both directions.

    Attributes:
        point_to_pixel: each projected point on the image with its nearest pixel.
        pixel_to_point: each sampled pixel with its nearest projected point, or None where it counts nothing.
    """

    point_to_pixel: Alignment
    pixel_to_point: Alignment | None

    @property
    def alignments(self) -> list[Alignment]:
        both = (self.point_to_pixel, self.pixel_to_point)
        return [alignment for alignment in both if alignment is not None]


def match_nearest(
    view: ClassView,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    pixel_weight: float,
    max_px: float = np.inf,
) -> NearestMatches | None:
    """Matches at a pose and offset; None where there are none. SST-Calib, eq. 2 to 4.

    L = L_p2i + w_l (n_p / n_i) L_i2p, n_p projected points on the image, n_i sampled pixels; each match
    with a sigma of 1 px.

    Args:
        c_twist: (6,) camera twist at the image's instant [rad/s, m/s].
        pixel_weight: w_l; 0 leaves the pixels out.
        max_px: points farther than this from their pixel are left out [px].
    """
    tau_s = time_offset_s + view.base_tau_s
    motion = CameraTwist(c_twist, np.zeros(6))
    cPs = moved_points(cTl, view.lPs.T, tau_s, motion, _MOTION_MODEL, None).cPs.T
    uvs = view.camera.project(cPs)
    on_image = np.flatnonzero(view.camera.in_front(cPs) & view.camera.in_image(uvs))
    if len(on_image) == 0:
        return None
    lPs, uvs = view.lPs[on_image], uvs[on_image]
    targets = view.nearest.at(uvs)
    if np.isfinite(max_px):
        near = np.linalg.norm(uvs - targets, axis=1) <= max_px
        lPs, uvs, targets = lPs[near], uvs[near], targets[near]
        if len(lPs) == 0:
            return None
    point_to_pixel = frozen(view, lPs, targets, 1.0)
    if pixel_weight == 0.0:
        return NearestMatches(point_to_pixel, None)
    chosen = nearest_points(uvs, view.pixels)
    weight = pixel_weight * len(lPs) / len(view.pixels)
    return NearestMatches(point_to_pixel, frozen(view, lPs[chosen], view.pixels, weight))


def frozen(view: ClassView, lPs: FloatArray, pixels: FloatArray, weight: float) -> Alignment:
    """Matches of points (n, 3) of a view with pixels (n, 2), all of one weight."""
    return Alignment(
        view.camera,
        lPs,
        np.asarray(view.base_tau_s),
        pixels,
        np.asarray(1.0),
        motion_model=_MOTION_MODEL,
        weights=np.asarray(weight),
    )
