"""A third street simulator, which differs from the other two where real sensors do.

A laser beam is a cone: rays all over it meet different surfaces, each sends back a pulse, and what the
receiver cannot part it averages (mixed points at edges). Of several pulses the strongest is reported, or
the first. Power falls with the square of the range and with the slant of the surface: dark paint is lost
where it is far, glass hardly answers. Vehicles have bevelled roofs and bonnets, and the LiDAR sits well
above the camera. A pixel's class is what its centre's ray meets first: half-spaces are intersected as they
are for the LiDAR.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

LASERS_DEG = {
    "16": np.linspace(15.0, -15.0, 16),
    "32": np.linspace(10.67, -30.67, 32),
    "64": np.r_[np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)],
    "128": np.r_[np.linspace(15.0, 4.0, 16), np.linspace(3.5, -6.0, 84), np.linspace(-6.5, -25.0, 28)],
}
AZIMUTH_STEP_DEG = 0.2

_RANGE_M, _NEAREST_M = 90.0, 1.0
_PULSE_M = 0.6
"""Two surfaces closer than this in range answer as one [m]."""
_FAINT = 0.01 / 50.0**2
"""Reflectance over squared range [1/m^2] at which half of the pulses are lost: 1 % at 50 m."""
_GLASS_REFLECTANCE = 0.012
_SUN = np.array([0.35, 0.5, 0.79])
_AHEAD_M = 70.0


@dataclass(frozen=True)
class ThirdConfig:
    """A drive; what the second simulator has too has its name there.

    Attributes:
        seed: of everything random.
        frames: number of scans and of images.
        motion: ``standing``, ``stop`` (brakes, stands, goes on), ``vary`` (never stands) or ``constant``.
        time_offset_s: an image stamped t shows the world at LiDAR time t + offset [s].
        width, height, focal_px: camera.
        lasers: a key of :data:`LASERS_DEG`.
        density: vehicles per metre of street.
        moving_fraction: share of the vehicles that move.
        label_noise: 0 is exact; 1: each vehicle's mask is larger by -1 to +2 px, the same in all frames but
            for 0.4 px, ragged by 0.6 px, 4 % are missed; 1 % of the points is mislabelled.
        camera_below_m: how far the camera is mounted below the LiDAR [m].
        divergence_mrad: full angle of a beam [mrad].
        rays: of which a beam consists: 1, 7 or 13.
        echo: which pulse is reported.
        range_noise_m: deviation of a range [m].
        losses: whether weak pulses are lost.
    """

    seed: int = 0
    frames: int = 40
    motion: str = "stop"
    time_offset_s: float = 0.1
    width: int = 1242
    height: int = 375
    focal_px: float = 721.5
    lasers: str = "64"
    density: float = 0.2
    moving_fraction: float = 0.0
    label_noise: float = 1.0
    camera_below_m: float = 0.25
    divergence_mrad: float = 2.0
    rays: int = 7
    echo: Literal["strongest", "first"] = "strongest"
    range_noise_m: float = 0.02
    losses: bool = True


class Solid:
    """A convex solid: the hull of corners (n, 3) [m], moving along x at ``speed`` [m/s].

    Attributes:
        planes: (m, 4) outward normals and offsets: inside is normal . p + offset < 0.
        glass: (m,) which faces are windows.
        reflectance: of the others, 0 to 1.
    """

    def __init__(self, corners: FloatArray, label: SemanticClass, number: int, reflectance: float) -> None:
        self.corners, self.label, self.number, self.reflectance = corners, label, number, reflectance
        self.planes = np.unique(ConvexHull(corners).equations.round(7), axis=0)
        self.glass = np.zeros(len(self.planes), np.bool_)
        self.speed = 0.0

    def glazed(self) -> Solid:
        """The same with windows for its walls, which lean by less than 50 degrees."""
        self.glass = np.abs(self.planes[:, 2]) < 0.75
        return self

    def at(self, time_s: float) -> FloatArray:
        """(3,) by how much it has moved [m]."""
        return np.array([self.speed * time_s, 0.0, 0.0])


@dataclass(frozen=True)
class Hits:
    """What rays meet first.

    Attributes:
        ranges: (...) distance, inf for none [m].
        solids: (...) number of the solid; -1 the ground, -2 nothing.
        faces: (...) number of its face.
    """

    ranges: FloatArray
    solids: IntArray
    faces: IntArray


def cast(
    planes: Sequence[FloatArray],
    eye: FloatArray,
    rays: FloatArray,
    windows: Sequence[tuple[slice, slice] | None],
) -> Hits:
    """First hits of unit rays (rows, columns, k, 3) from the eye [m].

    Args:
        planes: (m, 4) of each solid, as in :class:`Solid`.
        windows: rows and columns in which each solid can be met at all.
    """
    shape = rays.shape[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(rays[..., 2] < 0.0, -eye[2] / rays[..., 2], np.inf)
    met, faces = np.where(np.isfinite(ranges), -1, -2), np.zeros(shape, np.intp)
    for number, (own, window) in enumerate(zip(planes, windows, strict=True)):
        if window is None:
            continue
        part = rays[window]
        heights = own[:, :3] @ eye + own[:, 3]
        enter, leave = np.full(part.shape[:3], -np.inf), np.full(part.shape[:3], np.inf)
        face = np.zeros(part.shape[:3], np.intp)
        # Plane by plane: the ray is inside from its last entry to its first exit.
        for k, (plane, height) in enumerate(zip(own, heights, strict=True)):
            slope = part @ plane[:3]
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = -height / slope
            later = (slope < 0.0) & (crossing > enter)
            enter[later], face[later] = crossing[later], k
            sooner = (slope > 0.0) & (crossing < leave)
            leave[sooner] = crossing[sooner]
        hit = (enter < leave) & (enter > 0.3) & (enter < ranges[window])
        ranges[window] = np.where(hit, enter, ranges[window])
        met[window] = np.where(hit, number, met[window])
        faces[window] = np.where(hit, face, faces[window])
    return Hits(ranges, met, faces)


class ThirdStreet:
    """A drive (satisfies :class:`sst_graph.types.Source`)."""

    period_s = 0.1

    def __init__(self, config: ThirdConfig) -> None:
        self.config = config
        rng = np.random.default_rng([config.seed, 333])
        centre = config.width / 2 + 5 * rng.normal(), config.height * (0.46 + 0.03 * rng.normal())
        focal = config.focal_px
        self.camera = PinholeCamera(focal, focal, *centre, width=config.width, height=config.height)
        looking = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
        self.nominal = gtsam.Pose3(looking, np.array([0.0, -config.camera_below_m, -0.4]))
        turn, shift = (size * rng.uniform(-1.0, 1.0, 3) for size in (np.radians(1.2), 0.04))
        away = gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift)
        self.truth = GroundTruth(self.nominal * away, config.time_offset_s)
        self.name = f"third-{config.seed}"
        self._times, self._path = _path(config, rng)
        self.solids = _street(config, float(self._path[:, 0].max()), rng)
        self._growths = rng.uniform(-1.0, 2.0, 1 + max(solid.number for solid in self.solids))

    def __len__(self) -> int:
        return self.config.frames

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, position: int) -> Frame:
        return Frame(position, self._scan(position), self._image(position))

    def wTl(self, time_s: float) -> gtsam.Pose3:
        """Pose of the LiDAR at a time of its clock."""
        x, y, z, yaw, pitch, roll = (np.interp(time_s, self._times, column) for column in self._path.T)
        return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z]))

    @cached_property
    def _labels(self) -> NDArray[np.uint8]:
        """Classes by solid, those of nothing and of the ground last, where -2 and -1 point to."""
        return np.array([*(s.label for s in self.solids), SemanticClass.SKY, SemanticClass.GROUND], np.uint8)

    def _scan(self, k: int) -> Scan:
        config, rng = self.config, np.random.default_rng([self.config.seed, k, 1])
        time_s, step = k * self.period_s, np.radians(AZIMUTH_STEP_DEG)
        around = np.arange(np.radians(70.0), np.radians(-70.0), -step) + rng.uniform(-0.5, 0.5) * step
        up = np.radians(LASERS_DEG[config.lasers])
        # Rays of a beam: what is added to elevation and azimuth.
        beam = 0.5e-3 * config.divergence_mrad * _disc(config.rays)
        ups = up[:, None, None] + beam[:, 0]
        rays = _directions(ups, around[None, :, None] + beam[:, 1] / np.cos(up)[:, None, None])
        wTl = self.wTl(time_s)
        windows = [
            _window(_elevations(lPs), np.arctan2(lPs[:, 1], lPs[:, 0]), up, around)
            for lPs in self._corners(wTl.inverse(), time_s)
        ]
        hits = self._cast(wTl, rays, windows, time_s)
        ranges, power, labels = self._pulses(hits, rays @ wTl.rotation().matrix().T)
        seen = (ranges > _NEAREST_M) & (ranges < _RANGE_M)
        if config.losses:
            seen &= rng.random(seen.shape) > 1.0 / (1.0 + (power / _FAINT) ** 2)
        noisy = ranges + config.range_noise_m * rng.normal(size=ranges.shape)
        middle = _directions(up[:, None], around)
        points = (middle * np.where(seen, noisy, 0.0)[..., None])[seen].astype(np.float32)
        classes = labels[seen]
        wrong = rng.random(len(classes)) < 0.01 * config.label_noise
        classes[wrong] = rng.integers(1, 6, wrong.sum())
        rings = np.broadcast_to(np.arange(len(up), dtype=np.uint16)[:, None], seen.shape)[seen]
        return Scan(round(time_s * 1e9), points, classes, rings=rings)

    def _pulses(self, hits: Hits, rays: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
        """Range [m], power and class of the pulse that each beam reports."""
        size = len(self.solids) + 2, max(len(solid.planes) for solid in self.solids)
        normals, reflectances = np.zeros((*size, 3)), np.zeros(size)
        for number, solid in enumerate(self.solids):
            normals[number, : len(solid.planes)] = solid.planes[:, :3]
            reflectances[number, : len(solid.planes)] = np.where(
                solid.glass, _GLASS_REFLECTANCE, solid.reflectance
            )
        normals[-1, :, 2], reflectances[-1] = 1.0, 0.2
        slant = np.abs((normals[hits.solids, hits.faces] * rays).sum(axis=-1))
        power = reflectances[hits.solids, hits.faces] * slant / np.minimum(hits.ranges, 1e3) ** 2
        power[hits.solids == -2] = 0.0
        # Rays by range: a gap that the receiver can part begins a new pulse.
        order = np.argsort(hits.ranges, axis=-1)
        ranges, power, solids = (np.take_along_axis(a, order, -1) for a in (hits.ranges, power, hits.solids))
        with np.errstate(invalid="ignore"):
            pulse = np.cumsum(np.diff(ranges, axis=-1, prepend=ranges[..., :1]) > _PULSE_M, axis=-1)
        member = pulse[..., None] == np.arange(rays.shape[2])  # (..., ray, pulse)
        powers = (member * power[..., None]).sum(axis=-2)
        audible = powers > 0.25 * _FAINT
        first = np.where(audible.any(axis=-1), audible.argmax(axis=-1), 0)
        chosen = first if self.config.echo == "first" else powers.argmax(axis=-1)
        own = np.where(pulse == chosen[..., None], power, 0.0)
        total = own.sum(axis=-1)
        with np.errstate(invalid="ignore"):
            mean = np.where(own > 0.0, own * ranges, 0.0).sum(axis=-1) / np.maximum(total, 1e-12)
        strongest = np.take_along_axis(solids, own.argmax(axis=-1)[..., None], -1)[..., 0]
        return mean, total / rays.shape[2], self._labels[strongest]

    def _image(self, k: int) -> CameraImage:
        config, rng = self.config, np.random.default_rng([self.config.seed, k, 2])
        stamp_s = k * self.period_s
        time_s = stamp_s + config.time_offset_s
        wTc = self.wTl(time_s) * self.truth.cTl.inverse()
        v, u = np.arange(float(config.height)), np.arange(float(config.width))
        x = np.asarray((u - self.camera.cx) / self.camera.fx, np.float64)
        y = np.asarray((v - self.camera.cy) / self.camera.fy, np.float64)
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), -1)[:, :, None]
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        windows = []
        for cPs in self._corners(wTc.inverse(), time_s):
            near = cPs[:, 2] < 0.2
            uv = cPs[:, :2] / np.maximum(cPs[:, 2:], 0.2)
            whole = None if near.all() else _window(uv[:, 1], uv[:, 0], y, x)
            windows.append((slice(None), slice(None)) if near.any() and not near.all() else whole)
        hits = self._cast(wTc, rays, windows, time_s)
        solids = hits.solids[:, :, 0]
        mask = self._labels[solids]
        if config.label_noise > 0.0:
            mask = self._mislabelled(mask, solids, rng)
        world = rays @ wTc.rotation().matrix().T * np.minimum(hits.ranges, 1e3)[..., None] + wTc.translation()
        return CameraImage(round(stamp_s * 1e9), mask, self._picture(hits, world[:, :, 0], time_s, rng))

    def _corners(self, aTw: gtsam.Pose3, time_s: float) -> list[FloatArray]:
        """Corners of the solids in a sensor's frame [m]."""
        R, t = aTw.rotation().matrix(), aTw.translation()
        return [(solid.corners + solid.at(time_s)) @ R.T + t for solid in self.solids]

    def _cast(
        self, wTs: gtsam.Pose3, rays: FloatArray, windows: list[tuple[slice, slice] | None], time_s: float
    ) -> Hits:
        """Hits of rays in a sensor's frame."""
        moved = [solid.planes.copy() for solid in self.solids]
        for planes, solid in zip(moved, self.solids, strict=True):
            planes[:, 3] -= planes[:, :3] @ solid.at(time_s)
        return cast(moved, wTs.translation(), rays @ wTs.rotation().matrix().T, windows)

    def _picture(
        self, hits: Hits, world: FloatArray, time_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Flat shading, with a pattern of patches that stays on its surface, and the camera's noise."""
        shades = np.full((len(self.solids) + 2, 64), 0.45)
        shifts = np.zeros((len(self.solids) + 2, 3))
        for number, solid in enumerate(self.solids):
            light = 0.4 + 0.5 * np.clip(solid.planes[:, :3] @ _SUN, 0.0, 1.0)
            tone = 0.15 + 0.85 * solid.reflectance
            shades[number, : len(light)] = np.where(solid.glass, 0.12, tone * light)
            shifts[number] = solid.at(time_s)
        shades[-2] = 0.95
        solids = hits.solids[:, :, 0]
        own = world - shifts[solids]
        cells = np.floor(np.nan_to_num(own, posinf=0.0, neginf=0.0) / 0.35 + 0.013).astype(np.int64)
        scrambled = (cells @ np.array([73856093, 19349663, 83492791])) & 0xFFFF
        pattern = ((scrambled * 40503) & 0xFFFF) / 65535.0
        # Patches smaller than a pixel would flicker.
        depth = hits.ranges[:, :, 0]
        fade = np.clip(1.5 - depth / 25.0, 0.0, 1.0) * (solids != -2)
        grey = shades[solids, hits.faces[:, :, 0]] * (1.0 + 0.35 * fade * (pattern - 0.5))
        tint = np.array([0.9, 1.0, 0.97])[solids % 3]
        pixels = 255.0 * np.stack([grey * tint, grey, grey], axis=-1)
        pixels = cv2.GaussianBlur(pixels, (3, 3), 0.6) + rng.normal(0.0, 1.5, grey.shape)[..., None]
        return np.asarray(np.clip(pixels, 0.0, 255.0), np.uint8)

    def _mislabelled(
        self, mask: NDArray[np.uint8], solids: IntArray, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """A mask as a network gives it: vehicles grown or shrunk, ragged, a few of them missed."""
        noise, result = self.config.label_noise, mask.copy()
        numbers = np.array([*(s.number for s in self.solids), 0, 0])[solids]
        ragged = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), 3.0)
        ragged *= 0.6 / ragged.std()
        vehicles = mask == int(SemanticClass.VEHICLE)
        for number in np.unique(numbers[vehicles]):
            body = vehicles & (numbers == number)
            x, y, width, height = cv2.boundingRect(body.view(np.uint8))
            if rng.random() < 0.04 * noise:
                result[body] = SemanticClass.OTHER
                continue
            near = np.s_[max(y - 8, 0) : y + height + 8, max(x - 8, 0) : x + width + 8]
            inside = np.ascontiguousarray(body[near]).view(np.uint8)
            out, within = (cv2.distanceTransform(a, cv2.DIST_L2, 5) for a in (1 - inside, inside))
            signed = np.where(inside > 0, 0.5 - within, out - 0.5)
            grown = signed < noise * (self._growths[number] + 0.4 * rng.normal() + ragged[near])
            result[near][(inside > 0) & ~grown] = SemanticClass.OTHER
            result[near][grown] = SemanticClass.VEHICLE
        return result


