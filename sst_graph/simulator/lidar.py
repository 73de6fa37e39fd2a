"""The LiDAR: rings, sweep, range noise, lost and mixed returns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator.casting import IndexArray, compact
from sst_graph.simulator.config import SimulationConfig
from sst_graph.simulator.mesh import normals_of, seen_from
from sst_graph.simulator.motion import EgoMotion
from sst_graph.simulator.street import StreetSnapshot
from sst_graph.simulator.surfaces import EXTRA_LOSS, FaceKind, Material
from sst_graph.simulator.sweep import Columns, SweepMotion, cast_lidar
from sst_graph.types import FloatArray

RINGS = 64
TOP_DEG, MIDDLE_DEG, BOTTOM_DEG = 2.0, -8.53, -24.8
"""The upper half of the lasers fans over TOP..MIDDLE, the lower over MIDDLE..BOTTOM, as in the HDL-64E."""
MIN_RANGE_M = 2.0


@dataclass(frozen=True)
class Returns:
    """The returns of one sweep, ring by ring from the top, each ring counter-clockwise from forward.

    Attributes:
        points: (n, 3) float32 in the LiDAR frame [m].
        faces: (n,) face hit.
        rings, columns: (n,) ring from the top, column in the order of the file.
        offsets_s: (n,) float32 time after the stamp [s].
    """

    points: NDArray[np.float32]
    faces: IndexArray
    rings: IndexArray
    columns: IndexArray
    offsets_s: NDArray[np.float32]


@dataclass(frozen=True)
class Lidar:
    """The sensor of one drive.

    Attributes:
        config: of the simulation.
        slopes: (RINGS,) tangent of each ring's elevation, ascending.
    """

    config: SimulationConfig
    slopes: FloatArray

    def scan(
        self, snapshot: StreetSnapshot, ego: EgoMotion, stamp_s: float, rng: np.random.Generator
    ) -> Returns:
        """One sweep at the stamp [s] through the faces of the snapshot (taken at that stamp)."""
        config = self.config
        rotation, position = (a[0] for a in ego.pose(np.array([stamp_s])))
        triangles = seen_from(snapshot.mesh.triangles, rotation, position)
        velocities = snapshot.velocities @ rotation
        count = round(360.0 / config.azimuth_step_deg)
        step, start = 2 * np.pi / count, rng.uniform(-0.5, 0.5) * 2 * np.pi / count
        nominal = Columns(start, step, count, self.slopes)
        seconds = firing_times(config, nominal.azimuths) if config.rolling else np.zeros(count)
        cut = np.deg2rad(config.sweep_start_deg)
        motion = _sweep_motion(ego, stamp_s, seconds, velocities, cut) if config.rolling else None
        # Half a radius is the standard deviation of a uniform disc along one axis.
        half = config.beam_divergence_mrad * 1e-3 / 4.0
        beams = cast_lidar(triangles, nominal, (-half, half) if half > 0.0 else (0.0,), motion)
        hits = _mixed(beams, rng)
        returns = self._returns(snapshot, triangles, hits, nominal, seconds, rng)
        if motion is None or config.sweep_output != "compensated":
            return returns
        return _compensated(returns, ego, stamp_s)

    def _returns(
        self,
        snapshot: StreetSnapshot,
        triangles: FloatArray,
        hits: tuple[IndexArray, FloatArray],
        columns: Columns,
        seconds: FloatArray,
        rng: np.random.Generator,
    ) -> Returns:
        """The returns of the rays that come back, with noise, in the order of the file.

        hits: face (rings, columns) that each ray hits, -1 for none, and its range [m].
        """
        config = self.config
        order = np.argsort(np.mod(columns.azimuths, 2 * np.pi))
        # Rings from the top, columns counter-clockwise from forward.
        faces, reach = hits[0][::-1][:, order], hits[1][::-1][:, order]
        slopes = self.slopes[::-1]
        azimuth = columns.azimuths[order]
        shown = (faces >= 0) & (np.abs(azimuth) <= np.deg2rad(config.azimuth_limit_deg))
        ring, column = np.nonzero(shown)
        face = faces[ring, column]
        direction = np.stack([np.cos(azimuth)[column], np.sin(azimuth)[column], slopes[ring]], axis=1)
        stretch = np.linalg.norm(direction, axis=1)
        distance = reach[ring, column] * stretch
        kept = rng.uniform(size=len(face)) >= _loss(
            snapshot, triangles, face, direction / stretch[:, None], distance, config
        )
        kept &= (distance < config.max_range_m) & (distance > MIN_RANGE_M)
        distance = distance + _depth_noise(snapshot, face, config.range_noise_m, rng)
        points = direction * (distance / stretch)[:, None]
        return Returns(
            points[kept].astype(np.float32),
            face[kept],
            ring[kept],
            column[kept],
            seconds[order][column[kept]].astype(np.float32),
        )


def make_lidar(config: SimulationConfig) -> Lidar:
    """A 64-beam LiDAR whose rings are a little uneven, as in a real one."""
    rng = np.random.default_rng([config.seed, 20])
    upper = np.linspace(TOP_DEG, MIDDLE_DEG, RINGS // 2, endpoint=False)
    lower = np.linspace(MIDDLE_DEG, BOTTOM_DEG, RINGS // 2)
    elevation = np.concatenate([upper, lower]) + rng.uniform(-0.05, 0.05, RINGS)
    return Lidar(config, np.tan(np.deg2rad(np.sort(elevation))))


def firing_times(config: SimulationConfig, azimuths: FloatArray) -> FloatArray:
    """(n,) time after the stamp [s] at which the lasers of a spinning scanner look along azimuths (n,) [rad].

    Raising by the share of the turn done since its start; what the stamp names lies at 0.
    """

    def turned(azimuth: FloatArray) -> FloatArray:
        ahead = azimuth - np.deg2rad(config.sweep_start_deg)
        forth = ahead if config.sweep_sense == "counterclockwise" else -ahead
        return np.asarray(np.mod(forth, 2 * np.pi) / (2 * np.pi))

    named = {"start": 0.0, "end": 1.0, "forward": float(turned(np.zeros(1))[0])}[config.sweep_stamp]
    return (turned(azimuths) - named) * config.period_s


def _compensated(returns: Returns, ego: EgoMotion, stamp_s: float) -> Returns:
    """The returns moved to where static surfaces lie at the stamp, by the true motion."""
    rotation, position = (a[0] for a in ego.pose(np.array([stamp_s])))
    rotations, positions = ego.pose(stamp_s + returns.offsets_s.astype(np.float64))
    world = np.einsum("nij,nj->ni", rotations, returns.points.astype(np.float64)) + positions
    points = ((world - position) @ rotation).astype(np.float32)
    return replace(returns, points=points, offsets_s=np.zeros_like(returns.offsets_s))


def _sweep_motion(
    ego: EgoMotion, stamp_s: float, seconds: FloatArray, velocities: FloatArray, cut: float
) -> SweepMotion:
    """The sensor's motion relative to its pose at the stamp, for columns at ``seconds`` (n,) after it."""
    rotation, position = (a[0] for a in ego.pose(np.array([stamp_s])))
    rotations, positions = ego.pose(stamp_s + seconds)
    return SweepMotion(rotation.T @ rotations, (positions - position) @ rotation, seconds, velocities, cut)


