"""From faces to a picture: deferred shading with textures fixed to the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator.camera.textures import LEVELS, TILE, Atlas
from sst_graph.simulator.casting import AT_ONCE, IndexArray, compact
from sst_graph.simulator.mesh import Mesh, normals_of, seen_from
from sst_graph.simulator.surfaces import DETAIL, TILE_M, Material
from sst_graph.types import FloatArray

DETAIL_TILE_M = 2.5
"""Side of the tile of fine grain [m]; five millimetres a pixel."""
HAZE_M = 450.0
"""Depth at which the haze takes 63 % of the contrast [m]."""


@dataclass(frozen=True)
class Look:
    """What a street is painted with.

    Attributes:
        atlas, detail: textures; sky: (256, 1024, 3) panorama.
        sun: (3,) unit vector to the sun in the world.
        sunlight: share of the light that comes from the sun.
    """

    atlas: Atlas
    detail: Atlas
    sky: NDArray[np.uint8]
    sun: FloatArray
    sunlight: float


@dataclass(frozen=True)
class CameraView:
    """A camera at one instant.

    Attributes:
        camera: intrinsics.
        rotation, position: (3, 3) and (3,) [m] of the camera in the world.
    """

    camera: PinholeCamera
    rotation: FloatArray
    position: FloatArray

    def to_camera(self, points: FloatArray) -> FloatArray:
        """World points (..., 3) in the camera frame [m]."""
        return seen_from(points, self.rotation, self.position)

    def in_sight(self, triangles: FloatArray) -> IndexArray:
        """Which of the world's triangles (n, 3, 3) may be in the picture: none of the others is."""
        camera, (x, _, z) = self.camera, self.rotation.T
        # What is wholly behind the camera, or a pixel beyond the left or the right border, is out of sight.
        left, right = camera.fx * x + (camera.cx + 1.0) * z, (camera.width - camera.cx) * z - camera.fx * x
        planes = np.stack([z, left, right], axis=1)
        bounds, seen = self.position @ planes, np.empty(len(triangles), np.bool_)
        for begin in range(0, len(triangles), AT_ONCE):
            part = slice(begin, begin + AT_ONCE)
            inside = (triangles[part].reshape(-1, 3) @ planes > bounds).reshape(-1, 3, 3)
            some = inside[:, 0] | inside[:, 1] | inside[:, 2]
            seen[part] = some[:, 0] & some[:, 1] & some[:, 2]
        return np.flatnonzero(seen)


def shade(view: CameraView, mesh: Mesh, faces: IndexArray, depth: FloatArray, look: Look) -> NDArray[Any]:
    """(h, w, 3) float BGR light of faces (h, w) of ``mesh`` at depth z (h, w) [m], no blur or noise."""
    seen, index = compact(faces)
    if seen[0] < 0:
        # Pixels of the sky get any face; they are painted over below.
        seen = np.concatenate([[0], seen[1:]])
    part = mesh.part(seen)
    ground = faces >= 0
    z = np.where(ground, depth, 1.0).astype(np.float32)
    albedo = _textured(view, part, index, z, look)
    light = _lighting(part, look) * part.colours
    colour = albedo * light.astype(np.float32).take(index, axis=0)
    sky = _sky(view, look)
    haze = np.where(ground, 1.0 - np.exp(-z / np.float32(HAZE_M)), 1.0).astype(np.float32)[:, :, None]
    colour += haze * (sky - colour)
    return colour


def _lighting(part: Mesh, look: Look) -> FloatArray:
    """(n, 1) light on each face: sun and sky; flat paint and glass mirror some of the sky."""
    normal = normals_of(part.triangles)
    sun = np.clip(normal @ look.sun, 0.0, 1.0)
    sky = 0.62 + 0.38 * normal[:, 2]
    light = look.sunlight * sun + (1.0 - look.sunlight) * sky
    glossy = np.isin(part.materials, (Material.PAINT, Material.GLASS))
    light += np.where(glossy, 0.35 * np.clip(normal[:, 2], 0.0, 1.0) ** 2, 0.0)
    return np.asarray(1.85 * light)[:, None]


