"""Cars, vans and trucks as lofted bodies with arches, wheels and a glazed cabin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator.mesh import (
    Colour,
    Mesh,
    box_triangles,
    cylinder_triangles,
    loft_triangles,
    merged,
    soup,
)
from sst_graph.simulator.surfaces import FaceKind, Material
from sst_graph.types import FloatArray

GLASS: Colour = (0.16, 0.14, 0.12)
BLACK: Colour = (0.035, 0.035, 0.035)
RIM: Colour = (0.5, 0.5, 0.5)
HEADLIGHT: Colour = (0.85, 0.85, 0.8)
TAILLIGHT: Colour = (0.05, 0.04, 0.5)

PAINTS: tuple[Colour, ...] = (
    (0.75, 0.75, 0.75),
    (0.55, 0.54, 0.52),
    (0.3, 0.3, 0.3),
    (0.04, 0.04, 0.04),
    (0.06, 0.05, 0.05),
    (0.35, 0.14, 0.07),
    (0.08, 0.07, 0.42),
    (0.12, 0.22, 0.14),
    (0.45, 0.55, 0.6),
    (0.1, 0.35, 0.5),
)


@dataclass(frozen=True)
class CarShape:
    """Proportions of a car [m]; x runs from the tail (-length / 2) to the nose.

    Attributes:
        length, width, height: over all.
        belt, hood, tail: heights of the belt line, of the hood's front edge and of the boot's rear edge.
        cowl, roof_front, roof_rear, cabin_rear: x of the windscreen's foot and head and of the rear
            window's head and foot, as fractions of the length from the tail.
        clearance: height of the sill.
        wheel: radius of the wheels.
    """

    length: float
    width: float
    height: float
    belt: float
    hood: float
    tail: float
    cowl: float
    roof_front: float
    roof_rear: float
    cabin_rear: float
    clearance: float = 0.2
    wheel: float = 0.31

    def x(self, fraction: float) -> float:
        """x [m] at a fraction of the length from the tail."""
        return (fraction - 0.5) * self.length

    @property
    def axles(self) -> tuple[float, float]:
        """x of the rear and the front axle [m]."""
        return self.x(0.19), self.x(0.8)


SHAPES: dict[str, CarShape] = {
    "sedan": CarShape(4.6, 1.8, 1.45, 0.93, 0.72, 0.95, 0.70, 0.54, 0.30, 0.14),
    "hatch": CarShape(4.0, 1.72, 1.47, 0.92, 0.72, 0.92, 0.73, 0.55, 0.12, 0.03),
    "estate": CarShape(4.7, 1.82, 1.48, 0.94, 0.74, 0.94, 0.72, 0.56, 0.08, 0.02),
    "suv": CarShape(4.5, 1.88, 1.7, 1.08, 0.92, 1.08, 0.72, 0.58, 0.1, 0.02, 0.27, 0.36),
    "van": CarShape(4.9, 1.9, 1.95, 1.08, 0.9, 1.1, 0.84, 0.70, 0.04, 0.01, 0.22, 0.33),
    "small": CarShape(3.55, 1.62, 1.5, 0.93, 0.76, 0.92, 0.78, 0.60, 0.13, 0.03, 0.19, 0.28),
}


def random_car(rng: np.random.Generator) -> Mesh:
    """A car of a random type, size and colour; its origin is on the ground under its middle."""
    name = str(rng.choice(list(SHAPES), p=[0.25, 0.27, 0.14, 0.14, 0.08, 0.12]))
    shape = SHAPES[name]
    shape = replace(
        shape,
        length=shape.length * rng.uniform(0.95, 1.06),
        width=shape.width * rng.uniform(0.97, 1.04),
        height=shape.height * rng.uniform(0.97, 1.05),
        cowl=shape.cowl + rng.uniform(-0.02, 0.02),
        roof_rear=shape.roof_rear + rng.uniform(-0.03, 0.03),
        hood=shape.hood + rng.uniform(-0.04, 0.04),
    )
    paint = PAINTS[
        int(rng.choice(len(PAINTS), p=[0.2, 0.16, 0.14, 0.12, 0.08, 0.08, 0.08, 0.04, 0.06, 0.04]))
    ]
    shade = rng.uniform(0.85, 1.15)
    return car_mesh(shape, (paint[0] * shade, paint[1] * shade, paint[2] * shade))


def car_mesh(shape: CarShape, paint: Colour) -> Mesh:
    """The car: body, cabin, underbody, wheels, mirrors, plates."""
    parts = [
        _body(shape, paint),
        _cabin(shape, paint),
        *_lamps(shape),
        *_wheels(shape.axles, shape.wheel, shape.width, FaceKind.CAR),
    ]
    half, rear, nose = shape.width / 2, -shape.length / 2, shape.length / 2
    inner = box_triangles((rear + 0.35, -half + 0.27, 0.19), (nose - 0.35, half - 0.27, 0.62))
    parts.append(soup(inner, FaceKind.CAR, Material.PLAIN, BLACK))
    x_mirror = shape.x(shape.cowl) - 0.28
    for side in (-1, 1):
        y = sorted((side * (half - 0.05), side * (half + 0.13)))
        mirror = box_triangles((x_mirror, y[0], shape.belt), (x_mirror + 0.12, y[1], shape.belt + 0.14))
        parts.append(soup(mirror, FaceKind.CAR, Material.PAINT, paint))
    for x in (rear - 0.015, nose - 0.005):
        z = 0.48 if x > 0 else 0.62
        plate = box_triangles((x, -0.26, z), (x + 0.02, 0.26, z + 0.11))
        parts.append(soup(plate, FaceKind.CAR, Material.PLAIN, (0.8, 0.85, 0.85)))
    return merged(parts)


def _mirrored(points: FloatArray) -> FloatArray:
    """Closed sections (s, k, 3) from their left halves (s, m, 3), bottom to top; the last point at y = 0."""
    right = points[:, -2::-1] * np.array([1.0, -1.0, 1.0])
    return np.concatenate([points, right], axis=1)


def _half_width(shape: CarShape, x: FloatArray) -> FloatArray:
    """Half the width at x: the corners are rounded in plan."""
    corner = 0.62 * shape.length / 2
    over = np.clip((np.abs(x) - corner) / (shape.length / 2 - corner), 0.0, 1.0)
    return np.asarray(shape.width / 2 * (1.0 - 0.2 * over**2.6))


def _body(shape: CarShape, paint: Colour) -> Mesh:
    """The body up to the belt line, with wheel arches and rounded corners."""
    nose, rear = shape.length / 2, -shape.length / 2
    arch = shape.wheel + 0.06
    fine = [axle + arch * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 7)) for axle in shape.axles]
    rounded = [
        np.array([rear, rear + 0.05, rear + 0.14, rear + 0.3, nose - 0.3, nose - 0.14, nose - 0.05, nose])
    ]
    hood = [np.array([shape.x(shape.cowl), shape.x(shape.cowl) - 0.3, 0.0, shape.x(0.12)])]
    x = np.unique(np.concatenate([*fine, *rounded, *hood]).round(4))
    top_x = [rear, rear + 0.05, rear + 0.25, shape.x(shape.cabin_rear), shape.x(shape.cowl)]
    top_z = [shape.tail - 0.2, shape.tail - 0.05, shape.tail, shape.belt + 0.01, shape.belt]
    top_x += [shape.x(shape.cowl) + 0.4, nose - 0.3, nose - 0.1, nose]
    top_z += [shape.belt - 0.03, shape.hood + 0.05, shape.hood, shape.hood - 0.2]
    order = np.argsort(top_x)
    top = np.interp(x, np.array(top_x)[order], np.array(top_z)[order])
    bottom = np.full(len(x), shape.clearance) + 0.1 * np.clip((np.abs(x) - nose + 0.3) / 0.3, 0, 1)
    for axle in shape.axles:
        inside = np.clip(arch**2 - (x - axle) ** 2, 0.0, None)
        bottom = np.maximum(bottom, np.where(inside > 0, shape.wheel + np.sqrt(inside), 0.0))
    bottom = np.minimum(bottom, top - 0.12)
    w = _half_width(shape, x)
    z = [
        bottom,
        bottom + 0.35 * (top - bottom),
        bottom + 0.62 * (top - bottom),
        top - 0.07,
        top - 0.015,
        top + 0.02,
    ]
    y = [0.97 * w, w, w, 0.965 * w, 0.86 * w, 0.0 * w]
    half = np.stack([np.stack([x, yi, zi], axis=1) for yi, zi in zip(y, z, strict=True)], axis=1)
    return soup(loft_triangles(_mirrored(half)), FaceKind.CAR, Material.PAINT, paint)


def _lamps(shape: CarShape) -> list[Mesh]:
    """Head and tail lamps, and the dark grille and bumper."""
    half, nose, parts = shape.width / 2, shape.length / 2, []
    for x, z, colour in (
        (nose - 0.1, shape.hood - 0.19, HEADLIGHT),
        (-nose - 0.015, shape.tail - 0.3, TAILLIGHT),
    ):
        high = z + (0.12 if x > 0 else 0.2)
        for side in (-1.0, 1.0):
            y = sorted((side * 0.5 * half, side * (0.775 if x > 0 else 0.79) * half))
            lamp = box_triangles((x, y[0], z), (x + 0.115, y[1], high))
            parts.append(soup(lamp, FaceKind.CAR, Material.PLAIN, colour))
    for low, high_x in ((nose - 0.05, nose + 0.012), (-nose - 0.012, -nose + 0.05)):
        bumper = box_triangles((low, -0.6 * half, 0.33), (high_x, 0.6 * half, 0.46))
        parts.append(soup(bumper, FaceKind.CAR, Material.PLAIN, BLACK))
    return parts


def _cabin(shape: CarShape, paint: Colour) -> Mesh:
    """The greenhouse: screens, side windows between pillars, roof with rounded edges."""
    x_foot, x_head = shape.x(shape.cabin_rear), shape.x(shape.roof_rear)
    x_screen, x_cowl = shape.x(shape.roof_front), shape.x(shape.cowl)
    pillar = 0.5 * (x_head + x_screen) + 0.1
    posts = [pillar - 0.05, pillar + 0.05, x_head + 0.12, x_screen - 0.06]
    middle = [x_head + 0.5 * (x_screen - x_head)]
    slopes = [*np.linspace(x_foot, x_head, 4), *np.linspace(x_screen, x_cowl, 4)]
    x = np.unique(np.array([*slopes, *posts, *middle]).round(4))
    rise = shape.height - shape.belt - 0.03
    roof_x = np.array([x_foot, x_head - 0.02, x_head + 0.15, middle[0], x_screen - 0.2, x_screen, x_cowl])
    roof_z = np.array([0.0, 0.9, 0.965, 1.0, 0.98, 0.93, 0.0]) * rise
    order = np.argsort(roof_x)
    h = np.interp(x, roof_x[order], roof_z[order])
    base = 0.93 * _half_width(shape, x)
    top = base - 0.28 * h
    z0 = np.full(len(x), shape.belt - 0.06)
    y = [base, base - 0.02, base - 0.26 * 0.8 * h - 0.02, top - 0.03, 0.8 * top - 0.03, 0.0 * top]
    z = [z0, z0 + 0.06, z0 + 0.06 + 0.8 * h, z0 + 0.06 + 0.95 * h, z0 + 0.06 + h, z0 + 0.09 + h]
    half = np.stack([np.stack([x, yi, zi], axis=1) for yi, zi in zip(y, z, strict=True)], axis=1)
    mesh = soup(loft_triangles(_mirrored(half)), FaceKind.CAR, Material.PAINT, paint)
    glass = _glazing(x, (x_foot, x_head, x_screen, x_cowl), pillar, half.shape[1])
    sides = np.zeros(len(mesh), np.bool_)
    sides[: 2 * glass.size] = np.concatenate([glass.ravel(), glass.ravel()])
    return mesh.recoloured(sides, Material.GLASS, GLASS)


def _glazing(
    x: FloatArray, marks: tuple[float, float, float, float], pillar: float, half: int
) -> NDArray[np.bool_]:
    """(s - 1, k) faces of the cabin's sides that are glass."""
    x_foot, x_head, x_screen, x_cowl = marks
    mid = 0.5 * (x[1:] + x[:-1])
    k = 2 * half - 1
    glass = np.zeros((len(mid), k), np.bool_)
    side = (mid > x_foot + 0.1) & (mid < x_cowl - 0.15) & (np.abs(mid - pillar) > 0.05)
    side &= ~((mid > x_head) & (mid < x_head + 0.12)) & ~((mid > x_screen - 0.06) & (mid < x_screen + 0.1))
    screen = (mid < x_head) | (mid > x_screen)
    for j in (1, k - 3):
        glass[:, j] = side
    for j in (3, 4, k - 6, k - 5):
        glass[:, j] = screen
    return glass