def _mixed(
    beams: list[tuple[IndexArray, FloatArray]], rng: np.random.Generator
) -> tuple[IndexArray, FloatArray]:
    """Face and horizontal range [m] of each ray from those of its sub-beams.

    One of the two answers, by lot. Where they differ by less than a metre and a half, which the
    receiver cannot part, some returns lie in between (the "flying" points at edges).
    """
    if len(beams) == 1:
        return beams[0]
    (face_a, reach_a), (face_b, reach_b) = beams
    first = rng.uniform(size=face_a.shape) < 0.5
    faces, reach = np.where(first, face_a, face_b), np.where(first, reach_a, reach_b)
    both = (face_a >= 0) & (face_b >= 0)
    gap = np.where(both, np.abs(np.where(both, reach_a, 0.0) - np.where(both, reach_b, 0.0)), 0.0)
    blend = np.flatnonzero((gap > 0.3) & (gap < 1.5) & (rng.uniform(size=gap.shape) < 0.3))
    share = rng.uniform(0.2, 0.8, len(blend))
    reach.flat[blend] = share * reach_a.flat[blend] + (1.0 - share) * reach_b.flat[blend]
    return faces, reach


def _loss(
    snapshot: StreetSnapshot,
    triangles: FloatArray,
    face: IndexArray,
    direction: FloatArray,
    distance: FloatArray,
    config: SimulationConfig,
) -> FloatArray:
    """(n,) probability that a return is lost: material, dark and slanted paint, range."""
    mesh = snapshot.mesh
    used, index = compact(face)
    normal = normals_of(triangles[used])
    slant = 1.0 - np.abs(np.einsum("ij,ij->i", normal[index], direction))
    bright = mesh.colours[used].mean(axis=1)[index]
    paint = (mesh.materials[used] == Material.PAINT)[index]
    dark = np.where(paint, np.clip(0.3 - bright, 0.0, 0.3) * (0.6 + 2.4 * slant + distance / 25.0), 0.0)
    far = np.clip(distance / config.max_range_m - 0.6, 0.0, 1.0) * 0.5
    scale = 1.0 if config.drop_out > 0.0 else 0.0
    loss = config.drop_out + scale * (EXTRA_LOSS[mesh.materials[used]][index] + dark + far)
    return np.asarray(np.clip(loss, 0.0, 1.0))


def _depth_noise(
    snapshot: StreetSnapshot, face: IndexArray, sigma: float, rng: np.random.Generator
) -> FloatArray:
    """(n,) range errors [m]: Gaussian; returns from inside crowns and from behind car windows come late."""
    noise = sigma * rng.standard_normal(len(face))
    if sigma == 0.0:
        return noise
    mesh = snapshot.mesh
    leafy = mesh.kinds[face] == FaceKind.VEGETATION
    noise += np.where(leafy, rng.exponential(0.12, len(face)), 0.0)
    inside = (mesh.materials[face] == Material.GLASS) & (rng.uniform(size=len(face)) < 0.5)
    return np.asarray(noise + np.where(inside, rng.uniform(0.2, 1.0, len(face)), 0.0))
