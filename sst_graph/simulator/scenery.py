"""Ground, buildings, trees, poles, hedges, fences and people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_graph.simulator.mesh import (
    Colour,
    Mesh,
    blob_triangles,
    box_triangles,
    cylinder_triangles,
    grid_triangles,
    merged,
    soup,
)
from sst_graph.simulator.motion import Path
from sst_graph.simulator.surfaces import FACADES, FaceKind, Material
from sst_graph.types import FloatArray

KERB_M = 0.12
STATION_M = 4.0
"""Length of one piece of ground [m]."""
MARK_M = 0.004
"""Height of road markings and patches above the road [m]."""

WALLS: tuple[Colour, ...] = (
    (0.75, 0.85, 0.9),
    (0.6, 0.75, 0.85),
    (0.45, 0.6, 0.8),
    (0.8, 0.8, 0.78),
    (0.35, 0.45, 0.7),
    (0.6, 0.62, 0.6),
    (0.55, 0.7, 0.62),
)
ROOFS: tuple[Colour, ...] = ((0.22, 0.3, 0.55), (0.3, 0.3, 0.32), (0.2, 0.22, 0.4))


@dataclass(frozen=True)
class StreetProfile:
    """Cross-section of the street: distances from the centre line, right side (negative) and left [m].

    Attributes:
        lane: width of one driving lane.
        kerbs: distance of the kerb, right and left.
        walk: width of the side-walks.
        fronts: distance of the building line, right and left.
    """

    lane: float
    kerbs: tuple[float, float]
    walk: float
    fronts: tuple[float, float]


def _strip(path: Path, s: FloatArray, across: list[tuple[float, float]]) -> FloatArray:
    """Triangles of a strip over stations s through points (left, height) from right to left."""
    columns = [path.at(s, left) + np.array([0.0, 0.0, z]) for left, z in across]
    return grid_triangles(np.stack(columns, axis=1))


def ground(path: Path, profile: StreetProfile, s: FloatArray, verge: Material) -> Mesh:
    """Road, kerbs, side-walks and verges over the stations ``s`` (n,) [m]."""
    (right, left), walk, k = profile.kerbs, profile.walk, KERB_M
    asphalt, paving, grass = (0.45, 0.45, 0.45), (0.6, 0.62, 0.64), (0.35, 0.55, 0.45)
    middle = [-right + 0.01, -profile.lane, 0.0, profile.lane, left - 0.01]
    parts = [
        soup(_strip(path, s, [(y, 0.0) for y in middle]), FaceKind.ROAD, Material.ASPHALT, asphalt),
        soup(
            _strip(path, s, [(-right, k), (-right + 0.01, 0.0)]),
            FaceKind.SIDEWALK,
            Material.PLAIN,
            (0.5, 0.5, 0.5),
        ),
        soup(
            _strip(path, s, [(left - 0.01, 0.0), (left, k)]),
            FaceKind.SIDEWALK,
            Material.PLAIN,
            (0.5, 0.5, 0.5),
        ),
    ]
    for walk_edges, verge_edges in (
        ([-right - walk, -right], [-right - walk - 14.0, -right - walk - 5.0, -right - walk]),
        ([left, left + walk], [left + walk, left + walk + 5.0, left + walk + 14.0]),
    ):
        parts.append(
            soup(_strip(path, s, [(y, k) for y in walk_edges]), FaceKind.SIDEWALK, Material.PAVING, paving)
        )
        kind = FaceKind.TERRAIN if verge == Material.GRASS else FaceKind.SIDEWALK
        parts.append(soup(_strip(path, s, [(y, k) for y in verge_edges]), kind, verge, grass))
    return merged(parts)


def plain(path: Path) -> Mesh:
    """A plane below the whole street, so that no ray looks through the world's floor."""
    low, high = path.xy.min(axis=0) - 250.0, path.xy.max(axis=0) + 250.0
    x, y = np.linspace(low[0], high[0], 24), np.linspace(low[1], high[1], 24)
    z = float(path.height.min()) - 0.3
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((24, 24), z)], axis=2)
    return soup(grid_triangles(points), FaceKind.TERRAIN, Material.GRASS, (0.35, 0.5, 0.42))


