"""The simulated street: where everything stands and how it moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator import scenery
from sst_graph.simulator.config import SimulationConfig
from sst_graph.simulator.mesh import Mesh, extended, merged, yaw_rotation
from sst_graph.simulator.motion import (
    STEP_S,
    EgoMotion,
    Path,
    ego_motion,
    random_path,
    speed_profile,
    time_table,
)
from sst_graph.simulator.surfaces import FaceKind, Material
from sst_graph.simulator.vehicles import random_car, random_truck
from sst_graph.types import FloatArray

BEHIND_M, AHEAD_M = 105.0, 145.0
"""The street is built this far before the drive's start and beyond its end [m]."""
LIDAR_HEIGHT_M = 1.73


@dataclass(frozen=True)
class MovingVehicle:
    """A vehicle or a person that moves along the street.

    Attributes:
        mesh: in its own frame.
        instance: its number.
        t, s: (n,) time [s] and arc length [m] of its way.
        left: its distance to the left of the centre line [m].
        turned: True where it faces against the centre line.
    """

    mesh: Mesh
    instance: int
    t: FloatArray
    s: FloatArray
    left: float
    turned: bool

    def arc_length(self, t: float) -> float:
        """Arc length at time t [m]."""
        return float(np.interp(t, self.t, self.s))

    def pose_at(self, path: Path, t: float) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and position (3,) [m] in the world at time t [s]."""
        rotation, position = path.frame(self.arc_length(t), self.left)
        if self.turned:
            rotation = rotation @ yaw_rotation(np.pi)
        return rotation, position

    def mesh_at(self, path: Path, t: float) -> Mesh:
        """The mesh in the world at time t [s]."""
        return self.mesh.placed(*self.pose_at(path, t))

    def triangles_at(self, path: Path, t: float) -> FloatArray:
        """(n, 3, 3) corners in the world at time t [s, m]."""
        return self.mesh.placed_triangles(*self.pose_at(path, t))


@dataclass(frozen=True)
class StreetSnapshot:
    """All faces near the vehicle at one time.

    Attributes:
        mesh: faces in the world.
        instances: (n,) uint16 number of the vehicle or person each face belongs to, 0: none.
        velocities: (n, 3, 3) velocity of the corners [m/s].
    """

    mesh: Mesh
    instances: NDArray[np.uint16]
    velocities: FloatArray


@dataclass(frozen=True)
class Street:
    """The world.

    Attributes:
        path: the centre line.
        ego: the LiDAR's motion.
        static: all faces that never move.
        owners: (n,) object of each static face; centres (o, 2) and radii (o,) of the objects [m].
        instances: (n,) uint16 instance of each static face.
        moving: vehicles that move.
        sun: (3,) unit vector to the sun.
        sunlight: share of the light that comes from the sun.
    """

    path: Path
    ego: EgoMotion
    static: Mesh
    owners: NDArray[np.intp]
    centres: FloatArray
    radii: FloatArray
    instances: NDArray[np.uint16]
    moving: tuple[MovingVehicle, ...]
    sun: FloatArray
    sunlight: float

    def snapshot(self, t: float, range_m: float) -> StreetSnapshot:
        """The faces within about ``range_m`` of the vehicle at time t [s]."""
        here = self.ego.pose(np.array([t]))[1][0, :2]
        near = np.linalg.norm(self.centres - here, axis=1) - self.radii < range_m
        pick = np.flatnonzero(near[self.owners])
        meshes: list[Mesh] = []
        instances, velocities = [self.instances[pick]], [np.zeros((len(pick), 3, 3))]
        ego_s, half = float(np.interp(t, self.ego.t, self.ego.s)), 0.02
        for vehicle in self.moving:
            if abs(vehicle.arc_length(t) - ego_s) > range_m:
                continue
            mesh = vehicle.mesh_at(self.path, t)
            later, earlier = (vehicle.triangles_at(self.path, t + side) for side in (half, -half))
            meshes.append(mesh)
            instances.append(np.full(len(mesh), vehicle.instance, np.uint16))
            velocities.append((later - earlier) / (2 * half))
        return StreetSnapshot(
            extended(self.static, pick, meshes), np.concatenate(instances), np.concatenate(velocities)
        )


class _Builder:
    """Collects the objects of a street."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.meshes: list[Mesh] = []
        self.instances: list[int] = []
        self.next_instance = 1

    def add(self, mesh: Mesh, instance: int = 0) -> None:
        """An object already in the world."""
        self.meshes.append(mesh)
        self.instances.append(instance)

    def put(
        self, mesh: Mesh, s: float, left: float, yaw: float = 0.0, up: float = 0.0, instance: int = 0
    ) -> None:
        """An object on the street at (s, left) [m], turned by ``yaw`` against the street."""
        rotation, position = self.path.frame(s, left)
        self.add(mesh.placed(rotation @ yaw_rotation(yaw), position + np.array([0.0, 0.0, up])), instance)

    def new_instance(self) -> int:
        """The next instance number; they repeat after 65535."""
        number = self.next_instance
        self.next_instance = number % 65535 + 1
        return number


