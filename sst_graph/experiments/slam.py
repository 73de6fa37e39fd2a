"""Pose3 SLAM and calibration in one graph against either alone, on simulated streets.

The vehicle drives forward and returns in reverse. LiDAR odometry from scan to scan and loop closures by scan
registration make a pose graph; silhouettes (:func:`sst_graph.factors.pose_alignment_factor`) and visual
odometry (:func:`sst_graph.factors.camera_motion_factor`) join the camera to it through extrinsic and time
offset.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.config import Settings, setting
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Progress, prepare_drive
from sst_graph.experiments.markdown import table
from sst_graph.experiments.slam_graph import (
    EXTRINSIC,
    TIME_OFFSET,
    CameraGraphConfig,
    pose_graph,
    pose_key,
    with_camera,
)
from sst_graph.odometry import RegisteredScan, loop_closures, scan_to_scan
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import Calibration

WEATHERS: Mapping[str, Mapping[str, Any]] = {
    "fog": {"max_range_m": 20.0, "range_noise_m": 0.08, "drop_out": 0.5},
    "clear": {},
}
"""What the LiDAR suffers, by name: changes to the simulator's settings."""
ROWS = ("odometry", "SLAM alone", "calibration alone", "both")
MEASURES = {
    "position [cm]": 3,
    "step rotation [deg]": 4,
    "step translation [cm]": 3,
    "rotation [deg]": 4,
    "translation [cm]": 3,
    "time offset [ms]": 3,
}
"""Errors, the trajectory's first, and the digits that the table shows."""


@dataclass(frozen=True)
class SlamConfig(Settings):
    """Streets and settings.

    Attributes:
        streets: number of simulated streets of each weather.
        seed: of the first street; the next ones follow.
        weathers: names; all of them by default.
        frames: of each drive.
        time_offset_s: true time offset [s].
        street: further settings of the simulator.
        loop_every, loop_min_s: one scan out of so many is tried as a loop closure, and with scans that are so
            much older [s].
        camera: what the camera adds to the pose graph.
        calibration: of the calibration alone, from whose result both together start.
    """

    streets: int = setting(5, at_least=1, at_most=10_000)
    seed: int = setting(1, at_least=0, at_most=10**15)
    weathers: tuple[str, ...] = setting(tuple(WEATHERS), length=(1, 100), choices=WEATHERS)
    frames: int = setting(60, at_least=2, at_most=10_000)
    time_offset_s: float = setting(0.05, at_least=-0.5, at_most=0.5)
    street: SimulationConfig = field(
        default_factory=lambda: SimulationConfig(
            width=621,
            height=188,
            motion="there_and_back",
            speed_mps=6.0,
            azimuth_step_deg=0.4,
            vehicle_density=0.25,
            moving_fraction=0.0,
        )
    )
    loop_every: int = setting(4, at_least=1, at_most=100_000)
    loop_min_s: float = setting(2.0, at_least=0.001, at_most=1e6)
    camera: CameraGraphConfig = field(default_factory=CameraGraphConfig)
    # Contours where the masks have them: on small images following the picture brings nothing.
    calibration: CalibrationConfig = field(default_factory=lambda: CalibrationConfig(image_edges=False))


@dataclass(frozen=True)
class SlamRun:
    """One street's outcome.

    Attributes:
        weather: of the street.
        closures: number of loop closures.
        errors: of each of :data:`ROWS`, by the names of :data:`MEASURES`; those that apply.
    """

    weather: str
    closures: int
    errors: Mapping[str, Mapping[str, float]]


def run(config: SlamConfig, progress: Progress | None = None) -> str:
    """Medians over the streets as a Markdown table, and how often both together are better."""
    streets: list[SlamRun] = []
    for weather in config.weathers:
        for number in range(config.streets):
            streets.append(solve_street(config, weather, config.seed + number))
            if progress is not None:
                progress(weather, number + 1, config.streets)
    return markdown(config, streets)


