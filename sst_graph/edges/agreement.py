"""How well LiDAR edges agree with the gradients of the pictures, under one pose or under many.

The score of a pose is the sum, over the boundary points in view, of the picture's strength across each
point's outward direction, above what is usual nearby, blurred. A wrong pose has a score around 0: what a
point meets by chance is as often below the usual as above it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import PairedEdges
from sst_graph.features.mask_contour import well_inside
from sst_graph.features.picture_gradients import (
    DIRECTIONS,
    STEP_PX,
    PictureGradients,
    profiles,
)
from sst_graph.graph.matching import DriveEdges
from sst_graph.graph.state import State
from sst_graph.points import transformed_points
from sst_graph.types import FloatArray, IntArray

FloatMap = NDArray[np.float32]

_NEAR_M = 0.5
"""Points nearer than this to the camera's plane are not in view [m]."""
_SOME = 60_000
"""Points, times poses, that are projected at once: their arrays fit into the cache."""


def score(edges: Sequence[DriveEdges], state: State, blur_px: float) -> float:
    """The score of a state: see the module.

    Args:
        blur_px: sigma of the blur, across each point's edge alone [px].
    """
    pairs = [(own.number, paired) for own in edges if (paired := own.paired(state)) is not None]
    return score_of_pairs(pairs, state, blur_px)


def score_of_pairs(pairs: Sequence[tuple[int, PairedEdges]], state: State, blur_px: float) -> float:
    """The score of a state near the one that scans and images were paired at, drive number by drive number.

    It is of the same points everywhere: with other pairs, other moving objects would be left out.
    """
    return float(sum(_of_paired(paired, state, number, blur_px).sum() for number, paired in pairs))


def _of_paired(paired: PairedEdges, state: State, number: int, blur_px: float) -> FloatArray:
    """(n,) share of each boundary point in view, of one drive."""
    at = state.calibration(number)
    uvs = paired.projected(paired.points.lPs, at)
    inside = np.flatnonzero(paired.camera.in_image(uvs))
    some, uvs = paired.take(inside), uvs[inside]
    ways = some.projected(some.points.outward, at) - uvs
    ways /= np.maximum(np.linalg.norm(ways, axis=1), 1e-9)[:, None]
    uvs = uvs + some.repeated(some.biases_px)[:, None] * ways
    groups = [
        (each, span)
        for each, span in zip(some.contours, some.spans, strict=True)
        if isinstance(each, PictureGradients)
    ]
    ts = np.arange(-2.5 * blur_px, 2.5 * blur_px + 1e-9, max(STEP_PX, blur_px / 4.0))
    weights = np.exp(-0.5 * (ts / blur_px) ** 2)
    weights /= weights.sum()
    strengths = profiles([each for each, _ in groups], [span for _, span in groups], uvs, ways, ts)
    known = well_inside(uvs[:, 0], uvs[:, 1], paired.camera.width, paired.camera.height)
    return np.where(known, weights @ strengths, 0.0)


@dataclass(frozen=True)
class BlurredScore:
    """Boundary points of some scans and the blurred gradients of their images, for many rotations.

    Attributes:
        paired: the points, and the motion around their images.
        lPs, tips: (n, 3) the points and those beyond them across the edge, moved to their images' instant, in
            the LiDAR frame [m].
        fields: (images, DIRECTIONS, h, w) blurred strengths of every so many pixels.
        images: (n,) which of them each point is compared with.
        every: pixels of the picture to one of the fields.
    """

    paired: PairedEdges
    lPs: FloatMap
    tips: FloatMap
    fields: FloatMap
    images: IntArray
    every: int

    @classmethod
    def of(
        cls,
        edges: DriveEdges,
        state: State,
        blur_px: float,
        known_fields: dict[int, FloatMap],
    ) -> BlurredScore | None:
        """At a state's time offset; its pose only takes points to the camera and back. None without pairs.

        Args:
            known_fields: fields under this blur by the identity of their gradients; new ones are put there.
        """
        at = state.calibration(edges.number)
        paired = edges.paired(state)
        if paired is None:
            return None
        seen = np.flatnonzero(paired.counts).tolist()
        known = [k for k in seen if isinstance(paired.contours[k], PictureGradients)]
        group = paired.repeated(np.arange(len(paired.contours)))
        paired_index = np.flatnonzero(np.isin(group, known))
        paired, group = paired.take(paired_index), group[paired_index]
        every = max(1, int(blur_px / 3.0))
        names = {k: number for number, k in enumerate(known)}
        for k in known:
            gradients = _gradients(paired, k)
            if id(gradients) not in known_fields:
                known_fields[id(gradients)] = gradients.blurred(blur_px, every)
        fields = np.stack([known_fields[id(paired.contours[k])] for k in known])
        to_lidar = at.cTl.inverse()
        lPs, tips = (
            transformed_points(to_lidar, paired.moved(each, at))
            for each in (paired.points.lPs, paired.points.outward)
        )
        numbers = np.array([names.get(k, -1) for k in range(len(paired.contours))])
        return cls(paired, lPs.astype(np.float32), tips.astype(np.float32), fields, numbers[group], every)

    def scores(self, rotations: FloatArray, translations: FloatArray) -> FloatArray:
        """(m,) scores of poses cRl (m, 3, 3), ctl (m, 3) [m]."""
        some = max(1, _SOME // max(1, len(self.lPs)))
        parts = [
            self._scores(rotations[a : a + some], translations[a : a + some])
            for a in range(0, len(rotations), some)
        ]
        return np.concatenate([np.zeros(0), *parts])

    def _scores(self, rotations: FloatArray, translations: FloatArray) -> FloatArray:
        camera = self.paired.camera
        R, t = rotations.astype(np.float32), translations.astype(np.float32)
        here, there = (R @ each.T + t[:, :, None] for each in (self.lPs, self.tips))
        ahead = here[:, 2] > _NEAR_M
        z, z_tip = (np.maximum(each[:, 2], np.float32(_NEAR_M)) for each in (here, there))
        fx, fy = np.float32(camera.fx), np.float32(camera.fy)
        u, v = fx * here[:, 0] / z + np.float32(camera.cx), fy * here[:, 1] / z + np.float32(camera.cy)
        du = fx * there[:, 0] / z_tip + np.float32(camera.cx) - u
        dv = fy * there[:, 1] / z_tip + np.float32(camera.cy) - v
        seen = ahead & well_inside(u, v, camera.width, camera.height)
        pose, point = np.nonzero(seen)
        angle = np.arctan2(dv[seen], du[seen]) * np.float32(DIRECTIONS / np.pi)
        number = np.rint(angle).astype(np.intp) % DIRECTIONS
        height, width = self.fields.shape[2:]
        column = np.minimum((u[seen] / self.every).astype(np.intp), width - 1)
        row = np.minimum((v[seen] / self.every).astype(np.intp), height - 1)
        place = ((self.images[point] * DIRECTIONS + number) * height + row) * width + column
        values = self.fields.reshape(-1)[place]
        return np.bincount(pose, values, len(rotations)).astype(np.float64)


def _gradients(paired: PairedEdges, group: int) -> PictureGradients:
    gradients = paired.contours[group]
    assert isinstance(gradients, PictureGradients)
    return gradients