def markings(path: Path, profile: StreetProfile, s: FloatArray, rng: np.random.Generator) -> Mesh:
    """Lane markings, repair patches and drain covers on the road between ``s[0]`` and ``s[-1]``."""
    white, parts = (0.85, 0.85, 0.85), []
    dashes = np.arange(s[0], s[-1], 6.0)
    for start in dashes:
        piece = np.array([start, start + 1.5, start + 3.0])
        parts.append(
            soup(_strip(path, piece, [(-0.06, MARK_M), (0.06, MARK_M)]), FaceKind.ROAD, Material.PLAIN, white)
        )
        for y in (-profile.lane - 0.06, profile.lane - 0.06):
            edge = [(y, MARK_M), (y + 0.12, MARK_M)]
            whole = np.linspace(start, start + 6.0, 4)
            if profile.kerbs[1] > profile.lane + 1.0:
                parts.append(soup(_strip(path, whole, edge), FaceKind.ROAD, Material.PLAIN, white))
    for _ in range(rng.poisson(0.3 * (s[-1] - s[0]))):
        at, y = rng.uniform(s[0], s[-1]), rng.uniform(-profile.lane, profile.lane)
        length, width = rng.uniform(0.4, 2.5), rng.uniform(0.2, 1.2)
        grey = float(rng.uniform(0.2, 0.6))
        patch = _strip(path, np.array([at, at + length]), [(y, MARK_M / 2), (y + width, MARK_M / 2)])
        parts.append(soup(patch, FaceKind.ROAD, Material.ASPHALT, (grey, grey, grey)))
    return merged(parts)