def _directions(up: FloatArray, around: FloatArray) -> FloatArray:
    """(..., 3) unit vectors at elevations and azimuths [rad]."""
    parts = np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _disc(rays: int) -> FloatArray:
    """(n, 2) points that stand for a disc of radius 1: same mean, same second moments."""
    turns = np.arange(6) * np.pi / 3.0
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    if rays == 1:
        return np.zeros((1, 2))
    if rays == 7:
        return np.concatenate([np.zeros((1, 2)), np.sqrt(7.0 / 12.0) * ring])
    half = np.stack([np.cos(turns + np.pi / 6.0), np.sin(turns + np.pi / 6.0)], axis=1)
    return np.concatenate([np.zeros((1, 2)), 0.45 * ring, np.sqrt(13.0 / 12.0 - 0.45**2) * half])


def _window(
    rows: FloatArray, columns: FloatArray, row_values: FloatArray, column_values: FloatArray
) -> tuple[slice, slice] | None:
    """Rows and columns of a grid whose values lie between those of corners, or next to them."""
    found = []
    for own, values in ((rows, row_values), (columns, column_values)):
        if own.max() - own.min() > np.pi:  # behind the sensor, across the cut
            return None
        inside = np.flatnonzero((values > own.min() - 0.01) & (values < own.max() + 0.01))
        if len(inside) == 0:
            return None
        found.append(slice(int(inside[0]), int(inside[-1]) + 1))
    return found[0], found[1]


