"""Pictures and masks of a distorted camera as a pinhole in the same place would have taken them.

The extrinsic is that of the camera itself: the pinhole has its centre and its axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras.model import CameraModel
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import pinhole_camera
from sst_graph.types import BoolArray, CameraImage, FloatArray, PixelStretch, SemanticClass

FIELD_OF_VIEW_DEG = 110.0
"""Widest default field of a rectified camera [deg]: a pinhole stretches the rim by 1 / cos^2, here by 3."""
WIDEST_DEG = 150.0
"""Widest field that can be asked for [deg]: the rim is stretched 15 times. More needs several pinholes."""
_LEAST_SIDE_PX = 16
_STRETCH_STEP_PX = 32
"""Of the grid on which the enlargement is known [px]; from one place to the next it changes by some per
cent."""
_GRID = 64
"""Columns and rows of the grid by which the part of the raw image that is used is counted."""
_LEAST_SHRINKING = 1e-3
"""Least area in the raw image of a pixel of the pinhole [px^2]: below it the lens's field ends."""


def rectified_camera(model: CameraModel, field_of_view_deg: float = FIELD_OF_VIEW_DEG) -> PinholeCamera:
    """The pinhole camera that sees what a distorted one sees along its middle row and its middle column.

    Its focal length keeps the resolution at the optical axis.

    Args:
        field_of_view_deg: what lies farther than half of it to a side of the axis is left out [deg].

    Raises:
        ConfigError: a field that a pinhole cannot have.
        DataError: the camera sees nothing around its optical axis.
    """
    if not 0.0 < field_of_view_deg <= WIDEST_DEG:
        expected = f"more than 0 to {WIDEST_DEG:g} deg (wider fields need several pinholes)"
        raise ConfigError(f"field of view {field_of_view_deg:g} deg: expected {expected}")
    K = model.intrinsics
    if model.is_pinhole and field_of_view_deg == FIELD_OF_VIEW_DEG:
        return K
    limit = float(np.tan(np.deg2rad(0.5 * field_of_view_deg)))
    fx, fy = model.axis_scale * K.fx, model.axis_scale * K.fy
    columns, rows = np.arange(K.width), np.arange(K.height)
    column, row = np.clip([K.cx, K.cy], 0.0, [K.width - 1.0, K.height - 1.0])
    left, right = _slopes(model, np.column_stack([columns, np.full(len(columns), row)]), 0, limit)
    top, bottom = _slopes(model, np.column_stack([np.full(len(rows), column), rows]), 1, limit)
    # The outermost pixel centres look where the raw image's do: all of them have a source there.
    width, height = int(fx * (right - left)) + 1, int(fy * (bottom - top)) + 1
    if min(width, height) < _LEAST_SIDE_PX:
        found = f"a field of {width}x{height} px around the optical axis"
        raise DataError(f"camera ({model.name})", found, f"at least {_LEAST_SIDE_PX} px a side")
    intrinsics = (float(fx), float(fy), -fx * left, -fy * top)
    return pinhole_camera(intrinsics, (width, height), f"camera rectified from {model.name}")


def _slopes(model: CameraModel, uvs: FloatArray, axis: int, limit: float) -> tuple[float, float]:
    """Least and greatest X/Z (axis 0) or Y/Z (axis 1) of the rays through pixels, within +-limit."""
    rays, valid = model.unproject(uvs)
    front = rays[valid & (np.nan_to_num(rays[:, 2]) > 1e-6)]
    if not len(front):
        return 0.0, 0.0
    slopes = np.clip(front[:, axis] / front[:, 2], -limit, limit)
    return float(slopes.min()), float(slopes.max())


