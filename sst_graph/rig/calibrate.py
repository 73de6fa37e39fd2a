"""Calibration of several cameras on one LiDAR: ``calibrate_rig``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from sst_graph.batch.by_edges.choice import choice_for_cameras, with_method_of
from sst_graph.batch.by_edges.method import edges_method
from sst_graph.batch.by_edges.problem import with_fewer_points
from sst_graph.batch.calibrate import (
    finished,
    preparation_of,
    prepare_drives,
    solve_problem,
)
from sst_graph.batch.config import CalibrationConfig, prepared_classes
from sst_graph.batch.method_estimate import UNKNOWN_SIGMAS, MethodEstimate, quality_of
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.batch.sources import as_sources
from sst_graph.config import expect_settings, to_dict
from sst_graph.covariance.observability import involves_offset, open_directions, reasons_of
from sst_graph.covariance.shared_errors import SharedErrors
from sst_graph.drive.further_camera import with_camera
from sst_graph.drive.preparation import Drive, Progress, check_progress
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import checked_type
from sst_graph.fit import QUALITY, Fit
from sst_graph.floating_point import with_usual_errors
from sst_graph.graph.outer_loop import KERNELS_PX
from sst_graph.graph.state import State
from sst_graph.quality.fit_of_solution import has_edges
from sst_graph.result import CalibrationResult, Status, WeakDirection
from sst_graph.rig.adjustment import (
    ComparedPose,
    ComparedTrigger,
    adjusted,
    compare_poses,
    compare_trigger,
)
from sst_graph.rig.influences import UNKNOWNS, CameraInfluences
from sst_graph.rig.joint_covariance import JointCovariance, joint_covariance
from sst_graph.rig.known import KnownRig
from sst_graph.rig.marginal import RigMarginal
from sst_graph.rig.result import RigResult, worst
from sst_graph.types import Calibration, FloatArray, Guess, Source
from sst_graph.validation import checked_guess

CameraSources = Source | Sequence[Source]


@with_usual_errors
def calibrate_rig(
    cameras: Mapping[str, CameraSources],
    initial: Mapping[str, gtsam.Pose3 | None] | None = None,
    config: CalibrationConfig | None = None,
    known: KnownRig | None = None,
    *,
    initial_time_offsets_s: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> RigResult:
    """Extrinsics and time offsets of several cameras on one LiDAR, with their joint covariance.

    Args:
        cameras: by name, the drives of each camera: sources of the same scans (:func:`sst_graph.open_source`
            with another ``camera``), several in the same order. The LiDAR is read from those of the first.
        initial: rough guess of each cTl; a camera that is missing, or None, has none.
        config: settings of all cameras. Method auto is joint where all have labels, and edges otherwise.
        known: poses of cameras in one another, and a common trigger.
        initial_time_offsets_s: rough guess of each time offset; 0 for a camera that is missing [s].
        progress: called with (stage, steps done, steps in all).

    Raises:
        DataError: the frames cannot be used, or two cameras have different scans.
        ConfigError: the settings contradict each other or the data.
        FactorError: no dict of cameras or guesses, nothing known of a rig, or no such ``progress``.
    """
    check_progress(progress)
    known = KnownRig() if known is None else known
    checked_type("cameras", cameras, Mapping, "a dict of sources by the camera's name")
    for name in cameras:
        checked_type("name of a camera", name, str, "a text")
    checked_type("known", known, KnownRig, "a KnownRig, or None")
    sources = {name: as_sources(own) for name, own in cameras.items()}
    initial = {} if initial is None else initial
    initial_time_offsets_s = {} if initial_time_offsets_s is None else initial_time_offsets_s
    guesses = _guesses(list(sources), initial, initial_time_offsets_s)
    config, _ = choice_for_cameras(expect_settings(config, CalibrationConfig), list(sources.values()))
    _check(sources, config)
    known.check(list(sources))
    drives = prepare_rig(sources, config, progress)
    return calibrate_rig_prepared(drives, guesses, config, known, progress)


def prepare_rig(
    sources: Mapping[str, Sequence[Source]], config: CalibrationConfig, progress: Progress | None = None
) -> dict[str, list[Drive]]:
    """The drives of each camera; scans, odometry and sweep are those of the first, prepared once."""
    config, _ = choice_for_cameras(config, list(sources.values()))
    (first, own), *others = sources.items()
    drives = {first: prepare_drives(own, config, progress)}
    for name, theirs in others:
        drives[name] = [
            with_camera(drive, source, prepared_classes(config), preparation_of(config), progress)
            for drive, source in zip(drives[first], theirs, strict=True)
        ]
    return drives


@with_usual_errors
def calibrate_rig_prepared(
    drives: Mapping[str, Sequence[Drive]],
    guesses: Mapping[str, Guess],
    config: CalibrationConfig,
    known: KnownRig,
    progress: Progress | None = None,
) -> RigResult:
    """:func:`calibrate_rig` of drives from :func:`prepare_rig`, with the same settings.

    Args:
        guesses: of every camera.
    """
    config = with_method_of(config, [drive for own in drives.values() for drive in own])
    # Likelihoods are of a camera's own estimate, which is not the result where something is known.
    nothing_known = not known.poses and not known.one_trigger
    config = replace(config, for_report=config.for_report and nothing_known)
    # 1. Each camera by itself, on the same LiDAR features, odometry and object tracks.
    problems = _problems(drives, guesses, config, progress)
    cameras = {name: _solved(problem) for name, problem in problems.items()}
    # 2. Their joint covariance, by the errors that they have in common.
    rig = _Rig(cameras, known)
    # 3. A camera far from where the others and the known poses put it is solved again from there.
    again = {name: _solved(problems[name], start) for name, start in rig.other_starts().items()}
    cameras = {name: _better(rig, name, own, again.get(name)) for name, own in cameras.items()}
    rig = _Rig(cameras, known)
    # 4. What is known of the rig, where the estimates do not contradict it.
    after = adjusted(rig.marginal, rig.agreed)
    return rig.result(after, config)


def _guesses(
    names: Sequence[str], initial: Mapping[str, gtsam.Pose3 | None], offsets_s: Mapping[str, float]
) -> dict[str, Guess]:
    """The guess of each camera.

    Raises:
        DataError: one that is no guess, or of a camera that is not there.
    """
    for what, given in (("initial", initial), ("initial_time_offsets_s", offsets_s)):
        checked_type(what, given, Mapping, "a dict of guesses by the camera's name")
        for name in given:
            if name not in names:
                raise DataError(what, f"a guess of {name!r:.60}", f"of {', '.join(map(str, names))}")
    return {name: Guess(*checked_guess(initial.get(name), offsets_s.get(name, 0.0))) for name in names}


def _check(sources: Mapping[str, Sequence[Source]], config: CalibrationConfig) -> None:
    if not sources:
        raise ConfigError("cameras: found none, expected one or more")
    if config.method not in ("joint", "edges"):
        raise ConfigError(f"several cameras need method joint or edges, found {config.method}")
    if config.time_offset_per_drive:
        raise ConfigError("several cameras have one time offset each: leave out time_offset_per_drive")
    counts = {name: len(own) for name, own in sources.items()}
    if len(set(counts.values())) > 1:
        raise ConfigError(f"cameras with different numbers of drives: {counts}")


def _problems(
    drives: Mapping[str, Sequence[Drive]],
    guesses: Mapping[str, Guess],
    config: CalibrationConfig,
    progress: Progress | None,
) -> dict[str, CalibrationProblem]:
    """The problem of each camera; twists and objects are tracked once, for their scans are the same."""
    (first, own), *_ = drives.items()
    shared = CalibrationProblem.of(own, guesses[first], config)
    return {
        name: replace(shared, drives=theirs, guess=guesses[name], progress=_named(progress, name))
        for name, theirs in drives.items()
    }


def _named(progress: Progress | None, camera: str) -> Progress | None:
    if progress is None:
        return None
    return lambda stage, done, total: progress(f"{camera}: {stage}", done, total)


@dataclass(frozen=True)
class _Camera:
    """One camera by itself.

    Attributes:
        problem: its drives and guess.
        result: of its own images.
        estimate: the same with its matches; None where there is none.
    """

    problem: CalibrationProblem
    result: CalibrationResult
    estimate: MethodEstimate | None

    @property
    def trusted(self) -> bool:
        """Whether its own estimate may inform other cameras."""
        return self.estimate is not None and self.result.status != "not_converged" and not self.open_sweeps

    @property
    def open_sweeps(self) -> tuple[str, ...]:
        """Sentences on sweeps that nothing decides and that matter: an error that all cameras share."""
        return () if self.estimate is None else self.estimate.open_sweeps

    @cached_property
    def errors(self) -> CameraInfluences | SharedErrors | None:
        """What moves the estimate; None where it informs no other camera."""
        if self.estimate is None or not self.trusted:
            return None
        outcome = self.estimate.solved
        return self.estimate.shared if outcome is None else CameraInfluences.of(outcome)

    @property
    def clusters(self) -> float:
        """Effective number of sides of objects, or of half-samples of them, behind its covariance."""
        outcome = None if self.estimate is None else self.estimate.solved
        if outcome is None:
            return float(self.errors.estimated) if isinstance(self.errors, SharedErrors) else 1.0
        return outcome.estimate.robust.table.clusters

    def fit_at(self, at: Calibration) -> Fit | None:
        """How a calibration fits its labels or edges: its own estimate, or one that the rig has moved."""
        own, fit = self.result.calibration, self.result.fit
        if fit is not None and own.time_offset_s == at.time_offset_s and own.cTl.equals(at.cTl, 0.0):
            return fit
        if self.estimate is not None and self.estimate.matched is not None:
            return self.estimate.matched.fit_at(at)
        by_edges = has_edges(self.problem.drives)
        problem = with_fewer_points(self.problem) if by_edges else self.problem
        return problem.fit_at(State(at.cTl, (at.time_offset_s,)))


def _solved(problem: CalibrationProblem, start: Guess | None = None) -> _Camera:
    """A camera's own estimate, searched around its guess, or close around another start."""
    own = problem
    if start is not None:
        search = replace(
            problem.config.search, rotation_deg=_NEAR_DEG, translation_m=_NEAR_M, time_offset_s=_NEAR_S
        )
        own = replace(problem, guess=start, config=replace(problem.config, search=search))
    result, estimate = finished(lambda: _estimate(own), own.drives, own.guess, own.config, own.progress)
    if start is not None:
        config = {**result.config, "search": to_dict(problem.config.search)}
        guess = problem.guess
        result = replace(result, initial=guess.cTl, initial_time_offset_s=guess.time_offset_s, config=config)
        result = replace(result, fit=None)  # beside another start
        if estimate is not None and estimate.matched is not None:
            estimate = replace(estimate, matched=estimate.matched.started_at(guess))
    return _Camera(problem, result, estimate)