def _elevations(corners: FloatArray) -> FloatArray:
    """(2,) elevations [rad] between which a solid lies: its edges bulge beyond its corners' elevations."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    nearest = np.hypot(*np.maximum(np.maximum(low[:2], -high[:2]), 0.0))
    farthest = np.hypot(corners[:, 0], corners[:, 1]).max()
    return np.arctan2(
        [low[2], high[2]], [farthest if low[2] > 0.0 else nearest, nearest if high[2] > 0.0 else farthest]
    )


def _path(config: ThirdConfig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and x, y, z [m], yaw, pitch, roll [rad] (n, 6) of the LiDAR; it meanders and sways."""
    length = config.frames * ThirdStreet.period_s
    t = np.arange(-1.0, length + 1.0, 0.01)
    speed = {
        "standing": np.zeros_like(t),
        "stop": 8.0 * np.clip(np.abs(t / length - rng.uniform(0.4, 0.6)) / 0.3 - 0.3, 0.0, 1.0),
        "vary": 8.0 + 3.5 * np.sin(2.0 * np.pi * t / (0.7 * length) + rng.uniform(0.0, 6.0)),
        "constant": np.full_like(t, 8.0),
    }[config.motion]
    way = np.cumsum(speed) * 0.01
    way -= np.interp(0.0, t, way)
    yaw = 0.03 * np.sin(way / 5.0)
    x, y = (np.cumsum(speed * f(yaw)) * 0.01 for f in (np.cos, np.sin))
    rolling = np.minimum(speed / 2.0, 1.0)
    z = 1.8 + 0.01 * rolling * np.sin(8.0 * t)
    pitch, roll = 0.004 * rolling * np.sin(5.5 * t), 0.004 * rolling * np.sin(6.5 * t + 1.0)
    return t, np.stack([x - np.interp(0.0, t, x), y - np.interp(0.0, t, y), z, yaw, pitch, roll], axis=1)


