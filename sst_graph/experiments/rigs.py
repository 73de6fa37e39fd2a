"""Rigs of cameras on simulated streets: errors, joint NEES, and what a known pose between cameras adds."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress
from sst_graph.experiments.markdown import table
from sst_graph.experiments.starts import error_of
from sst_graph.metrics import nees
from sst_graph.rig.adjustment import adjusted
from sst_graph.rig.calibrate import calibrate_rig_prepared, prepare_rig
from sst_graph.rig.influences import UNKNOWNS
from sst_graph.rig.known import KnownPose, KnownRig
from sst_graph.rig.marginal import RigMarginal
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.simulator.rig import beside, stereo_pose, surround, with_mounts
from sst_graph.types import Calibration, FloatArray, GroundTruth, Guess

STREET: Mapping[str, Any] = {
    "motion": "stop_and_go",
    "width": 621,
    "height": 188,
    "azimuth_step_deg": 0.3,
    "vehicle_density": 0.25,
    "time_offset_s": 0.03,
}
"""The simulator's settings of every street: small pictures."""


@dataclass(frozen=True)
class RigTableConfig(Settings):
    """Streets with a rig each.

    Attributes:
        rig: stereo as KITTI's (one trigger), or surround: cameras all around with time offsets of their own.
        cameras: of a surround rig.
        streets: number of them.
        seed: of the first street; the next ones follow.
        frames: of each street.
        calibration: settings of the method.
    """

    rig: Literal["stereo", "surround"] = "stereo"
    cameras: int = setting(6, at_least=2, at_most=12)
    streets: int = setting(12, at_least=1, at_most=10_000)
    seed: int = setting(7000, at_least=0, at_most=10**15)
    frames: int = setting(30, at_least=3, at_most=10_000)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)


@dataclass(frozen=True)
class _Street:
    """A rig's estimates on one street.

    Attributes:
        truths: of the cameras.
        own: every camera by its own images, with the joint covariance.
        by_pose, by_trigger: with the pose between the first two known; also with one trigger. None of a
            surround rig.
        statuses: of the cameras by their own images.
        seconds: of reading and calibration: of all cameras, and of the first alone (NaN: not timed).
        correlations: of the errors of matches, by kind.
    """

    truths: tuple[GroundTruth, ...]
    own: RigMarginal
    by_pose: RigMarginal | None
    by_trigger: RigMarginal | None
    statuses: tuple[str, ...]
    seconds: tuple[float, float]
    correlations: Mapping[str, float]


def run(config: RigTableConfig, progress: Progress | None = None) -> str:
    """Markdown tables of one kind of rig."""
    streets = []
    for number in range(config.streets):
        streets.append(_street(config, config.seed + number))
        if progress is not None:
            progress(config.rig, number + 1, config.streets)
    return _stereo_tables(streets) if config.rig == "stereo" else _surround_tables(streets)


def _street(config: RigTableConfig, seed: int) -> _Street:
    drive = simulate(SimulationConfig(seed=seed, frames=config.frames, **STREET))
    mounts = (
        {"image_3": beside(drive, stereo_pose())}
        if config.rig == "stereo"
        else surround(drive, config.cameras)
    )
    rig = with_mounts(drive, mounts, "image_2" if config.rig == "stereo" else "camera_0")
    settings = config.calibration
    guesses = {name: Guess(camera.nominal) for name, camera in rig.items()}
    # 1. All cameras; on the first street the first camera alone is timed apart, for comparison.
    first, own = next(iter(rig.items()))
    alone_s = _seconds_alone(first, own, settings) if seed == config.seed else np.nan
    began = time.perf_counter()
    drives = prepare_rig({name: [camera] for name, camera in rig.items()}, settings)
    result = calibrate_rig_prepared(drives, guesses, settings, KnownRig())
    seconds = (time.perf_counter() - began, alone_s)
    # 2. The same with what is known of a stereo rig.
    marginal, known = result.marginal(), _measured(rig, seed)
    stereo = config.rig == "stereo"
    return _Street(
        tuple(camera.truth for camera in rig.values()),
        marginal,
        adjusted(marginal, KnownRig((known,))) if stereo else None,
        adjusted(marginal, KnownRig((known,), one_trigger=True)) if stereo else None,
        tuple(camera.status for camera in result.cameras.values()),
        seconds,
        result.diagnostics["correlations"],
    )


def _seconds_alone(name: str, camera: SimulatedDrive, settings: CalibrationConfig) -> float:
    """Time to read and calibrate one camera [s]."""
    began = time.perf_counter()
    guesses = {name: Guess(camera.nominal)}
    calibrate_rig_prepared(prepare_rig({name: [camera]}, settings), guesses, settings, KnownRig())
    return time.perf_counter() - began


def _measured(rig: Mapping[str, SimulatedDrive], seed: int) -> KnownPose:
    """The true pose of the second camera in the first, wrong by its deviation."""
    (reference, b), (camera, c), *_ = rig.items()
    exact = KnownPose(camera, reference, c.truth.cTl * b.truth.cTl.inverse())
    error = np.sqrt(np.diag(exact.covariance)) * np.random.default_rng([seed, 13]).standard_normal(6)
    return KnownPose(camera, reference, exact.T_camera_reference * gtsam.Pose3.Expmap(error))


