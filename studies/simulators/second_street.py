"""A second street simulator that shares nothing with the one inside ``sst_graph``.

What holds on one simulator may hold of that simulator only. This one builds its streets from convex bodies:
a LiDAR ray meets a body where it enters its half-spaces last, and a mask is the filled hulls of the bodies'
corners, the farther ones first. Rays are ideal, lasers sit in one point, cars have open undersides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, SemanticClass

FloatArray = NDArray[np.float64]

LASERS_DEG = {
    "64": np.r_[np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)],
    "32": np.r_[np.linspace(12.0, 3.0, 6), np.linspace(2.0, -6.0, 18), np.linspace(-8.0, -25.0, 8)],
    "128": np.linspace(22.0, -22.0, 128),
}
AZIMUTH_STEP_DEG = {"64": 0.18, "32": 0.2, "128": 0.35}
"""By number of lasers."""

_HEIGHT_M = 1.73
_RANGE_M, _RANGE_NOISE_M, _LOST = 90.0, 0.02, 0.03
_FINE = 5
"""Masks are drawn so many times finer and read at the pixels' centres."""
_NEAR_M = 0.15
"""Bodies are drawn from here on [m]."""


@dataclass(frozen=True)
class StreetConfig:
    """A drive through a street of convex bodies.

    Attributes:
        seed: of everything random.
        frames: number of scans and of images.
        motion: ``standing``, ``stop`` (brakes, stands, goes on), ``vary`` (never stands) or ``constant``.
        time_offset_s: an image stamped t shows the world at LiDAR time t + offset [s].
        width, height, focal_px: camera.
        lasers: a key of :data:`LASERS_DEG`.
        density: vehicles per metre of street.
        moving_fraction: share of the vehicles that move.
        label_noise: 0 is exact; 1: contours wander by 0.7 px, vehicles shrink or grow by -1 to +2 px, 5 % of
            them are missed, blobs appear, and 1 % of the points is mislabelled.
    """

    seed: int = 0
    frames: int = 40
    motion: str = "stop"
    time_offset_s: float = 0.1
    width: int = 1242
    height: int = 375
    focal_px: float = 721.5
    lasers: str = "64"
    density: float = 0.1
    moving_fraction: float = 0.0
    label_noise: float = 1.0


class Body:
    """The convex hull of corners (n, 3) [m]; ``velocity`` (3,) [m/s] in the world."""

    def __init__(self, corners: FloatArray, label: SemanticClass, number: int, velocity: float = 0.0) -> None:
        self.corners, self.label, self.number = corners, label, number
        self.velocity = np.array([velocity, 0.0, 0.0])
        hull = ConvexHull(corners)
        self.planes = np.unique(hull.equations.round(9), axis=0)
        self.centre = corners.mean(axis=0)
        self.radius = float(np.linalg.norm(corners - self.centre, axis=1).max())