def _slab(length: float, width: float, z: float, cut: float = 0.0, x: float = 0.0) -> FloatArray:
    """(8, 3) corners of a rectangle with its corners cut off, at height z [m], its middle at x."""
    a, b = length / 2.0, width / 2.0
    cut = max(cut, 1e-3)
    quarter = np.array([[a - cut, b], [a, b - cut]])
    corners = np.concatenate([quarter * [i, j] for i in (-1, 1) for j in (-1, 1)])
    return np.column_stack([corners[:, 0] + x, corners[:, 1], np.full(8, z)])


def _car(rng: np.random.Generator) -> list[tuple[FloatArray, bool]]:
    """Parts of a car or van, its middle at the origin, and whether they are glazed."""
    van = rng.random() < 0.15
    length, width = rng.uniform(3.8, 4.9) + 0.4 * van, rng.uniform(1.65, 1.9)
    height = rng.uniform(1.85, 2.1) if van else rng.uniform(1.4, 1.7)
    belt, sill = rng.uniform(0.85, 0.98) + 0.1 * van, rng.uniform(0.2, 0.3)
    bumper, bonnet, bevel = rng.uniform(0.55, 0.7), rng.uniform(0.7, 1.1), rng.uniform(0.04, 0.1)
    tail = rng.choice([0.05, 0.6])
    body = np.concatenate(
        [
            _slab(length - 0.1, width - 0.1, sill, 0.3),
            _slab(length, width, 0.5 * (sill + bumper), 0.25),
            _slab(length - bonnet, width - 0.06, belt, 0.1, -bonnet / 2.0),
            _slab(0.1, width - 0.3, bumper + 0.08, 0.02, length / 2.0 - 0.1),
        ]
    )
    back, front = -length / 2.0 + tail, length / 2.0 - bonnet
    rake, lean = rng.uniform(0.5, 0.9) * (0.5 if van else 1.0), rng.uniform(0.1, 0.5)
    foot = _slab(front - back, width - 0.1, belt - 0.02, 0.08, 0.5 * (front + back))
    low, high = back + lean, front - rake
    eaves = _slab(high - low, width - 0.34, height - bevel, 0.1, 0.5 * (high + low))
    crown = _slab(0.75 * (high - low), width - 0.7, height, 0.15, 0.5 * (high + low))
    parts = [(body, False), (np.concatenate([foot, eaves]), True), (np.concatenate([eaves, crown]), False)]
    return parts + [(_axle(x, width, 0.31), False) for x in (-0.3 * length, 0.32 * length)]


