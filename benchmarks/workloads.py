"""What the benchmarks of speed compute: frames of random matches, and a simulated drive to be solved."""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from sst_graph.association.nearest import ClassView
from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.factors import Alignment, PinholeCamera, RobustKernel
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.frozen_problem import FrozenProblem
from sst_graph.graph.matching import DriveEdges, DriveMatches, GraphConfig
from sst_graph.graph.state import State
from sst_graph.objects.tracks import object_tracks
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import SemanticClass

E, D, V = (gtsam.symbol(letter, 0) for letter in "edv")
CAMERA = PinholeCamera(718.0, 718.0, 607.0, 185.0, 1242, 375)
VEHICLE = SemanticClass.VEHICLE
KERNEL = RobustKernel("geman_mcclure", 5.0)
POSE, TIME_OFFSET_S = gtsam.Pose3.Expmap(np.full(6, 0.01)), 0.1
C_TWIST = np.array([0.01, 0.1, 0.0, 0.1, 0.0, 9.0])
OFF = np.array([0.003, -0.002, 0.004, 0.01, -0.02, 0.01])
"""From the true extrinsic to the one at which a drive is matched: left after a few outer iterations."""


def frame_matches(seed: int, n: int, per_point: bool = False) -> Alignment:
    """n point-to-pixel matches of one image; per_point: each point has a time of its own."""
    rng = np.random.default_rng(seed)
    cPs = rng.uniform([-6, -2, 6], [6, 2, 40], (n, 3))
    return Alignment(
        CAMERA,
        cPs,
        rng.uniform(-0.05, 0.05, n) if per_point else 0.0,
        CAMERA.project(cPs) + rng.normal(0.0, 3.0, (n, 2)),
        1.5,
        kernel=RobustKernel("geman_mcclure", 3.0),
    )


def frame_values() -> gtsam.Values:
    """Where a frame is linearized."""
    values = gtsam.Values()
    values.insert(E, POSE)
    values.insert(D, np.array([TIME_OFFSET_S]))
    values.insert(V, C_TWIST)
    return values


def class_view(points: int, pixels: int) -> ClassView:
    """Five vehicles in a mask, points around them, and so many pixels of them."""
    rng = np.random.default_rng(0)
    mask = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    for left in range(60, 1200, 240):
        mask[170:290, left : left + 180] = VEHICLE
    uvs = rng.uniform([60.0, 160.0], [1200.0, 300.0], (points, 2))
    rays = np.column_stack([(uvs - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(points)])
    cPs = rays * rng.uniform(8.0, 40.0, points)[:, None]
    found = ClassView.of(CAMERA, cPs, 0.0, mask == VEHICLE, pixels / int((mask > 0).sum()), rng)
    assert found is not None
    return found


def street(frames: int, **changes: Any) -> SimulatedDrive:
    """A simulated drive at half of KITTI's image size, unless ``changes`` say otherwise."""
    config = SimulationConfig(
        seed=3, frames=frames, width=621, height=188, time_offset_s=0.03, motion="no_stop", speed_mps=6.0
    )
    return simulate(replace(config, **changes))


@dataclass(frozen=True)
class DriveWork:
    """A drive's boundary points, and a state near the truth at which they are matched.

    Attributes:
        edges: of the drive.
        state: at which it is matched.
    """

    edges: DriveEdges
    state: State

    @classmethod
    def of(cls, source: SimulatedDrive, prepared: Drive | None = None) -> DriveWork:
        """With the settings of ``calibrate``; the drive is read unless it is given."""
        drive = prepared or prepare_drive(source, [VEHICLE], PrepareConfig(use_visual_odometry=False))
        motion = DriveMotion.of(drive, object_tracks(drive))
        edges = DriveEdges.of(0, drive, motion, GraphConfig())
        assert edges is not None and source.truth.time_offset_s is not None
        return cls(edges, State(source.truth.cTl.retract(OFF), (source.truth.time_offset_s + 0.002,)))

    def match(self) -> DriveMatches:
        found = self.edges.match(self.state, KERNEL)
        assert found is not None
        return found

    @cached_property
    def matches(self) -> DriveMatches:
        return self.match()

    @cached_property
    def problem(self) -> FrozenProblem:
        return FrozenProblem([self.matches], self.state, self.edges.config)


def best_seconds(works: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Least processor time of a call of each [s], the calls taking turns so that all see the same machine.

    A turn is long enough for the clock and for warm caches: as many calls as take 10 ms.
    """
    timers = {name: timeit.Timer(work, timer=time.process_time) for name, work in works.items()}
    calls = {name: max(1, round(1e-2 / min(timer.repeat(3, 1)))) for name, timer in timers.items()}
    best = dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, timer in timers.items():
            best[name] = min(best[name], timer.timeit(calls[name]) / calls[name])
    return best