def solve_street(config: SlamConfig, weather: str, seed: int) -> SlamRun:
    """SLAM alone, calibration alone, and both, on one street."""
    street = dataclasses.replace(config.street, seed=seed, frames=config.frames, **WEATHERS[weather])
    source = simulate(dataclasses.replace(street, time_offset_s=config.time_offset_s))
    kept = KeptDrive.of(source)
    drive = prepare_drive(kept, config.calibration.classes, config.calibration.prepare)
    scans = [RegisteredScan(frame.scan) for frame in kept.frames if frame.scan is not None]
    # 1. SLAM alone: LiDAR odometry, loop closures.
    graph, odometry = pose_graph(scan_to_scan(scans))
    poses = [odometry.atPose3(pose_key(k)) for k in range(len(scans))]
    closures = loop_closures(scans, poses, config.loop_every, config.loop_min_s)
    graph, _ = pose_graph(scan_to_scan(scans), closures)
    slam = gtsam.LevenbergMarquardtOptimizer(graph, odometry).optimize()
    # 2. Calibration alone.
    alone = calibrate_prepared([drive], source.nominal, config.calibration)
    # 3. Both in one graph.
    both = with_camera(graph, slam, drive, alone.calibration, source.nominal, config.camera)
    found = Calibration(both.atPose3(EXTRINSIC), float(both.atVector(TIME_OFFSET)[0]))
    errors = {
        "odometry": trajectory_errors(odometry, source),
        "SLAM alone": trajectory_errors(slam, source),
        "calibration alone": calibration_errors(alone.calibration, source),
        "both": trajectory_errors(both, source) | calibration_errors(found, source),
    }
    return SlamRun(weather, len(closures), errors)


def trajectory_errors(values: gtsam.Values, source: SimulatedDrive) -> dict[str, float]:
    """RMS errors of the positions, the first pose held, and of the motions from scan to scan."""
    true = [source.wTl(stamp * 1e-9) for stamp in source.stamps_ns]
    true = [true[0].between(pose) for pose in true]
    found = [values.atPose3(pose_key(k)) for k in range(len(true))]
    off = [f.translation() - t.translation() for f, t in zip(found, true, strict=True)]
    steps = np.array(
        [
            true[k].between(true[k + 1]).localCoordinates(found[k].between(found[k + 1]))
            for k in range(len(true) - 1)
        ]
    )
    sizes = 100.0 * _rms(off), np.degrees(_rms(steps[:, :3])), 100.0 * _rms(steps[:, 3:])
    return dict(zip(list(MEASURES)[:3], map(float, sizes), strict=True))


def calibration_errors(estimate: Calibration, source: SimulatedDrive) -> dict[str, float]:
    """Sizes of the errors of extrinsic and time offset."""
    d = source.truth.cTl.localCoordinates(estimate.cTl)
    sizes = (
        np.degrees(np.linalg.norm(d[:3])),
        100.0 * np.linalg.norm(d[3:]),
        1e3 * abs(estimate.time_offset_s - source.config.time_offset_s),
    )
    return dict(zip(list(MEASURES)[3:], map(float, sizes), strict=True))


def markdown(config: SlamConfig, streets: Sequence[SlamRun]) -> str:
    """The table: a row for each weather and way, and one of how often both together are better."""
    rows = []
    for weather in config.weathers:
        chosen = [street for street in streets if street.weather == weather]
        for row in ROWS:
            cells = [_median(chosen, row, name, digits) for name, digits in MEASURES.items()]
            rows.append([weather, row, *cells])
        cells = [_better(chosen, name) for name in MEASURES]
        rows.append([weather, "both better", *cells])
    return table("| weather | | " + " | ".join(MEASURES) + " |", rows)


def _median(streets: Sequence[SlamRun], row: str, name: str, digits: int) -> str:
    values = [street.errors[row][name] for street in streets if name in street.errors[row]]
    return f"{np.median(values):.{digits - 1}f}" if values else ""


def _better(streets: Sequence[SlamRun], name: str) -> str:
    """In how many streets both together have the smaller error than the one alone that determines it."""
    alone = "SLAM alone" if name in list(MEASURES)[:3] else "calibration alone"
    count = sum(street.errors["both"][name] < street.errors[alone][name] for street in streets)
    return f"{count} of {len(streets)}"


def _rms(vectors: Any) -> float:
    """Root of the mean squared length of vectors (n, d)."""
    return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=1))))