def _textured(
    view: CameraView, part: Mesh, index: IndexArray, z: NDArray[np.float32], look: Look
) -> NDArray[Any]:
    """(h, w, 3) float32 texture of faces ``index`` (h, w) of ``part`` at depth z."""
    camera = view.camera
    side = TILE_M[part.materials]
    axes = part.textures[:, :, :3] @ view.rotation
    origin = part.textures[:, :, :3] @ view.position + part.textures[:, :, 3]
    # Periodic in both tiles: 40 tiles of grain make 100 m; keep float32 numbers small.
    origin = np.mod(origin, np.lcm.reduce(np.round(side * 2).astype(np.int64)) * DETAIL_TILE_M)
    distance = np.abs(((part.triangles[:, 0] - view.position) * normals_of(part.triangles)).sum(axis=1))
    table = np.column_stack(
        [axes.reshape(-1, 6), origin, side, distance, DETAIL[part.materials], part.materials]
    )
    values = table.astype(np.float32).take(index, axis=0)
    x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)[None, :]
    y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)[:, None]
    u = z * (values[..., 0] * x + values[..., 1] * y + values[..., 2]) + values[..., 6]
    v = z * (values[..., 3] * x + values[..., 4] * y + values[..., 5]) + values[..., 7]
    # Area of a pixel on the face: z^3 / (f^2 |d|); its side, a little sharper than the mean.
    pixel = np.sqrt(z * z * z / np.maximum(values[..., 9], np.float32(1e-3))) / np.float32(camera.fx)
    level = np.clip(np.floor(np.log2(pixel * TILE / values[..., 8]) + np.float32(0.3)), 0, LEVELS - 1)
    base = look.atlas.sample(values[..., 11], u / values[..., 8], v / values[..., 8], level)
    level = np.clip(np.floor(np.log2(pixel * TILE / DETAIL_TILE_M) + np.float32(0.3)), 0, LEVELS - 1)
    zero = np.zeros_like(u)
    grain = look.detail.sample(zero, u / np.float32(DETAIL_TILE_M), v / np.float32(DETAIL_TILE_M), level)
    relief = 1.0 + values[..., 10] * (grain.astype(np.float32) / np.float32(128.0) - 1.0)
    return base.astype(np.float32) * relief[:, :, None]


def _sky(view: CameraView, look: Look) -> NDArray[np.float32]:
    """(h, w, 3) float32 sky behind each pixel."""
    camera = view.camera
    # A quarter of the pixels, enlarged: the sky is smooth.
    u = np.arange(0, camera.width + 4, 4, dtype=np.float64)
    v = np.arange(0, camera.height + 4, 4, dtype=np.float64)
    rays = np.stack(
        np.broadcast_arrays((u - camera.cx)[None, :] / camera.fx, (v - camera.cy)[:, None] / camera.fy, 1.0),
        axis=2,
    )
    world = rays @ view.rotation.T
    azimuth = np.arctan2(world[..., 1], world[..., 0])
    up = np.rad2deg(np.arctan2(world[..., 2], np.hypot(world[..., 0], world[..., 1])))
    column = np.mod(-azimuth / (2 * np.pi), 1.0) * look.sky.shape[1]
    row = np.clip((60.0 - up) / 70.0, 0.0, 1.0) * (look.sky.shape[0] - 1)
    coarse = cv2.remap(
        look.sky,
        column.astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    size = (coarse.shape[1] * 4, coarse.shape[0] * 4)
    full = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)[: camera.height, : camera.width]
    return np.asarray(full, np.float32)


def developed(colour: NDArray[Any], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Lens blur, exposure and sensor noise, then 8 bits."""
    blurred: NDArray[Any] = cv2.GaussianBlur(colour, (0, 0), 0.55)
    blurred *= float(rng.normal(1.0, 0.01))
    blurred += 1.7 * rng.standard_normal(blurred.shape, dtype=np.float32)
    return np.asarray(cv2.convertScaleAbs(np.maximum(blurred, 0.0)), np.uint8)