def build_street(config: SimulationConfig) -> Street:
    """The street of a configuration; equal configurations give equal streets."""
    root = np.random.default_rng([config.seed, 1])
    t = time_table(config)
    s = np.cumsum(speed_profile(config, t)) * STEP_S
    s -= np.interp(0.0, t, s)
    start, end = float(s.min()) - BEHIND_M, float(s.max()) + AHEAD_M
    path = random_path(config, np.random.default_rng([config.seed, 2]), start, end)
    profile, angled = _profile(root)
    sun_azimuth, sun_height = root.uniform(-np.pi, np.pi), root.uniform(0.5, 1.1)
    sun = np.array(
        [
            np.cos(sun_height) * np.cos(sun_azimuth),
            np.cos(sun_height) * np.sin(sun_azimuth),
            np.sin(sun_height),
        ]
    )
    builder = _Builder(path)
    _lay_ground(builder, profile, root, start, end)
    _raise_buildings(builder, profile, np.random.default_rng([config.seed, 3]), start, end)
    _plant(builder, profile, np.random.default_rng([config.seed, 4]), start, end)
    _park(builder, profile, angled, config, (start, end), sun)
    moving = _set_moving(
        builder, profile, config, np.random.default_rng([config.seed, 6]), (t, s, start, end), sun
    )
    ego_rng = np.random.default_rng([config.seed, 7])
    ego = ego_motion(config, path, s, -profile.lane / 2, LIDAR_HEIGHT_M, ego_rng)
    return _assembled(builder, path, ego, moving, sun, float(root.uniform(0.35, 0.65)))


def _assembled(
    builder: _Builder,
    path: Path,
    ego: EgoMotion,
    moving: list[MovingVehicle],
    sun: FloatArray,
    sunlight: float,
) -> Street:
    """The street from its objects."""
    sizes = np.array([len(mesh) for mesh in builder.meshes])
    corners = [mesh.triangles[:, :, :2].reshape(-1, 2) for mesh in builder.meshes]
    centres = np.stack([(c.min(axis=0) + c.max(axis=0)) / 2 for c in corners])
    radii = np.array([np.linalg.norm(c - m, axis=1).max() for c, m in zip(corners, centres, strict=True)])
    owners = np.repeat(np.arange(len(sizes)), sizes)
    instances = np.array(builder.instances, dtype=np.uint16)[owners]
    return Street(
        path, ego, merged(builder.meshes), owners, centres, radii, instances, tuple(moving), sun, sunlight
    )


def _profile(rng: np.random.Generator) -> tuple[scenery.StreetProfile, tuple[bool, bool]]:
    """A random cross-section, and on which sides (right, left) the cars park at an angle."""
    lane = rng.uniform(2.9, 3.6)
    angled = (bool(rng.uniform() < 0.15), bool(rng.uniform() < 0.3))
    kerbs = [lane + (5.0 if a else 2.15) for a in angled]
    walk = rng.uniform(1.6, 3.0)
    fronts = [kerb + walk + rng.choice([0.3, 1.5, 4.0, 7.0]) for kerb in kerbs]
    return scenery.StreetProfile(lane, (kerbs[0], kerbs[1]), walk, (fronts[0], fronts[1])), angled