def _estimate(problem: CalibrationProblem) -> MethodEstimate:
    """A camera's estimate by the method of the settings.

    Raises:
        EstimationError: there is none.
    """
    if problem.config.method == "edges":
        return edges_method(problem.drives, problem.guess, problem.config, problem.progress)
    return solve_problem(problem)


_NEAR_DEG, _NEAR_M, _NEAR_S = 1.0, 0.1, 0.05
"""Half widths of the search around where other cameras and a known pose put a camera."""
_REACH_PX, _REACH_AT_M = KERNELS_PX[-1], 10.0
"""An estimate so far from there, as the image of a point at this distance moves, is solved again from there:
the matches of the last kernel are then those of other contours."""


@dataclass(frozen=True)
class _Rig:
    """All cameras by themselves, and what is known of the rig."""

    cameras: Mapping[str, _Camera]
    known: KnownRig

    @cached_property
    def joint(self) -> JointCovariance:
        covariances = [self._covariance(name) for name in self.cameras]
        return joint_covariance(covariances, [camera.errors for camera in self.cameras.values()])

    def _covariance(self, name: str) -> FloatArray:
        """(7, 7) of a camera's own estimate; wide where that is not to be trusted and others know better."""
        return np.diag(UNKNOWN_SIGMAS**2) if self._set_aside(name) else self.cameras[name].result.covariance

    def _set_aside(self, name: str) -> bool:
        """Whether a camera's own estimate is not to be trusted and others know better."""
        linked = self.known.one_trigger or _has_pose(self.known, name)
        others_know = linked and any(other.trusted for other in self.cameras.values())
        return others_know and not self.cameras[name].trusted

    @cached_property
    def marginal(self) -> RigMarginal:
        """The cameras' own estimates."""
        results = [camera.result for camera in self.cameras.values()]
        return RigMarginal(
            tuple(self.cameras),
            tuple(result.T_camera_lidar for result in results),
            tuple(result.time_offset_s for result in results),
            self.joint.matrix,
        )

    @cached_property
    def poses(self) -> tuple[ComparedPose, ...]:
        return compare_poses(self.marginal, self.known, self._clusters)

    @cached_property
    def trigger(self) -> ComparedTrigger | None:
        return compare_trigger(self.marginal, self.known, self._clusters)

    @property
    def _clusters(self) -> list[float]:
        return [camera.clusters for camera in self.cameras.values()]

    @property
    def agreed(self) -> KnownRig:
        """What is known and not contradicted."""
        poses = tuple(pose.known for pose in self.poses if not pose.contradicted)
        return KnownRig(poses, self.trigger is not None and not self.trigger.contradicted)

    def other_starts(self) -> dict[str, Guess]:
        """Where the better known camera of a known pose puts the other one, for those far from there."""
        starts = {}
        for compared in self.poses:
            pose = compared.known
            names = (pose.camera, pose.reference)
            better, weaker = sorted(names, key=lambda name: _size(self._covariance(name)))
            if not self.cameras[better].trusted or weaker in starts:
                continue
            cTb = pose.T_camera_reference
            step = cTb if weaker == pose.camera else cTb.inverse()
            start = step * self.cameras[better].result.T_camera_lidar
            own = self.cameras[weaker].result
            if not self.cameras[weaker].trusted or _pixels(own, start) > _REACH_PX:
                clock = self.cameras[better] if self.known.one_trigger else self.cameras[weaker]
                starts[weaker] = Guess(start, clock.result.time_offset_s)
        return starts

    def with_camera(self, name: str, camera: _Camera) -> _Rig:
        return _Rig({**self.cameras, name: camera}, self.known)

    def disagreement(self, name: str) -> float:
        """Sum of chi-squared of the known poses of a camera."""
        return sum(
            pose.difference.chi2 for pose in self.poses if name in (pose.known.camera, pose.known.reference)
        )

    def result(self, after: RigMarginal, config: CalibrationConfig) -> RigResult:
        """The result, with the cameras' estimates after the adjustment."""
        of_trigger = [self.trigger.sentence] if self.trigger is not None and self.trigger.contradicted else []
        of_poses = [pose for pose in self.poses if pose.contradicted]
        wrong = {
            name: [p.sentence for p in of_poses if name in (p.known.camera, p.known.reference)] + of_trigger
            for name in self.cameras
        }
        static = self._static_covariances()
        weak = {name: self._weak(name, after, static[name], config) for name in self.cameras}
        results = {
            name: _camera_result(camera, name, after, weak[name], wrong[name])
            for name, camera in self.cameras.items()
        }
        return RigResult(
            results,
            after.covariance,
            worst([result.status for result in results.values()]),
            (*(pose.sentence for pose in of_poses), *of_trigger),
            self.known,
            self._diagnostics(),
        )

    def _weak(
        self, name: str, after: RigMarginal, static: FloatArray, config: CalibrationConfig
    ) -> tuple[WeakDirection, ...]:
        """Directions of a camera that are known worse than the limits, after the adjustment.

        Args:
            static: (7, 7) covariance by static objects alone.
        """
        covariance, cTl = after.of_camera(name), after.extrinsics[after.names.index(name)]
        weak = open_directions(covariance, static, cTl, config.observability)
        if self._set_aside(name) or self.cameras[name].estimate is None:
            weak = _with_advice(weak, self.agreed, name)
        return weak

    def _static_covariances(self) -> dict[str, FloatArray]:
        """(7, 7) of each camera by static objects alone, and what is known of the rig."""
        cameras, n = self.cameras.values(), UNKNOWNS * len(self.cameras)
        whole = np.zeros((n, n))
        for i, camera in enumerate(cameras):
            at = slice(UNKNOWNS * i, UNKNOWNS * (i + 1))
            known = camera.estimate.by_static_objects if camera.estimate and camera.trusted else None
            whole[at, at] = self.joint.matrix[at, at] if known is None else known
        after = adjusted(replace(self.marginal, covariance=whole), self.agreed)
        return {name: after.of_camera(name) for name in self.cameras}

    def _diagnostics(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "correlations": dict(self.joint.correlations),
            "sides_in_common": self.joint.common,
            "known_poses": [
                {
                    "camera": pose.known.camera,
                    "reference": pose.known.reference,
                    "chi2_of_6": pose.difference.chi2,
                    "p_value": pose.difference.p_value,
                    "used": not pose.contradicted,
                }
                for pose in self.poses
            ],
        }
        if self.trigger is not None:
            found["one_trigger"] = {
                "chi2": self.trigger.difference.chi2,
                "degrees_of_freedom": len(self.trigger.difference.step),
                "p_value": self.trigger.difference.p_value,
                "used": not self.trigger.contradicted,
            }
        return found


