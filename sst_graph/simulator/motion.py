"""Motion of the ego vehicle along the street's centre line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_graph.simulator.config import SimulationConfig
from sst_graph.simulator.mesh import yaw_rotation
from sst_graph.types import FloatArray

STEP_S = 0.002
MARGIN_S = 1.5
"""The motion is known this long before the first and after the last scan [s]."""
SMOOTH_S = 0.35
"""Accelerations build up over this time [s]."""


@dataclass(frozen=True)
class Path:
    """A centre line by its arc length, in the ground plane.

    Attributes:
        s: (n,) arc length [m], evenly spaced.
        xy: (n, 2) position [m].
        yaw: (n,) direction, unwrapped [rad].
        height: (n,) height of the road [m].
    """

    s: FloatArray
    xy: FloatArray
    yaw: FloatArray
    height: FloatArray

    def at(self, s: FloatArray, left: FloatArray | float) -> FloatArray:
        """(n, 3) points at arc lengths ``s`` (n,), ``left`` metres to the left, on the ground [m]."""
        yaw = self.yaw_at(s)
        x = np.interp(s, self.s, self.xy[:, 0]) - left * np.sin(yaw)
        y = np.interp(s, self.s, self.xy[:, 1]) + left * np.cos(yaw)
        return np.stack([x, y, np.interp(s, self.s, self.height)], axis=1)

    def frame(self, s: float, left: float) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and position (3,) [m] of something that stands on the street and faces along it."""
        nearby = self.at(np.array([s - 1.5, s, s + 1.5]), 0.0)
        forward = nearby[2] - nearby[0]
        pitch = -np.arctan2(forward[2], np.hypot(forward[0], forward[1]))
        c, sn = np.cos(pitch), np.sin(pitch)
        tilt = np.array([[c, 0.0, sn], [0.0, 1.0, 0.0], [-sn, 0.0, c]])
        yaw = float(self.yaw_at(np.array([s]))[0])
        return yaw_rotation(yaw) @ tilt, self.at(np.array([s]), left)[0]

    def yaw_at(self, s: FloatArray) -> FloatArray:
        """(n,) direction of the centre line [rad]."""
        return np.asarray(np.interp(s, self.s, self.yaw))