def _errors(marginal: RigMarginal, truths: Sequence[GroundTruth]) -> FloatArray:
    """(n, 7) truth less estimate of each camera, in the estimate's tangent space [rad, m, s]."""
    estimates = map(Calibration, marginal.extrinsics, marginal.time_offsets_s)
    return np.stack([error_of(*each) for each in zip(estimates, truths, strict=True)])


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared over its dimension."""
    return nees(error, covariance) / len(error)


def _block(marginal: RigMarginal, camera: int) -> FloatArray:
    return marginal.of_camera(marginal.names[camera])


def _joint_nees(street: _Street) -> tuple[float, float]:
    """NEES of all cameras together: with the joint covariance, and as if they were independent."""
    errors, whole = _errors(street.own, street.truths), street.own.covariance
    apart = np.mean([_nees(error, _block(street.own, k)) for k, error in enumerate(errors)])
    return _nees(errors.reshape(-1), whole), float(apart)


def _between(street: _Street, c: int, b: int) -> tuple[float, float]:
    """NEES over its dimension of the pose of camera c in camera b, and of their time offsets' difference."""
    names, truths = street.own.names, street.truths
    pose = street.own.relative_pose(names[c], names[b])
    true = truths[c].cTl * truths[b].cTl.inverse()
    step = np.asarray(gtsam.Pose3.Logmap(pose.T_camera_reference.between(true)))
    late = (truths[c].time_offset_s or 0.0) - (truths[b].time_offset_s or 0.0) - pose.time_offset_s
    return _nees(step, pose.covariance), float((late / pose.time_offset_sigma_s) ** 2)


_SCALES = np.array([np.degrees(1.0), 100.0, 1000.0])


def _sizes(errors: Sequence[FloatArray]) -> list[str]:
    """Medians of rotation [deg], translation [cm] and time offset [ms], their lengths."""
    lengths = np.array([[np.linalg.norm(e[:3]), np.linalg.norm(e[3:6]), abs(e[6])] for e in errors])
    rotation, translation, late = np.median(lengths, axis=0) * _SCALES
    return [f"{rotation:.3f}", f"{translation:.2f}", f"{late:.2f}"]


_HEAD = "| {} | rotation [deg] | translation [cm] | time offset [ms] | NEES / 7 | ok |"


def _stereo_tables(streets: Sequence[_Street]) -> str:
    rows = []
    weaker = [int(np.trace(_block(s.own, 1)[:6, :6]) > np.trace(_block(s.own, 0)[:6, :6])) for s in streets]
    for title, of_weaker in (("better known camera", False), ("weaker camera", True)):
        chosen = [w if of_weaker else 1 - w for w in weaker]
        for words, name in (
            ("own images", "own"),
            ("known pose", "by_pose"),
            ("known pose, one trigger", "by_trigger"),
        ):
            errors, nees = [], []
            for street, k in zip(streets, chosen, strict=True):
                marginal = getattr(street, name)
                errors.append(_errors(marginal, street.truths)[k])
                nees.append(_nees(errors[-1], _block(marginal, k)))
            ok = sum(street.statuses[k] == "ok" for street, k in zip(streets, chosen, strict=True))
            counted = f"{ok} of {len(streets)}" if name == "own" else ""
            rows.append([f"{title}, {words}", *_sizes(errors), f"{np.mean(nees):.2f}", counted])
    return f"{table(_HEAD.format('camera, estimate'), rows)}\n{_joint_table(streets, [(1, 0)])}"


def _surround_tables(streets: Sequence[_Street]) -> str:
    rows = []
    for k, name in enumerate(streets[0].own.names):
        errors = [_errors(street.own, street.truths)[k] for street in streets]
        nees = [_nees(e, _block(s.own, k)) for e, s in zip(errors, streets, strict=True)]
        ok = sum(street.statuses[k] == "ok" for street in streets)
        rows.append([name, *_sizes(errors), f"{np.mean(nees):.2f}", f"{ok} of {len(streets)}"])
    neighbours = [(k + 1, k) for k in range(len(streets[0].own.names) - 1)]
    return f"{table(_HEAD.format('camera'), rows)}\n{_joint_table(streets, neighbours)}"


def _joint_table(streets: Sequence[_Street], pairs: Sequence[tuple[int, int]]) -> str:
    joint = np.mean([_joint_nees(street) for street in streets], axis=0)
    between = np.mean([_between(street, c, b) for street in streets for c, b in pairs], axis=0)
    ratio = np.nanmedian([all_s / alone_s for (all_s, alone_s) in (street.seconds for street in streets)])
    kinds = streets[0].correlations
    alike = ", ".join(
        f"{kind} {np.median([street.correlations[kind] for street in streets]):.2f}" for kind in kinds
    )
    size = UNKNOWNS * len(streets[0].own.names)
    rows = [
        [f"NEES / {size} of all cameras, joint covariance", f"{joint[0]:.2f}"],
        ["the same as if the cameras were independent", f"{joint[1]:.2f}"],
        ["NEES / 6 of the poses between neighbours", f"{between[0]:.2f}"],
        ["NEES / 1 of the differences of their time offsets", f"{between[1]:.2f}"],
        ["correlation of errors in common (median)", alike],
        ["time of all cameras over that of the first alone (first street)", f"{ratio:.1f}"],
    ]
    return table("| figure | mean |", rows)