def _wheels(axles: tuple[float, ...], radius: float, width: float, kind: FaceKind) -> list[Mesh]:
    """Tyres with rims at both ends of each axle."""
    outer, inner = np.array([0.0, width / 2 - 0.02, radius]), np.array([0.0, width / 2 - 0.24, radius])
    rim = outer + np.array([0.0, 0.006, 0.0])
    tyre = soup(cylinder_triangles(inner, outer, (radius, radius), 14), kind, Material.RUBBER, BLACK)
    disc = cylinder_triangles(inner, rim, (0.66 * radius, 0.62 * radius), 10)
    left = merged([tyre, soup(disc, kind, Material.METAL, RIM)])
    right = left.placed(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    return [wheel.placed(np.eye(3), np.array([axle, 0.0, 0.0])) for axle in axles for wheel in (left, right)]


def random_truck(rng: np.random.Generator) -> Mesh:
    """A box truck of random size and colour; its origin is on the ground under its middle."""
    length, width, height = rng.uniform(6.0, 9.0), rng.uniform(2.2, 2.5), rng.uniform(2.7, 3.5)
    paint = PAINTS[int(rng.integers(len(PAINTS)))]
    box_paint = PAINTS[int(rng.choice([0, 0, 1, 8, 5, 6]))]
    nose, half, cab = length / 2, width / 2, 1.75
    cargo = box_triangles((-nose, -half, 0.95), (nose - cab - 0.12, half, height))
    frame = box_triangles((-nose + 0.1, -0.45, 0.55), (nose - 0.3, 0.45, 0.97))
    skirt = box_triangles((-nose + 2.6, -half + 0.1, 0.5), (nose - cab - 0.7, half - 0.1, 0.9))
    bumper = box_triangles((-nose + 0.05, -half + 0.15, 0.45), (-nose + 0.15, half - 0.15, 0.62))
    parts = [
        soup(cargo, FaceKind.TRUCK, Material.PANEL, box_paint),
        soup(frame, FaceKind.TRUCK, Material.PLAIN, BLACK),
        soup(skirt, FaceKind.TRUCK, Material.PLAIN, (0.2, 0.2, 0.2)),
        soup(bumper, FaceKind.TRUCK, Material.PLAIN, TAILLIGHT),
        _cab(nose, half, cab, min(height, 2.6), paint),
        *_wheels((-nose + 1.5, nose - 0.95), 0.45, width, FaceKind.TRUCK),
    ]
    return merged(parts)


def _cab(nose: float, half: float, cab: float, height: float, paint: Colour) -> Mesh:
    """A truck's cab with a windscreen and side windows."""
    x = nose - np.array([cab, cab - 0.45, 0.35, 0.18, 0.02, 0.0])
    top = np.array([height - 0.05, height, height - 0.02, height - 0.45, 1.45, 1.2])
    bottom = np.array([0.55, 0.55, 1.0, 0.5, 0.45, 0.5])
    bottom[1:3] = 0.95
    w = half * np.array([0.98, 1.0, 1.0, 0.98, 0.95, 0.9])
    belt = np.minimum(1.45, top - 0.1)
    z = [bottom, belt, np.maximum(top - 0.35, belt + 0.02), top - 0.08, top]
    y = [w, w, 0.98 * w, 0.94 * w, 0.0 * w]
    left = np.stack([np.stack([x, yi, zi], axis=1) for yi, zi in zip(y, z, strict=True)], axis=1)
    mesh = soup(loft_triangles(_mirrored(left)), FaceKind.TRUCK, Material.PAINT, paint)
    k = 2 * left.shape[1] - 1
    glass = np.zeros((len(x) - 1, k), np.bool_)
    glass[1, [1, k - 3]] = True
    glass[2:4, [2, 3, 4, k - 6, k - 5, k - 4]] = True
    mask = np.zeros(len(mesh), np.bool_)
    mask[: 2 * glass.size] = np.concatenate([glass.ravel(), glass.ravel()])
    return mesh.recoloured(mask, Material.GLASS, GLASS)
