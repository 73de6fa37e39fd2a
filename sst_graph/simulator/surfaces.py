"""What a surface is made of and how each dataset's labels name it."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import SemanticClass


class FaceKind(IntEnum):
    """What a face belongs to; the index into the label tables below."""

    ROAD = 0
    SIDEWALK = 1
    TERRAIN = 2
    BUILDING = 3
    FENCE = 4
    VEGETATION = 5
    TRUNK = 6
    POLE = 7
    SIGN = 8
    CAR = 9
    TRUCK = 10
    PERSON = 11
    SKY = 12


_TABLE: dict[FaceKind, tuple[int, int, SemanticClass]] = {
    FaceKind.ROAD: (40, 7, SemanticClass.GROUND),
    FaceKind.SIDEWALK: (48, 8, SemanticClass.GROUND),
    FaceKind.TERRAIN: (72, 22, SemanticClass.TERRAIN),
    FaceKind.BUILDING: (50, 11, SemanticClass.BUILDING),
    FaceKind.FENCE: (51, 13, SemanticClass.FENCE),
    FaceKind.VEGETATION: (70, 21, SemanticClass.VEGETATION),
    FaceKind.TRUNK: (71, 21, SemanticClass.VEGETATION),
    FaceKind.POLE: (80, 17, SemanticClass.POLE),
    FaceKind.SIGN: (81, 20, SemanticClass.SIGN),
    FaceKind.CAR: (10, 26, SemanticClass.VEHICLE),
    FaceKind.TRUCK: (18, 27, SemanticClass.VEHICLE),
    FaceKind.PERSON: (30, 24, SemanticClass.PERSON),
    FaceKind.SKY: (0, 23, SemanticClass.SKY),
}

SEMANTIC_KITTI = np.array([_TABLE[kind][0] for kind in FaceKind], dtype=np.uint32)
"""SemanticKITTI id of each kind."""
CITYSCAPES = np.array([_TABLE[kind][1] for kind in FaceKind], dtype=np.uint8)
"""Cityscapes label id of each kind."""
SEMANTIC_CLASS = np.array([_TABLE[kind][2] for kind in FaceKind], dtype=np.uint8)
""":class:`SemanticClass` of each kind."""


class Material(IntEnum):
    """Texture tile and reflectance of a face."""

    ASPHALT = 0
    PAVING = 1
    GRASS = 2
    PLAIN = 3
    PAINT = 4
    GLASS = 5
    RUBBER = 6
    LEAVES = 7
    BARK = 8
    ROOF = 9
    METAL = 10
    PANEL = 11
    FACADE = 12


FACADES = 8
"""Number of facade tiles: ``FACADE`` ... ``FACADE + FACADES - 1``."""
MATERIALS = int(Material.FACADE) + FACADES


def _per_material(default: float, values: dict[Material, float]) -> NDArray[np.float64]:
    table = np.full(MATERIALS, default)
    for material, value in values.items():
        table[material] = value
    return table


TILE_M = _per_material(
    12.0,
    {
        Material.ASPHALT: 8.0,
        Material.PAVING: 4.0,
        Material.GRASS: 4.0,
        Material.PLAIN: 8.0,
        Material.PAINT: 4.0,
        Material.GLASS: 4.0,
        Material.RUBBER: 1.0,
        Material.LEAVES: 3.0,
        Material.BARK: 1.0,
        Material.ROOF: 4.0,
        Material.METAL: 2.0,
        Material.PANEL: 8.0,
    },
)
"""Side of each material's (square, periodic) texture tile [m]."""

DETAIL = _per_material(
    0.35,
    {
        Material.ASPHALT: 1.0,
        Material.PAVING: 0.8,
        Material.GRASS: 1.0,
        Material.PAINT: 0.06,
        Material.GLASS: 0.02,
        Material.LEAVES: 1.0,
        Material.BARK: 1.0,
        Material.METAL: 0.25,
    },
)
"""Strength of the fine grain that is laid over each material's tile."""

EXTRA_LOSS = _per_material(
    0.0,
    {Material.GLASS: 0.72, Material.RUBBER: 0.15, Material.LEAVES: 0.08, Material.METAL: 0.03},
)
"""Share of LiDAR returns lost on each material, beside the configured drop-outs."""