class SecondStreet:
    """A drive (satisfies :class:`sst_graph.types.Source`)."""

    period_s = 0.1

    def __init__(self, config: StreetConfig) -> None:
        self.config = config
        rng = np.random.default_rng([config.seed, 777])
        centre = (config.width / 2 + 8 * rng.normal(), config.height * (0.5 - rng.uniform(0.0, 0.08)))
        self.camera = PinholeCamera(
            config.focal_px, config.focal_px, *centre, width=config.width, height=config.height
        )
        looking = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
        self.nominal = gtsam.Pose3(looking, np.array([0.05, -0.08, -0.27]))
        turn, shift = _direction(rng) * np.radians(1.5), _direction(rng) * 0.05
        cTl = gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift + self.nominal.translation())
        self.truth = GroundTruth(
            gtsam.Pose3(cTl.rotation() * looking, cTl.translation()), config.time_offset_s
        )
        self.name = f"street-{config.seed}"
        self._times, self._path = _path(config)
        self.bodies = _street(config, float(self._path[:, 0].max()), rng)

    def __len__(self) -> int:
        return self.config.frames

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, position: int) -> Frame:
        return Frame(position, self._scan(position), self._image(position))

    def wTl(self, time_s: float) -> gtsam.Pose3:
        """Pose of the LiDAR at a time of its clock."""
        x, pitch, roll, z = (np.interp(time_s, self._times, column) for column in self._path.T)
        return gtsam.Pose3(gtsam.Rot3.Ypr(0.0, pitch, roll), np.array([x, 0.0, z]))

    @cached_property
    def _lookup(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        labels = [SemanticClass.GROUND, *(body.label for body in self.bodies)]
        return np.array(labels, np.uint8), np.array([0, *(b.number for b in self.bodies)], np.uint16)

    def _scan(self, k: int) -> Scan:
        rng, time_s = np.random.default_rng([self.config.seed, k, 1]), k * self.period_s
        step = AZIMUTH_STEP_DEG[self.config.lasers]
        azimuths = np.radians(np.arange(-75.0, 75.0, step) + rng.uniform(0.0, step))
        up, around = (
            a.ravel()
            for a in np.meshgrid(np.radians(LASERS_DEG[self.config.lasers]), azimuths, indexing="ij")
        )
        rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
        wTl = self.wTl(time_s)
        ranges, met = cast(self.bodies, wTl.translation(), rays @ wTl.rotation().matrix().T, time_s)
        seen = (ranges < _RANGE_M) & (rng.random(len(ranges)) > _LOST)
        noisy = ranges + _RANGE_NOISE_M * rng.normal(size=len(ranges))
        classes = self._lookup[0][met + 1]
        wrong = rng.random(len(classes)) < 0.01 * self.config.label_noise
        classes[wrong] = rng.integers(1, 6, wrong.sum())
        points = (rays[seen] * noisy[seen, None]).astype(np.float32)
        return Scan(round(time_s * 1e9), points, classes[seen])

    def _image(self, k: int) -> CameraImage:
        rng, stamp_s = np.random.default_rng([self.config.seed, k, 2]), k * self.period_s
        time_s = stamp_s + self.config.time_offset_s
        cTw = self.truth.cTl * self.wTl(time_s).inverse()
        mask, numbers = self._drawn(cTw, time_s)
        if self.config.label_noise > 0.0:
            mask = _spoiled(mask, numbers, self.config.label_noise, rng)
        return CameraImage(round(stamp_s * 1e9), mask, np.zeros((*mask.shape, 3), np.uint8))

    def _drawn(self, cTw: gtsam.Pose3, time_s: float) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Classes and body numbers of all pixels."""
        h, w = self.config.height, self.config.width
        v, u = np.mgrid[0:h, 0:w]
        rays = np.stack(
            [(u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy, np.ones((h, w))]
        )
        down = np.tensordot(cTw.rotation().matrix()[:, 2], rays, 1) < -0.002
        sky = np.where(down, SemanticClass.GROUND, SemanticClass.SKY).astype(np.uint8)
        mask = np.kron(sky, np.ones((_FINE, _FINE), np.uint8))
        numbers = np.zeros(mask.shape, np.uint16)
        eye = cTw.inverse().translation()
        order: list[tuple[float, int, Body, FloatArray]] = []
        for body in self.bodies:
            corners = body.corners + body.velocity * time_s
            nearest = np.clip(eye, corners.min(axis=0), corners.max(axis=0))
            order.append((-float(np.linalg.norm(nearest - eye)), len(order), body, corners))
        for _, _, body, corners in sorted(order):
            outline = self._outline(corners @ cTw.rotation().matrix().T + cTw.translation())
            if outline is not None:
                cv2.fillConvexPoly(mask, outline, int(body.label), cv2.LINE_8, 4)
                cv2.fillConvexPoly(numbers, outline, body.number, cv2.LINE_8, 4)
        middle = _FINE // 2
        return mask[middle::_FINE, middle::_FINE].copy(), numbers[middle::_FINE, middle::_FINE].copy()

    def _outline(self, cPs: FloatArray) -> NDArray[np.int32] | None:
        """Hull (k, 2) of a body's corners in the fine image, in sixteenths; None behind the camera."""
        before = cPs[:, 2] > _NEAR_M
        if not before.any():
            return None
        if not before.all():
            edges = ConvexHull(cPs).simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            a, b = cPs[edges[:, 0]], cPs[edges[:, 1]]
            crossing = (a[:, 2] > _NEAR_M) != (b[:, 2] > _NEAR_M)
            a, b = a[crossing], b[crossing]
            cPs = np.concatenate([cPs[before], a + (b - a) * ((a[:, 2:] - _NEAR_M) / (a[:, 2:] - b[:, 2:]))])
        u = self.camera.fx * cPs[:, 0] / cPs[:, 2] + self.camera.cx
        v = self.camera.fy * cPs[:, 1] / cPs[:, 2] + self.camera.cy
        fine = np.clip(np.stack([u, v], axis=1), -4000.0, 6000.0) * _FINE + _FINE // 2
        return np.round(cv2.convexHull(fine.astype(np.float32))[:, 0] * 16).astype(np.int32)


def cast(
    bodies: Sequence[Body], origin: FloatArray, rays: FloatArray, time_s: float
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Range of each ray (n, 3) [m], and which body it meets: -1 is the ground, at infinity none."""
    ranges, met = np.full(len(rays), np.inf), np.full(len(rays), -1)
    down = rays[:, 2] < -1e-6
    ranges[down] = -origin[2] / rays[down, 2]
    for number, body in enumerate(bodies):
        there = origin - body.velocity * time_s
        away = body.centre - there
        distance = float(np.linalg.norm(away))
        if distance > _RANGE_M + body.radius:
            continue
        # Rays within the cone of its bounding sphere, and within all half-spaces from entry to exit.
        cosine = np.sqrt(max(0.0, 1.0 - (body.radius / distance) ** 2)) if distance > body.radius else -1.0
        near = np.flatnonzero(rays @ (away / distance) > cosine - 1e-6)
        slopes, heights = rays[near] @ body.planes[:, :3].T, body.planes[:, :3] @ there + body.planes[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            times = -heights / slopes
        entry = np.where(slopes < 0, times, -np.inf).max(axis=1)
        leave = np.where(slopes > 0, times, np.inf).min(axis=1)
        passing = ((slopes == 0) & (heights > 0)).any(axis=1)
        hit = (entry < leave) & (entry > 0.5) & ~passing & (entry < ranges[near])
        ranges[near[hit]], met[near[hit]] = entry[hit], number
    return ranges, met


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _path(config: StreetConfig) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and [x, pitch, roll, height] (n, 4): the body sways while it rolls."""
    length = config.frames * SecondStreet.period_s
    t = np.arange(-1.0, length + 1.0, 0.01)
    speeds = {
        "standing": np.zeros_like(t),
        "stop": 8.0 * np.clip(np.abs(t - 0.5 * length) / (0.22 * length) - 0.35, 0.0, 1.0),
        "vary": 8.0 * (1.0 + 0.45 * np.sin(2.0 * np.pi * t / (0.6 * length) + config.seed)),
        "constant": np.full_like(t, 8.0),
    }
    speed = speeds[config.motion]
    rolls = speed > 0.1
    x = np.cumsum(speed) * 0.01
    x -= np.interp(0.0, t, x)
    sway = [0.004 * np.sin(5.0 * t + 1.0), 0.003 * np.sin(6.0 * t), 0.012 * np.sin(7.0 * t)]
    pitch, roll, height = (part * rolls for part in sway)
    return t, np.stack([x, pitch, roll, _HEIGHT_M + height], axis=1)


def _box(
    length: float, width: float, height: float, bottom: float = 0.0, taper: tuple[float, float] = (1.0, 1.0)
) -> FloatArray:
    low = np.array([[x * length / 2, y * width / 2, bottom] for x in (-1, 1) for y in (-1, 1)])
    return np.concatenate([low, low * [*taper, 1.0] + [0.0, 0.0, height]])


def _column(radius: float, height: float) -> FloatArray:
    turns = np.arange(10) * 2.0 * np.pi / 10.0
    ring = np.stack([radius * np.cos(turns), radius * np.sin(turns), np.zeros(10)], axis=1)
    return np.concatenate([ring, ring + np.array([0.0, 0.0, height])])


def _car(rng: np.random.Generator) -> list[FloatArray]:
    """Body, cabin and the two pairs of wheels of a car, its middle at the origin."""
    length, width, height = rng.uniform(3.7, 4.9), rng.uniform(1.65, 1.9), rng.uniform(0.55, 0.75)
    taper = (rng.uniform(0.6, 0.8), 0.82)
    cabin = _box(0.62 * length, 0.92 * width, rng.uniform(0.5, 0.75), 0.28 + height, taper)
    wheels = [_box(0.62, 0.94 * width, 0.6) + np.array([x * length, 0.0, 0.0]) for x in (-0.32, 0.32)]
    return [_box(length, width, height, 0.28, (0.97, 0.95)), cabin - [0.05 * length, 0.0, 0.0], *wheels]


def _truck(rng: np.random.Generator) -> list[FloatArray]:
    cab = _box(2.2, 2.3, 2.1, 0.5, (0.9, 0.95)) + np.array([4.2, 0.0, 0.0])
    return [cab, _box(rng.uniform(4.0, 6.0), 2.4, rng.uniform(2.3, 3.0), 0.7)]


def _street(config: StreetConfig, farthest_m: float, rng: np.random.Generator) -> list[Body]:
    """All bodies of a street along x, as far as the drive sees."""
    bodies: list[Body] = []
    number = 0

    def place(
        parts: Sequence[FloatArray],
        label: SemanticClass,
        x: float,
        y: float,
        yaw: float = 0.0,
        v: float = 0.0,
    ) -> None:
        nonlocal number
        number += 1
        turned = gtsam.Rot3.Rz(yaw).matrix()
        bodies.extend(Body(part @ turned.T + [x, y, 0.0], label, number, v) for part in parts)

    end_m = farthest_m + 75.0
    for side in (-1, 1):
        x = -25.0 + rng.uniform(0.0, 8.0)
        while x < end_m:
            truck, moves = rng.random() < 0.1, rng.random() < config.moving_fraction
            yaw = 0.04 * rng.normal() + np.pi * (rng.random() < 0.5)
            y, v = side * rng.uniform(3.4, 5.2), 0.0
            if moves:
                y, v = side * 3.2, -side * rng.uniform(3.0, 9.0)
            elif rng.random() < 0.12:
                y, yaw = side * 7.0, yaw + np.pi / 2
            place(_truck(rng) if truck else _car(rng), SemanticClass.VEHICLE, x + 2.2, y, yaw, v)
            x += (9.0 if truck else 4.5) + rng.exponential(2.0 / config.density) + 0.8
        x = -25.0
        while x < end_m:
            length, depth = rng.uniform(8.0, 20.0), rng.uniform(4.0, 10.0)
            house = _box(length, depth, rng.uniform(4.0, 12.0))
            if rng.random() < 0.75:
                place(
                    [house], SemanticClass.BUILDING, x + length / 2, side * (rng.uniform(10, 14) + depth / 2)
                )
            x += length + rng.uniform(0.0, 6.0)
        x = -25.0
        while x < end_m:
            y, kind = side * rng.uniform(6.2, 8.5), rng.random()
            if kind < 0.4:
                height, crown = rng.uniform(1.6, 2.6), rng.uniform(1.0, 2.0)
                leaves = np.stack([_direction(rng) for _ in range(24)]) * crown * [1.0, 1.0, 0.8]
                leaves += np.array([0.0, 0.0, height + 0.6 * crown])
                tree = [_column(rng.uniform(0.1, 0.25), height), leaves]
                place(tree, SemanticClass.VEGETATION, x, y)
            elif kind < 0.8:
                place([_column(rng.uniform(0.05, 0.12), rng.uniform(4.0, 7.0))], SemanticClass.POLE, x, y)
            else:
                place([_box(rng.uniform(1, 4), 0.8, rng.uniform(0.7, 1.4))], SemanticClass.VEGETATION, x, y)
            x += rng.uniform(4.0, 11.0)
    return bodies


def _spoiled(
    mask: NDArray[np.uint8], numbers: NDArray[np.uint16], noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """A mask as a network might give it."""
    wander = gaussian_filter(rng.normal(size=mask.shape), 5.0)
    wander *= 0.7 * noise / wander.std()
    result = mask.copy()
    for label in (
        SemanticClass.BUILDING,
        SemanticClass.VEGETATION,
        SemanticClass.POLE,
        SemanticClass.VEHICLE,
    ):
        for number in np.unique(numbers[mask == label]):
            body = (mask == label) & (numbers == number)
            rows, columns = np.nonzero(body)
            if len(rows) < 30:
                continue
            vehicle = label == SemanticClass.VEHICLE
            if vehicle and rng.random() < 0.05 * noise:
                result[body] = SemanticClass.OTHER
                continue
            near = np.s_[
                max(rows.min() - 8, 0) : rows.max() + 9, max(columns.min() - 8, 0) : columns.max() + 9
            ]
            inside = body[near]
            outwards = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
            inwards = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
            signed = np.where(inside, 0.5 - inwards, outwards - 0.5)
            found = signed < wander[near] + (noise * rng.uniform(-1.0, 2.0) if vehicle else 0.0)
            if not vehicle:
                found &= mask[near] != SemanticClass.VEHICLE
            result[near][inside & ~found] = SemanticClass.OTHER
            result[near][found] = label
    for _ in range(rng.poisson(0.2 * noise)):
        centre = (int(rng.integers(mask.shape[1])), int(rng.integers(mask.shape[0] // 3, mask.shape[0])))
        axes = (int(rng.integers(8, 50)), int(rng.integers(6, 25)))
        cv2.ellipse(result, centre, axes, 0, 0, 360, int(SemanticClass.VEHICLE), -1)
    return result