@dataclass(frozen=True)
class Rectification:
    """From the images of a distorted camera to those of a pinhole; its maps are computed once.

    Attributes:
        model: the camera that takes the images.
        camera: the pinhole.
    """

    model: CameraModel
    camera: PinholeCamera

    @classmethod
    def of(cls, model: CameraModel, field_of_view_deg: float = FIELD_OF_VIEW_DEG) -> Rectification:
        """To the :func:`rectified_camera`, which raises the errors."""
        return cls(model, rectified_camera(model, field_of_view_deg))

    @cached_property
    def _uvs(self) -> tuple[FloatArray, BoolArray]:
        """(h, w, 2) where each pixel of the pinhole is in the raw image [px], and (h, w) whether it has a
        source there."""
        camera, model = self.camera, self.model
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        uvs, valid = model.project(rays.reshape(-1, 3))
        uvs = np.where(valid[:, None], uvs, -1.0)
        # All four neighbours of a bilinear look-up are on the image.
        inside = ((uvs >= 0.0) & (uvs <= [model.width - 1, model.height - 1])).all(axis=1)
        return uvs.reshape(*u.shape, 2), np.asarray(inside).reshape(u.shape)

    @property
    def used_share(self) -> float:
        """Share of the raw image that the pinhole shows, by a grid over it."""
        sides = self.model.width, self.model.height
        grid = np.meshgrid(*(np.linspace(0.0, side - 1.0, min(side, _GRID)) for side in sides))
        rays, valid = self.model.unproject(np.column_stack([axis.ravel() for axis in grid]))
        uvs = self.camera.project(np.where(valid[:, None], rays, [0.0, 0.0, -1.0]))
        # Half a pixel around it: the pinhole begins and ends with the centres of the raw image's pixels.
        seen = (uvs >= -0.5) & (uvs <= [self.camera.width - 0.5, self.camera.height - 0.5])
        return float(np.mean(seen.all(axis=1)))

    @property
    def valid(self) -> BoolArray:
        """(h, w) False where the raw image has no source for a pixel of the pinhole."""
        return self._uvs[1]

    @cached_property
    def _columns_rows(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        uvs = self._uvs[0].astype(np.float32)
        return np.ascontiguousarray(uvs[..., 0]), np.ascontiguousarray(uvs[..., 1])

    @cached_property
    def _neighbours(self) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """(4, h, w) flat indices of the raw pixels around each source, and (4, h, w) bilinear weights."""
        uvs = np.clip(self._uvs[0], 0.0, [self.model.width - 1, self.model.height - 1])
        first = np.floor(np.minimum(uvs, [self.model.width - 2, self.model.height - 2])).astype(np.intp)
        share = np.moveaxis((uvs - first).astype(np.float32), -1, 0)
        a = np.stack([1.0 - share[0], share[0], 1.0 - share[0], share[0]])
        b = np.stack([1.0 - share[1], 1.0 - share[1], share[1], share[1]])
        index = first[..., 1] * self.model.width + first[..., 0]
        steps = np.array([0, 1, self.model.width, self.model.width + 1])[:, None, None]
        return index + steps, a * b

    @cached_property
    def _fill(self) -> tuple[NDArray[np.intp], ...]:
        """Rows and columns of the pixels without source, and of the nearest one with a source."""
        nearest = _nearest(~self.valid)
        rows, columns = np.nonzero(~self.valid)
        return rows, columns, nearest[0][rows, columns], nearest[1][rows, columns]

    @cached_property
    def stretch(self) -> PixelStretch:
        """By how much the pinhole's pixels are enlarged."""
        camera, sides = self.camera, (self.camera.width, self.camera.height)
        us, vs = (np.arange(0, side - 1 + _STRETCH_STEP_PX, _STRETCH_STEP_PX) for side in sides)
        centres = np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 2)
        around = centres + 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[:, None]
        rays = (around - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        uvs, valid = self.model.project(np.append(rays, np.ones((*rays.shape[:2], 1)), axis=2).reshape(-1, 3))
        right, left, below, above = np.where(valid[:, None], uvs, np.nan).reshape(4, -1, 2)
        J = np.stack([right - left, below - above], axis=-1)
        known = np.isfinite(J).all(axis=(1, 2))
        known[known] = np.abs(np.linalg.det(J[known])) > _LEAST_SHRINKING
        if not known.any():
            J, known = np.tile(np.eye(2), (len(J), 1, 1)), np.ones(len(J), np.bool_)
        inverse = np.linalg.inv(np.where(known[:, None, None], J, np.eye(2)))
        A = inverse @ np.swapaxes(inverse, 1, 2)
        squares = A.reshape(len(vs), len(us), 4)[:, :, [0, 1, 3]].astype(np.float32)
        # Beyond the lens's field as at the nearest place within it.
        missing = ~known.reshape(len(vs), len(us))
        nearest = _nearest(missing)
        return PixelStretch(squares[nearest[0], nearest[1]], _STRETCH_STEP_PX)

    def picture(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(h, w, 3) rectified picture, bilinear.

        A pixel without source takes the colour of the nearest one that has a source: a black area would have
        an edge around it.

        Raises:
            DataError: the picture has not the size of the camera.
        """
        self._check(pixels, "picture")
        warped = np.asarray(cv2.remap(pixels, *self._columns_rows, cv2.INTER_LINEAR), np.uint8)
        if self.valid.any() and not self.valid.all():
            rows, columns, near_rows, near_columns = self._fill
            warped[rows, columns] = warped[near_rows, near_columns]
        return warped

    def labels(
        self, mask: NDArray[np.uint8], instances: NDArray[np.uint16] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16] | None]:
        """(h, w) rectified classes and instances; IGNORE and 0 where there is no source.

        A pixel takes the label, class and instance together, that has the most bilinear weight among the four
        raw pixels around its source: contours are cut at their place within the raw pixel, which counts where
        the pinhole enlarges.

        Raises:
            DataError: the mask has not the size of the camera.
        """
        self._check(mask, "mask")
        both = mask.astype(np.uint32)
        if instances is not None:
            self._check(instances, "picture of instances")
            both |= instances.astype(np.uint32) << 8
        chosen = self._majority(both)
        classes = np.where(self.valid, chosen & 0xFF, int(SemanticClass.IGNORE)).astype(np.uint8)
        if instances is None:
            return classes, None
        return classes, np.where(self.valid, chosen >> 8, 0).astype(np.uint16)

    def _majority(self, labels: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """(h, w) label of most weight among the four around each source."""
        index, weights = self._neighbours
        around = labels.reshape(-1).take(index)
        chosen = around[0].copy()
        mixed = (around[1:] != around[0]).any(axis=0)
        some, share = around[:, mixed], weights[:, mixed]
        votes = np.stack([np.where(some == one, share, 0.0).sum(axis=0) for one in some])
        chosen[mixed] = np.take_along_axis(some, votes.argmax(axis=0)[None], axis=0)[0]
        return np.asarray(chosen, np.uint32)

    def image(self, image: CameraImage) -> CameraImage:
        """The image as the pinhole would have taken it.

        Raises:
            DataError: its picture or its mask has not the size of the camera.
        """
        mask, instances = self.labels(image.mask, image.instances)
        pixels = self.picture(image.pixels) if image.has_picture else image.pixels
        valid = None if self.valid.all() else self.valid
        return CameraImage(image.stamp_ns, mask, pixels, instances, valid, self.stretch)

    def _check(self, array: NDArray[Any], what: str) -> None:
        if array.shape[:2] != (self.model.height, self.model.width):
            found = f"a {what} of {array.shape[1]}x{array.shape[0]} px"
            raise DataError(
                "rectification", found, f"{self.model.width}x{self.model.height} px, the camera's"
            )


def _nearest(missing: BoolArray) -> NDArray[np.intp]:
    """(2, h, w) row and column of the nearest place that is not missing."""
    from scipy import ndimage  # every reader imports this module, and only distorted cameras need that

    return np.asarray(ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True))