def _axle(x: float, width: float, radius: float) -> FloatArray:
    turns = np.arange(10) * 2.0 * np.pi / 10.0
    rim = np.stack([x + radius * np.cos(turns), np.zeros(10), radius + radius * np.sin(turns)], axis=1)
    return np.concatenate([rim + np.array([0.0, side * 0.47 * width, 0.0]) for side in (-1, 1)])


def _truck(rng: np.random.Generator) -> list[tuple[FloatArray, bool]]:
    length, height = rng.uniform(4.0, 6.5), rng.uniform(2.9, 3.5)
    load = np.concatenate([_slab(length, 2.4, 0.8), _slab(length, 2.4, height)])
    front = 0.5 * length
    cab = np.concatenate([_slab(1.9, 2.2, 0.5, 0.1, front + 1.2), _slab(1.5, 2.0, 2.4, 0.2, front + 1.1)])
    axles = [_axle(x * length, 2.2, 0.48) for x in (-0.3, 0.4)]
    return [(part, False) for part in (load, cab, *axles)]


def _street(config: ThirdConfig, farthest_m: float, rng: np.random.Generator) -> list[Solid]:
    """All solids along x, as far as the drive sees."""
    solids: list[Solid] = []
    number = 0

    def place(
        parts: Sequence[tuple[FloatArray, bool]],
        label: SemanticClass,
        at: tuple[float, float, float],
        reflectance: float,
        speed: float = 0.0,
    ) -> None:
        nonlocal number
        number += 1
        x, y, yaw = at
        turned = gtsam.Rot3.Rz(yaw).matrix()
        for corners, glazed in parts:
            solid = Solid(corners @ turned.T + [x, y, 0.0], label, number, reflectance)
            solid.speed = speed
            solids.append(solid.glazed() if glazed else solid)

    for side in (-1, 1):
        x = -20.0 + rng.uniform(0.0, 6.0)
        while x < farthest_m + _AHEAD_M:
            truck, moves = rng.random() < 0.08, rng.random() < config.moving_fraction
            yaw = 0.05 * rng.normal() + np.pi * (rng.random() < 0.5)
            y, speed = side * rng.uniform(3.4, 5.0), 0.0
            if moves:
                y, speed = side * 3.1, -side * rng.uniform(3.0, 9.0)
            elif rng.random() < 0.15:
                y, yaw = side * 7.2, yaw + np.pi / 2.0
            parts = _truck(rng) if truck else _car(rng)
            place(parts, SemanticClass.VEHICLE, (x + 2.4, y, yaw), rng.choice([0.06, 0.15, 0.35, 0.6]), speed)
            x += (10.0 if truck else 5.6) + rng.exponential(2.0 / config.density)
        x = -20.0
        while x < farthest_m + _AHEAD_M:
            length, depth = rng.uniform(7.0, 18.0), rng.uniform(5.0, 9.0)
            walls = np.concatenate([_slab(length, depth, 0.0), _slab(length, depth, rng.uniform(4.0, 11.0))])
            if rng.random() < 0.8:
                y = side * (rng.uniform(10.0, 14.0) + depth / 2.0)
                at = x + length / 2.0, y, 0.0
                place([(walls, False)], SemanticClass.BUILDING, at, rng.uniform(0.2, 0.6))
            x += length + rng.uniform(0.0, 5.0)
        x = -20.0
        while x < farthest_m + _AHEAD_M:
            y, stem = side * rng.uniform(8.6, 9.6), rng.uniform(0.05, 0.2)
            if rng.random() < 0.5:
                height = rng.uniform(1.8, 2.6)
                crown = rng.normal(size=(18, 3))
                crown *= rng.uniform(0.9, 1.6) / np.linalg.norm(crown, axis=1, keepdims=True)
                trunk = np.concatenate([_slab(2 * stem, 2 * stem, z, 0.5 * stem) for z in (0.0, height)])
                tree = [(trunk, False), (crown + np.array([0.0, 0.0, height + 1.0]), False)]
                place(tree, SemanticClass.VEGETATION, (x, y, 0.0), 0.3)
            else:
                pole = np.concatenate([_slab(1.5 * stem, 1.5 * stem, z, 0.4 * stem) for z in (0.0, 6.0)])
                place([(pole, False)], SemanticClass.POLE, (x, y, 0.0), 0.4)
            x += rng.uniform(5.0, 12.0)
    return solids