def _lay_ground(
    builder: _Builder, profile: scenery.StreetProfile, rng: np.random.Generator, start: float, end: float
) -> None:
    """Road, side-walks and verges, in pieces."""
    verge = Material.GRASS if rng.uniform() < 0.7 else Material.PAVING
    step = 6 * scenery.STATION_M
    for at in np.arange(start, end - step, step):
        stations = np.linspace(at, at + step, 7)
        builder.add(scenery.ground(builder.path, profile, stations, verge))
        builder.add(scenery.markings(builder.path, profile, stations, rng))
    builder.add(scenery.plain(builder.path))


def _raise_buildings(
    builder: _Builder, profile: scenery.StreetProfile, rng: np.random.Generator, start: float, end: float
) -> None:
    """Houses, fences and hedges along the building line of both sides."""
    dense, tall = rng.uniform(0.3, 1.0), rng.uniform(5.0, 13.0)
    for side, front in ((-1.0, profile.fronts[0]), (1.0, profile.fronts[1])):
        s = start
        while s < end - 25.0:
            length = float(rng.uniform(9.0, 20.0))
            at, facing = s + length / 2, 0.0 if side < 0 else np.pi
            if rng.uniform() < 0.35 + 0.6 * dense:
                height = 3.0 * max(1.0, round(tall * rng.uniform(0.6, 1.3) / 3.0)) + 0.5
                house = scenery.building(rng, length, float(rng.uniform(8.0, 12.0)), height)
                builder.put(house, at, side * (front + rng.uniform(0.0, 0.8)), facing)
            else:
                border = scenery.hedge(rng, length) if rng.uniform() < 0.6 else scenery.fence(rng, length)
                builder.put(border, at, side * front, up=scenery.KERB_M)
                for _ in range(int(rng.integers(1, 4))):
                    offset = side * (front + rng.uniform(3.0, 10.0))
                    builder.put(scenery.tree(rng), at + rng.uniform(-0.4, 0.4) * length, offset)
                far = scenery.building(rng, length * 1.2, 10.0, 3.0 * float(rng.integers(1, 4)) + 0.5)
                builder.put(far, at, side * (front + rng.uniform(9.0, 14.0)), facing)
            s += length + float(rng.choice([0.0, 1.5, 5.0], p=[dense * 0.6, 0.4, 0.6 - dense * 0.6]))


def _plant(
    builder: _Builder, profile: scenery.StreetProfile, rng: np.random.Generator, start: float, end: float
) -> None:
    """Trees, lamps, signs and people on the side-walks."""
    gap, lamps = rng.uniform(7.0, 35.0), rng.uniform(22.0, 34.0)
    for side, kerb in ((-1.0, profile.kerbs[0]), (1.0, profile.kerbs[1])):
        up = scenery.KERB_M
        for s in np.arange(start + rng.uniform(0, gap), end, gap):
            builder.put(
                scenery.tree(rng), s + rng.uniform(-1.0, 1.0), side * (kerb + 0.6), rng.uniform(-3, 3), up
            )
        for s in np.arange(start + rng.uniform(0, lamps), end, lamps):
            builder.put(scenery.street_lamp(rng), s, side * (kerb + 0.35), 0.0 if side < 0 else np.pi, up)
        for s in np.arange(start + rng.uniform(0, 40.0), end, 23.0):
            at = s + rng.uniform(0.0, 15.0)
            builder.put(scenery.traffic_sign(rng), at, side * (kerb + 0.3), 0.0 if side < 0 else np.pi, up)
        for s in np.arange(start, end, 20.0):
            if rng.uniform() < 0.35:
                at, left = s + rng.uniform(0.0, 20.0), side * (kerb + rng.uniform(0.9, profile.walk))
                builder.put(scenery.person(rng), at, left, rng.uniform(-3, 3), up, builder.new_instance())
        for s in np.arange(start, end, 15.0):
            if rng.uniform() < 0.25:
                length = float(rng.uniform(2.0, 5.0))
                builder.put(
                    scenery.hedge(rng, length),
                    s,
                    side * (profile.kerbs[0 if side < 0 else 1] + profile.walk),
                    0.0,
                    up,
                )