def _better(rig: _Rig, name: str, own: _Camera, again: _Camera | None) -> _Camera:
    """The estimate of a camera that goes better with the known poses; its own where none does."""
    if again is None or not again.trusted:
        return own
    if not own.trusted:
        return again
    return again if rig.with_camera(name, again).disagreement(name) < rig.disagreement(name) else own


def _size(covariance: FloatArray) -> float:
    """Mean variance of an extrinsic, as the image of a point moves [rad^2]."""
    return float(np.trace(covariance[:3, :3]) + np.trace(covariance[3:6, 3:6]) / _REACH_AT_M**2)


def _pixels(result: CalibrationResult, cTl: gtsam.Pose3) -> float:
    """How far the image of a point moves between a result and another extrinsic, at most [px]."""
    step = gtsam.Pose3.Logmap(result.T_camera_lidar.between(cTl))
    angle = float(np.linalg.norm(step[:3]) + np.linalg.norm(step[3:]) / _REACH_AT_M)
    return angle * result.camera.fx


def _has_pose(known: KnownRig, name: str) -> bool:
    """Whether a known pose joins a camera to another one."""
    return any(name in (pose.camera, pose.reference) for pose in known.poses)


_NO_POSE = "give this camera better images or labels, or its pose to another camera (--rig)"
_NO_OFFSET = "give this camera better images or labels, or, where all are triggered together, --one-trigger"
"""Advice where a camera has no estimate of its own, or it was set aside."""


