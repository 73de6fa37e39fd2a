"""Triangle soups with labels and textures, and the solids the street is made of.

Faces run counter-clockwise seen from outside. Frames: x forward, y left, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.motion import cross_rows
from sst_graph.simulator.surfaces import FaceKind, Material
from sst_graph.types import FloatArray

Colour = tuple[float, float, float]
"""Blue, green, red reflectance, 0 to 1 (above 1 brightens the texture)."""


@dataclass(frozen=True)
class Mesh:
    """A soup of n faces.

    Attributes:
        triangles: (n, 3, 3) corners [m].
        kinds: (n,) uint8 of :class:`FaceKind`.
        materials: (n,) uint8 of :class:`Material`.
        colours: (n, 3) float32 BGR reflectance.
        textures: (n, 2, 4) texture coordinates [m]: ``textures[:, :, :3] @ p + textures[:, :, 3]``.
    """

    triangles: FloatArray
    kinds: NDArray[np.uint8]
    materials: NDArray[np.uint8]
    colours: NDArray[np.float32]
    textures: FloatArray

    def __len__(self) -> int:
        return len(self.triangles)

    def placed(self, rotation: FloatArray, position: FloatArray) -> Mesh:
        """The mesh moved by p -> rotation p + position; the textures move along."""
        axes = _turned(self.textures[:, :, :3], rotation)
        shift = self.textures[:, :, 3] - axes @ position
        textures = np.concatenate([axes, shift[:, :, None]], axis=2)
        triangles = self.placed_triangles(rotation, position)
        return Mesh(triangles, self.kinds, self.materials, self.colours, textures)

    def placed_triangles(self, rotation: FloatArray, position: FloatArray) -> FloatArray:
        """The corners alone of :meth:`placed`."""
        return _turned(self.triangles, rotation) + position

    def part(self, pick: NDArray[np.intp]) -> Mesh:
        """The faces ``pick`` alone."""
        return extended(self, pick, [])

    def recoloured(self, mask: NDArray[np.bool_], material: Material, colour: Colour) -> Mesh:
        """The mesh with another material and colour on the faces of ``mask`` (n,)."""
        materials = np.where(mask, np.uint8(material), self.materials)
        colours = np.where(mask[:, None], np.asarray(colour, np.float32), self.colours)
        return Mesh(self.triangles, self.kinds, materials, colours, self.textures)


def yaw_rotation(yaw: float) -> FloatArray:
    """(3, 3) rotation about z by ``yaw`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def normals_of(triangles: FloatArray) -> FloatArray:
    """(n, 3) outward unit normals of triangles (n, 3, 3)."""
    normals = cross_rows(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.asarray(normals / np.maximum(np.sqrt((normals**2).sum(axis=1, keepdims=True)), 1e-12))


def seen_from(points: FloatArray, rotation: FloatArray, position: FloatArray) -> FloatArray:
    """World points (..., 3) in the frame of a pose: rotation (3, 3), position (3,) [m]."""
    return _turned(points - position, rotation.T)


def _turned(points: FloatArray, rotation: FloatArray) -> FloatArray:
    """(..., 3) rotated; one product of matrices in place of one for each triangle."""
    return np.asarray(points.reshape(-1, 3) @ rotation.T).reshape(points.shape)


def planar_textures(triangles: FloatArray) -> FloatArray:
    """(n, 2, 4) texture frames in each face's plane: along the horizontal and up the slope."""
    normals = normals_of(triangles)
    along = np.zeros_like(normals)
    along[:, 0], along[:, 1] = -normals[:, 1], normals[:, 0]
    size = np.sqrt((along**2).sum(axis=1, keepdims=True))
    flat = size[:, 0] < 0.3
    along /= np.maximum(size, 1e-12)
    along[flat] = (1.0, 0.0, 0.0)
    up = cross_rows(normals, along)
    up[flat] = (0.0, 1.0, 0.0)
    textures = np.zeros((len(triangles), 2, 4))
    textures[:, 0, :3], textures[:, 1, :3] = along, up
    return textures


def soup(triangles: FloatArray, kind: FaceKind, material: Material | int, colour: Colour) -> Mesh:
    """A mesh of one kind, material and colour from triangles (n, 3, 3)."""
    n = len(triangles)
    return Mesh(
        triangles,
        np.full(n, kind, np.uint8),
        np.full(n, material, np.uint8),
        np.full((n, 3), colour, np.float32),
        planar_textures(triangles),
    )


def merged(meshes: list[Mesh]) -> Mesh:
    """All faces of ``meshes`` in one mesh."""
    return Mesh(
        np.concatenate([m.triangles for m in meshes]),
        np.concatenate([m.kinds for m in meshes]),
        np.concatenate([m.materials for m in meshes]),
        np.concatenate([m.colours for m in meshes]),
        np.concatenate([m.textures for m in meshes]),
    )


def extended(mesh: Mesh, pick: NDArray[np.intp], more: list[Mesh]) -> Mesh:
    """The faces ``pick`` of a mesh, and all of further ones after them; each is copied once."""

    def joined(name: str) -> NDArray[Any]:
        first, rest = getattr(mesh, name), [getattr(m, name) for m in more]
        whole = np.empty((len(pick) + sum(map(len, rest)), *first.shape[1:]), first.dtype)
        first.take(pick, axis=0, out=whole[: len(pick)], mode="clip")
        if rest:
            np.concatenate(rest, out=whole[len(pick) :])
        return whole

    return Mesh(*(joined(field.name) for field in fields(Mesh)))


def grid_triangles(points: FloatArray) -> FloatArray:
    """(2 (r-1) (c-1), 3, 3) triangles of a grid of points (r, c, 3); columns to the left of rows
    (row direction x column direction points outward)."""
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    triangles = np.empty((2, *a.shape[:2], 3, 3))
    for half, corners in zip(triangles, ((a, b, c), (a, c, d)), strict=True):
        for k, corner in enumerate(corners):
            half[:, :, k] = corner
    return triangles.reshape(-1, 3, 3)


def loft_triangles(sections: FloatArray) -> FloatArray:
    """Triangles of a tube with caps through closed sections (s, k, 3), which turn counter-clockwise about the
    direction in which the sections advance (y to z for +x). The sides come first: face (i, j) of
    the (s - 1, k) sides is triangle i k + j, and again after (s - 1) k."""
    closed = np.concatenate([sections, sections[:, :1]], axis=1)
    parts = [grid_triangles(closed)[:, ::-1]]
    for section, reverse in ((sections[0], True), (sections[-1], False)):
        fan = np.empty((len(section), 3, 3))
        fan[:, 0], fan[:, 1] = section.mean(axis=0), section
        fan[:-1, 2], fan[-1, 2] = section[1:], section[0]
        parts.append(fan[:, ::-1] if reverse else fan)
    return np.concatenate(parts)


def box_triangles(low: Colour, high: Colour) -> FloatArray:
    """(12, 3, 3) triangles of an axis-parallel box between two corners [m]."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    ring = np.array([[y0, z0], [y1, z0], [y1, z1], [y0, z1]])
    sections = np.stack([np.column_stack([np.full(4, x), ring]) for x in (x0, x1)])
    return loft_triangles(sections)


def cylinder_triangles(
    start: FloatArray, end: FloatArray, radii: tuple[float, float], sides: int
) -> FloatArray:
    """Triangles of a (conical) cylinder between two axis points with ``sides`` faces around [m]."""
    axis = (end - start) / np.linalg.norm(end - start)
    helper = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    (first,) = cross_rows(helper[None], axis[None])
    first /= np.linalg.norm(first)
    (second,) = cross_rows(axis[None], first[None])
    angles = 2 * np.pi * np.arange(sides) / sides
    circle = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    return loft_triangles(np.stack([start + radii[0] * circle, end + radii[1] * circle]))


def blob_triangles(rng: np.random.Generator, radii: FloatArray, rough: float, rows: int) -> FloatArray:
    """Triangles of a rough ellipsoid about the origin: radii (3,) [m], ``rough`` the relative bumps."""
    columns = 2 * rows - 3
    polar = np.pi * np.arange(rows) / (rows - 1)
    azimuth = 2 * np.pi * np.arange(columns) / columns
    unit = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(azimuth),
            np.sin(polar)[:, None] * np.sin(azimuth),
            np.broadcast_to(np.cos(polar)[:, None], (rows, columns)),
        ],
        axis=2,
    )
    size = 1.0 + rough * rng.uniform(-1.0, 1.0, (rows, columns, 1))
    size[0], size[-1] = size[0, :1], size[-1, :1]
    points = unit * size * radii
    return grid_triangles(np.concatenate([points, points[:, :1]], axis=1))