def _with_shadow(mesh: Mesh, yaw: float, sun: FloatArray) -> Mesh:
    """The vehicle with its shadow on the ground; ``yaw``: its direction in the world [rad]."""
    away = yaw_rotation(-yaw) @ -sun
    cast = away[:2] / sun[2] * 1.1
    low, high = mesh.triangles.min(axis=(0, 1)), mesh.triangles.max(axis=(0, 1))
    return merged([mesh, scenery.shadow(high[0] - low[0], high[1] - low[1] - 0.2, cast)])


def _park(
    builder: _Builder,
    profile: scenery.StreetProfile,
    angled: tuple[bool, bool],
    config: SimulationConfig,
    ends: tuple[float, float],
    sun: FloatArray,
) -> None:
    """Parked vehicles in the parking lanes of both sides."""
    rng = np.random.default_rng([config.seed, 5])
    density = config.vehicle_density * (1.0 - config.moving_fraction) / 2.0
    for side, kerb, slanted in ((-1.0, profile.kerbs[0], angled[0]), (1.0, profile.kerbs[1], angled[1])):
        s, slant = ends[0] + rng.uniform(3.0, 9.0), rng.uniform(0.9, 1.5)
        while s < ends[1] - 8.0:
            truck = not slanted and rng.uniform() < config.truck_fraction
            vehicle = random_truck(rng) if truck else random_car(rng)
            length = float(np.ptp(vehicle.triangles[:, :, 0]))
            pitch = 3.1 if slanted else length + rng.uniform(0.7, 1.6)
            if rng.uniform() < density * pitch:
                yaw = 0.0 if side < 0 else np.pi
                if slanted:
                    yaw += slant if side > 0 else -slant
                if rng.uniform() < 0.15:
                    yaw += np.pi
                yaw += np.deg2rad(rng.normal(0.0, 1.5))
                left = side * (kerb - (2.45 if slanted else 1.05) + rng.normal(0.0, 0.08))
                at = s + pitch / 2
                street = float(builder.path.yaw_at(np.array([at]))[0])
                builder.put(
                    _with_shadow(vehicle, street + yaw, sun), at, left, yaw, 0.0, builder.new_instance()
                )
            s += pitch


def _set_moving(
    builder: _Builder,
    profile: scenery.StreetProfile,
    config: SimulationConfig,
    rng: np.random.Generator,
    way: tuple[FloatArray, FloatArray, float, float],
    sun: FloatArray,
) -> list[MovingVehicle]:
    """Vehicles before and behind the ego vehicle in its lane, and oncoming ones in the other."""
    t, ego_s, start, end = way
    density, moving = config.vehicle_density * config.moving_fraction / 2.0, []
    if density > 0.0:
        speed = float(rng.uniform(6.0, 11.0))
        at = float(ego_s[0]) - 80.0 + rng.exponential(1.0 / density)
        while at < end + speed * (t[-1] - t[0]):
            s = at - speed * (t - t[0]) + 0.6 * np.sin(0.5 * t + rng.uniform(0, 6))
            moving.append((s, profile.lane / 2 + rng.normal(0.0, 0.1), True))
            at += 10.0 + rng.exponential(max(1.0 / density - 10.0, 1.0))
        for direction in (1.0, -1.0):
            gap = 9.0 + rng.exponential(min(0.5 / density, 20.0))
            while gap < 80.0:
                delayed = np.interp(t + direction * 0.05 * gap, t, ego_s)
                moving.append((delayed + direction * gap, -profile.lane / 2 + rng.normal(0.0, 0.15), False))
                gap += 10.0 + rng.exponential(max(1.0 / density - 10.0, 1.0))
    result = []
    for s, left, turned in moving:
        s = np.clip(s, start + 5.0, end - 5.0)
        vehicle = random_truck(rng) if rng.uniform() < 0.5 * config.truck_fraction else random_car(rng)
        yaw = float(builder.path.yaw_at(np.array([np.median(s)]))[0]) + (np.pi if turned else 0.0)
        mesh = _with_shadow(vehicle, yaw, sun)
        result.append(MovingVehicle(mesh, builder.new_instance(), t, s, float(left), turned))
    return result


def is_instance(kinds: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(n,) whether faces of these kinds carry their object's instance (a shadow does not)."""
    return np.isin(kinds, (FaceKind.CAR, FaceKind.TRUCK, FaceKind.PERSON))