def _with_advice(weak: Sequence[WeakDirection], agreed: KnownRig, name: str) -> tuple[WeakDirection, ...]:
    """Weak directions of a camera without an estimate of its own that is used: no record with such images
    helps in what no other camera tells of it."""

    def advised(direction: WeakDirection) -> WeakDirection:
        if involves_offset(direction):
            return direction if agreed.one_trigger else replace(direction, advice=_NO_OFFSET)
        return direction if _has_pose(agreed, name) else replace(direction, advice=_NO_POSE)

    return tuple(advised(direction) for direction in weak)


_FROM_OTHERS = (
    "its own images give no estimate: pose and time offset follow from the other cameras and what is known "
    "of the rig"
)


def _camera_result(
    camera: _Camera,
    name: str,
    after: RigMarginal,
    weak: tuple[WeakDirection, ...],
    wrong: Sequence[str],
) -> CalibrationResult:
    """A camera's result after the adjustment, with its weak directions and what makes it wrong."""
    at, own = after.names.index(name), camera.result
    cTl, covariance = after.extrinsics[at], after.of_camera(name)
    not_converged = bool(wrong) or own.status == "not_converged"
    unobservable = bool(weak) or bool(camera.open_sweeps)
    status: Status = "not_converged" if not_converged else "unobservable" if unobservable else "ok"
    gone = {*(direction.reason for direction in own.weak_directions), *camera.open_sweeps}
    kept = tuple(reason for reason in own.reasons if reason not in gone)
    if not own.frames_used and status == "ok":
        kept = (_FROM_OTHERS, *kept)
    sentences = (*camera.open_sweeps, *reasons_of(weak))
    cause_first = not_converged or camera.estimate is None
    alone = {
        "T_camera_lidar": own.T_camera_lidar.matrix().tolist(),
        "time_offset_s": own.time_offset_s,
        "covariance": own.covariance.tolist(),
        "status": own.status,
    }
    placed = Calibration(cTl, after.time_offsets_s[at])
    fit = camera.fit_at(placed)
    diagnostics = {key: value for key, value in own.diagnostics.items() if key != QUALITY}
    return replace(
        own,
        T_camera_lidar=cTl,
        time_offset_s=after.time_offsets_s[at],
        covariance=covariance,
        status=status,
        camera_name=name,
        reasons=(*wrong, *kept, *sentences) if cause_first else (*sentences, *kept),
        weak_directions=weak,
        diagnostics={**diagnostics, **quality_of(fit, placed), "by_own_images": alone},
        fit=fit,
    )