@dataclass(frozen=True)
class EgoMotion:
    """Pose of the LiDAR over time, on a dense table.

    Attributes:
        t: (n,) LiDAR time, evenly spaced [s].
        s: (n,) arc length of the ego vehicle along the centre line [m].
        position: (n, 3) of the LiDAR in the world [m].
        angles: (n, 3) yaw, pitch (nose down positive), roll of the LiDAR [rad].
    """

    t: FloatArray
    s: FloatArray
    position: FloatArray
    angles: FloatArray

    def pose(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation (n, 3, 3) and position (n, 3) [m] of the LiDAR in the world at times t (n,) [s]."""
        position = np.stack([np.interp(t, self.t, column) for column in self.position.T], axis=1)
        yaw, pitch, roll = (np.interp(t, self.t, column) for column in self.angles.T)
        cy, sy, cp, sp, cr, sr = (
            np.cos(yaw),
            np.sin(yaw),
            np.cos(pitch),
            np.sin(pitch),
            np.cos(roll),
            np.sin(roll),
        )
        rows = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2), position


def time_table(config: SimulationConfig) -> FloatArray:
    """(n,) times of the dense tables [s]."""
    end = config.frames * config.period_s + MARGIN_S
    return np.arange(-MARGIN_S, end + STEP_S, STEP_S)


def speed_profile(config: SimulationConfig, t: FloatArray) -> FloatArray:
    """(n,) speed at the times t (n,) of :func:`time_table` [m/s]."""
    v, duration = config.speed_mps, config.frames * config.period_s
    if config.motion == "standing":
        return np.zeros_like(t)
    if config.motion == "constant":
        return np.full_like(t, v)
    if config.motion == "turning":
        return _smoothed(v * (0.75 + 0.1 * np.sin(2 * np.pi * t / 7.0)))
    if config.motion == "there_and_back":
        ends = [0.05, 0.2, 0.3, 0.47, 0.53, 0.7, 0.8, 0.95]
        ways = [0, 1, 1, 0, 0, -1, -1, 0]
        return _smoothed(min(v, 0.6 * duration) * np.interp(t / duration, ends, ways))
    if config.motion == "no_stop":
        return _smoothed(v * (0.85 + 0.35 * np.sign(np.sin(2 * np.pi * (t + 0.4) / 5.0)) * _ramp(t, 5.0)))
    cycle = duration if config.motion == "mixed" and duration < 14.0 else 12.0
    phase = np.mod(t, cycle) / cycle
    if config.motion == "mixed":
        knots, speeds = [0, 0.16, 0.55, 0.7, 0.93, 0.97, 1], [0, 0, 1, 1, 0.25, 0, 0]
    else:
        knots, speeds = [0, 0.12, 0.4, 0.55, 0.78, 1], [0, 0, 1, 1, 0, 0]
    # No harder than a driver does: 3 m/s2 on the rise, whatever the length of the drive.
    top = min(v, 3.0 * cycle * 0.39)
    return np.clip(_smoothed(top * np.interp(phase, knots, speeds)), 0.0, None)


def _ramp(t: FloatArray, period: float) -> FloatArray:
    """(n,) triangle wave between 0 and 1, two teeth a period."""
    return np.asarray(1.0 - np.abs(2.0 * np.mod(2.0 * (t + 0.4) / period, 1.0) - 1.0))


def _smoothed(values: FloatArray) -> FloatArray:
    """Values (n,) averaged twice over :data:`SMOOTH_S`; exact zeros stay where all around is zero."""
    window = round(SMOOTH_S / STEP_S)
    kernel = np.convolve(np.full(window, 1.0 / window), np.full(window, 1.0 / window))
    padded = np.pad(values, len(kernel) // 2, mode="edge")
    return np.convolve(padded, kernel, mode="same")[len(kernel) // 2 : len(kernel) // 2 + len(values)]


def random_path(config: SimulationConfig, rng: np.random.Generator, start: float, end: float) -> Path:
    """A centre line from arc length ``start`` to ``end`` [m] with bends and gentle slopes."""
    s = np.arange(start, end, 0.25)
    curvature = np.zeros_like(s)
    if config.motion in ("mixed", "turning", "no_stop", "stop_and_go", "there_and_back"):
        tight = config.motion == "turning"
        side = float(rng.choice([-1.0, 1.0]))
        at = float(rng.uniform(6.0, 12.0)) if tight else float(rng.uniform(12.0, 22.0))
        while at < end:
            radius, length = rng.uniform(22.0, 35.0), rng.uniform(22.0, 32.0)
            bump = np.clip(1.0 - ((s - at - length / 2) / (length / 2)) ** 2, 0.0, None) ** 1.0
            curvature += side * bump / radius
            at += length + (rng.uniform(4.0, 10.0) if tight else rng.uniform(15.0, 50.0))
            side = -side
    yaw = np.cumsum(curvature) * 0.25
    yaw -= np.interp(0.0, s, yaw)
    xy = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * 0.25, axis=0)
    height = np.zeros_like(s)
    for wavelength in (90.0, 160.0):
        height += wavelength / 500.0 * np.sin(2 * np.pi * (s / wavelength + rng.uniform()))
    return Path(s, xy - xy[np.searchsorted(s, 0.0)], yaw, height)


def ego_motion(
    config: SimulationConfig, path: Path, s: FloatArray, lane: float, height: float, rng: np.random.Generator
) -> EgoMotion:
    """The LiDAR's motion when the vehicle follows the lane ``lane`` metres left of the centre line.

    ``s`` (n,): arc length over :func:`time_table`. The body pitches with the acceleration and sways
    on its springs while it moves.
    """
    t = time_table(config)
    v = np.gradient(s, STEP_S)
    ground = path.at(s, lane)
    grade = np.interp(s, path.s, np.gradient(path.height, path.s))
    lateral = v**2 * np.interp(s, path.s, np.gradient(path.yaw, path.s))
    moving = np.clip(v / 3.0, 0.0, 1.0)
    sway = [moving * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in (1.1, 1.7, 1.4, 0.23)]
    angles = np.stack(
        [
            path.yaw_at(s) + np.deg2rad(0.3) * sway[3],
            -np.arctan(grade) - 0.004 * _smoothed(np.gradient(v, STEP_S)) + np.deg2rad(0.12) * sway[0],
            0.005 * lateral + np.deg2rad(0.15) * sway[1],
        ],
        axis=1,
    )
    position = ground + np.stack([0 * t, 0 * t, height + 0.008 * sway[2]], axis=1)
    return EgoMotion(t, s, position, angles)