def building(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """A house whose front stands on y = 0 and faces +y; x from -length / 2 to length / 2."""
    wall = WALLS[int(rng.integers(len(WALLS)))]
    facade = int(Material.FACADE) + int(rng.integers(FACADES))
    box = soup(
        box_triangles((-length / 2, -depth, -1.0), (length / 2, 0.0, height)), FaceKind.BUILDING, facade, wall
    )
    box.textures[:, 0, 3] += rng.uniform(0.0, 12.0)
    parts = [box]
    roof = ROOFS[int(rng.integers(len(ROOFS)))]
    if rng.uniform() < 0.7:
        eave, ridge = 0.4, height + rng.uniform(1.5, 3.5)
        a, b = -length / 2 - 0.2, length / 2 + 0.2
        front = np.array(
            [
                [[a, eave, height - 0.1], [a, -depth / 2, ridge]],
                [[b, eave, height - 0.1], [b, -depth / 2, ridge]],
            ]
        )
        back = front * np.array([-1.0, 1.0, 1.0])
        back[:, 0, 1] = -depth - eave
        triangles = np.concatenate([grid_triangles(front)[:, ::-1], grid_triangles(back)[:, ::-1]])
        parts.append(soup(triangles, FaceKind.BUILDING, Material.ROOF, roof))
        gable = np.array([[b, -depth, height], [b, 0.0, height], [b, -depth / 2, ridge]]) - np.array(
            [0.2, 0, 0]
        )
        other = gable[::-1] * np.array([-1.0, 1.0, 1.0])
        parts.append(soup(np.stack([gable, other]), FaceKind.BUILDING, Material.PLAIN, wall))
    else:
        parapet = box_triangles(
            (-length / 2 - 0.15, -depth, height - 0.4), (length / 2 + 0.15, 0.15, height + 0.1)
        )
        parts.append(soup(parapet, FaceKind.BUILDING, Material.PLAIN, (0.5, 0.5, 0.5)))
    for _ in range(rng.poisson(length / 10.0)):
        x, floor = rng.uniform(-length / 2 + 1.5, length / 2 - 1.5), 3.0 * rng.integers(1, 3)
        if floor + 1.2 < height:
            balcony = box_triangles((x - 1.2, 0.0, floor), (x + 1.2, 1.1, floor + 1.0))
            parts.append(
                soup(
                    balcony, FaceKind.BUILDING, Material.PLAIN, (wall[0] * 0.8, wall[1] * 0.8, wall[2] * 0.8)
                )
            )
    return merged(parts)


def tree(rng: np.random.Generator) -> Mesh:
    """A tree on its root: a slightly leaning trunk, a few branches and a crown of rough blobs."""
    height, radius = rng.uniform(2.0, 3.2), rng.uniform(0.1, 0.22)
    top = np.array([*rng.normal(0.0, 0.12, 2), height + 1.0])
    bark = (0.25, 0.32, 0.4)
    stem = cylinder_triangles(np.array([0.0, 0.0, -0.3]), top, (1.15 * radius, 0.7 * radius), 9)
    parts = [soup(stem, FaceKind.TRUNK, Material.BARK, bark)]
    green = (rng.uniform(0.15, 0.3), rng.uniform(0.45, 0.65), rng.uniform(0.3, 0.5))
    spread = rng.uniform(1.0, 2.2)
    for _ in range(int(rng.integers(4, 8))):
        centre = top + np.array([*rng.normal(0.0, 0.55 * spread, 2), rng.uniform(0.2, 1.6 * spread)])
        size = spread * rng.uniform(0.5, 0.9, 3)
        blob = blob_triangles(rng, size, 0.2, rows=9) + centre
        parts.append(soup(blob, FaceKind.VEGETATION, Material.LEAVES, green))
        branch = cylinder_triangles(top - np.array([0, 0, 0.5]), centre, (0.4 * radius, 0.15 * radius), 5)
        parts.append(soup(branch, FaceKind.TRUNK, Material.BARK, bark))
    return merged(parts)


def hedge(rng: np.random.Generator, length: float) -> Mesh:
    """Bushes in a row along x, on y = 0."""
    parts, green = [], (rng.uniform(0.15, 0.25), rng.uniform(0.4, 0.6), rng.uniform(0.25, 0.45))
    tall = rng.uniform(0.5, 1.1)
    for x in np.arange(-length / 2, length / 2, 0.9):
        size = np.array([0.75, 0.55, tall]) * rng.uniform(0.85, 1.15, 3)
        blob = blob_triangles(rng, size, 0.22, rows=6) + np.array([x, 0.0, 0.3 * tall])
        parts.append(soup(blob, FaceKind.VEGETATION, Material.LEAVES, green))
    return merged(parts)


def fence(rng: np.random.Generator, length: float) -> Mesh:
    """A low wall or a fence of slats along x, on y = 0."""
    if rng.uniform() < 0.5:
        wall = box_triangles((-length / 2, -0.12, -0.2), (length / 2, 0.12, rng.uniform(0.7, 1.5)))
        return soup(wall, FaceKind.FENCE, Material.PAVING, (0.5, 0.55, 0.6))
    parts, brown = [], (0.2, 0.3, 0.42)
    for x in np.arange(-length / 2, length / 2, 0.35):
        parts.append(box_triangles((x, -0.03, -0.1), (x + 0.18, 0.03, 1.1 + 0.05 * rng.uniform())))
    parts.append(box_triangles((-length / 2, -0.06, 0.75), (length / 2, -0.03, 0.85)))
    return soup(np.concatenate(parts), FaceKind.FENCE, Material.BARK, brown)


def street_lamp(rng: np.random.Generator) -> Mesh:
    """A lamp post; its arm reaches along +y."""
    height, grey = rng.uniform(5.5, 8.0), (0.4, 0.42, 0.4)
    post = cylinder_triangles(np.array([0.0, 0.0, -0.2]), np.array([0.0, 0.0, height]), (0.08, 0.055), 10)
    arm = cylinder_triangles(
        np.array([0.0, 0.0, height]), np.array([0.0, 1.5, height + 0.25]), (0.05, 0.04), 6
    )
    lamp = box_triangles((-0.12, 1.2, height + 0.2), (0.12, 1.9, height + 0.35))
    return soup(np.concatenate([post, arm, lamp]), FaceKind.POLE, Material.METAL, grey)


def traffic_sign(rng: np.random.Generator) -> Mesh:
    """A sign on a post, facing -x."""
    height = rng.uniform(2.0, 2.4)
    post = cylinder_triangles(
        np.array([0.0, 0.0, -0.2]), np.array([0.0, 0.0, height + 0.7]), (0.035, 0.035), 8
    )
    parts = [soup(post, FaceKind.POLE, Material.METAL, (0.5, 0.5, 0.5))]
    face: Colour = ((0.1, 0.1, 0.75), (0.7, 0.3, 0.1), (0.75, 0.75, 0.75), (0.1, 0.7, 0.8))[
        int(rng.integers(4))
    ]
    centre = np.array([-0.05, 0.0, height + 0.35])
    if rng.uniform() < 0.6:
        plate = cylinder_triangles(centre, centre - np.array([0.02, 0, 0]), (0.32, 0.32), 18)
        inner = cylinder_triangles(centre, centre - np.array([0.024, 0, 0]), (0.22, 0.22), 14)
        parts.append(soup(inner, FaceKind.SIGN, Material.PLAIN, (0.8, 0.8, 0.8)))
    else:
        plate = box_triangles((-0.07, -0.3, height + 0.05), (-0.04, 0.3, height + 0.65))
    parts.append(soup(plate, FaceKind.SIGN, Material.PLAIN, face))
    return merged(parts)


def person(rng: np.random.Generator) -> Mesh:
    """Somebody who stands or walks: legs, trunk, arms, head; faces +x."""
    size = rng.uniform(0.9, 1.08)
    coat = tuple(float(c) for c in rng.uniform(0.05, 0.7, 3))
    legs = tuple(float(c) for c in rng.uniform(0.03, 0.3, 3))
    stride = rng.uniform(0.0, 0.25)
    parts = []
    for side in (-1.0, 1.0):
        hip, foot = np.array([0.0, 0.09 * side, 0.85]), np.array([stride * side, 0.1 * side, 0.02])
        parts.append(
            soup(
                cylinder_triangles(foot, hip, (0.06, 0.09), 7),
                FaceKind.PERSON,
                Material.PLAIN,
                (legs[0], legs[1], legs[2]),
            )
        )
        shoulder, hand = np.array([0.0, 0.22 * side, 1.42]), np.array([-stride * side, 0.26 * side, 0.8])
        arm = cylinder_triangles(hand, shoulder, (0.045, 0.06), 6)
        parts.append(soup(arm, FaceKind.PERSON, Material.PLAIN, (coat[0], coat[1], coat[2])))
    chest = blob_triangles(rng, np.array([0.15, 0.22, 0.38]), 0.03, 8) + np.array([0.0, 0.0, 1.14])
    parts.append(soup(chest, FaceKind.PERSON, Material.PLAIN, (coat[0], coat[1], coat[2])))
    head = blob_triangles(rng, np.array([0.1, 0.09, 0.13]), 0.02, 7) + np.array([0.0, 0.0, 1.62])
    parts.append(soup(head, FaceKind.PERSON, Material.PLAIN, (0.45, 0.55, 0.75)))
    return merged(parts).placed(np.eye(3) * size, np.zeros(3))


def shadow(length: float, width: float, sun: FloatArray) -> Mesh:
    """The dark ground below and beside a vehicle; ``sun`` (2,): where the shadow falls, in its frame [m]."""
    x, y = length / 2, width / 2
    outline = np.array([[-x, -y], [x - 0.2, -y], [x, -y + 0.3], [x, y - 0.3], [x - 0.2, y], [-x, y]])
    outline = np.where(outline * sun > 0, outline + sun, outline)
    corners = np.column_stack([outline, np.full(len(outline), MARK_M + 0.003)])
    centre = np.broadcast_to(corners.mean(axis=0), corners.shape)
    fan = np.stack([centre, corners, np.roll(corners, -1, axis=0)], axis=1)
    return soup(fan, FaceKind.ROAD, Material.ASPHALT, (0.14, 0.13, 0.13))
