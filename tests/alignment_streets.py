"""A drive with its terms, for any solver: the user's own graph around them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import gtsam
import numpy as np
from stored import simulated, stored

from sst_graph import AlignmentKeys, AlignmentTerm, IncrementalTerms, Trajectory
from sst_graph.drive.preparation import ImageFeatures, ScanFeatures
from sst_graph.factors import PinholeCamera, time_offset_prior
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.simulator.config import Motion
from sst_graph.slam.align import VEHICLES, features_of
from sst_graph.slam.alignment_term import TermConfig
from sst_graph.slam.incremental_terms import IncrementalUpdate, Solver
from sst_graph.types import Frame, RelativeMotion, SemanticClass

E, D = gtsam.symbol("E", 0), gtsam.symbol("D", 0)
WIDE = (1.0, 1.0, 1.0)
"""Prior sigmas of extrinsic [rad, m] and offset [s]."""


def X(k: int) -> int:
    return int(gtsam.symbol("X", k))


@dataclass(frozen=True)
class Street:
    """What a user has, and the truth."""

    camera: PinholeCamera
    scans: tuple[ScanFeatures, ...]
    images: tuple[ImageFeatures, ...]
    motions: tuple[RelativeMotion, ...]
    cTl: gtsam.Pose3
    time_offset_s: float
    config: TermConfig = field(default_factory=TermConfig)

    @property
    def stamps_ns(self) -> list[int]:
        return [scan.stamp_ns for scan in self.scans]

    def start(self, seed: int) -> tuple[gtsam.Pose3, float]:
        """2 deg, 7.5 cm and 30 ms off, in a random direction."""
        rng = np.random.default_rng(seed)
        rotation, translation = rng.standard_normal((2, 3))
        off = np.concatenate(
            [
                np.radians(2.0) * rotation / np.linalg.norm(rotation),
                0.075 * translation / np.linalg.norm(translation),
            ]
        )
        return self.cTl.retract(off), self.time_offset_s + 0.03 * float(rng.choice([-1.0, 1.0]))

    def term(self, k: int, keys: AlignmentKeys) -> AlignmentTerm:
        """Image k with the scans around it."""
        scans = self.scans[max(k - 1, 0) : k + 4]
        return AlignmentTerm(scans, self.images[k], self.camera, keys, self.config)

    def new_at(
        self, k: int, start: tuple[gtsam.Pose3, float], sigmas: Sequence[float] = WIDE
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The user's own factors and starts of frame k: odometry, and wide priors on the calibration."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3()
        for motion in self.motions[:k]:
            pose = pose * motion.aTb
        values.insert(X(k), pose)
        if k:
            motion = self.motions[k - 1]
            noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), motion.aTb, noise))
            return graph, values
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
        wide = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigmas[:2], 3))
        graph.add(gtsam.PriorFactorPose3(E, start[0], wide))
        graph.add(time_offset_prior(D, start[1], sigmas[2]))
        values.insert(E, start[0])
        values.insert(D, np.array([start[1]]))
        return graph, values

    def whole(
        self, start: tuple[gtsam.Pose3, float], sigmas: Sequence[float] = WIDE
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """:meth:`new_at` of all frames."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in range(len(self.scans)):
            more, starts = self.new_at(k, start, sigmas)
            graph.push_back(more)
            values.insert(starts)
        return graph, values

    def trajectory(self) -> Trajectory:
        return Trajectory([X(k) for k in range(len(self.scans))], self.stamps_ns)

    def frame_by_frame(
        self, solver: Solver, start: tuple[gtsam.Pose3, float], sigmas: Sequence[float] = WIDE
    ) -> IncrementalUpdate:
        """Every frame as it comes, then rounds until nothing changes."""
        trajectory = Trajectory()
        keys = AlignmentKeys(trajectory, E, D)
        terms = IncrementalTerms(solver, keys)
        for k, stamp_ns in enumerate(self.stamps_ns):
            graph, values = self.new_at(k, start, sigmas)
            trajectory.append(X(k), stamp_ns)
            new = [self.term(k, keys)] if k < len(self.images) else []
            terms.update(graph, values, new, {X(k): 1e-9 * (stamp_ns - self.stamps_ns[0])})
        return terms.converge(20)

    def errors(self, values: gtsam.Values) -> tuple[float, float, float]:
        """Rotation [deg], translation [m] and offset [s] from the truth."""
        d = self.cTl.localCoordinates(values.atPose3(E))
        off = abs(float(values.atVector(D)[0]) - self.time_offset_s)
        return float(np.degrees(np.linalg.norm(d[:3]))), float(np.linalg.norm(d[3:])), off

    def nees(
        self, values: gtsam.Values, covariance: np.ndarray, truth_sigmas: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> float:
        """Squared error of all seven in units of covariance and the truth's own sigmas [rad, m, s]."""
        d = np.append(
            self.cTl.localCoordinates(values.atPose3(E)), values.atVector(D)[0] - self.time_offset_s
        )
        own = np.diag(np.repeat(truth_sigmas, (3, 3, 1)) ** 2)
        return float(d @ np.linalg.solve(covariance + own, d))


def isam2_params() -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(1e-4)
    params.relinearizeSkip = 1
    return params


@cache
def simulated_street(seed: int = 4, frames: int = 24, motion: Motion = "mixed") -> Street:
    """A drive with parked vehicles only, odometry with the noise of a good LiDAR."""
    return stored(("a user's street", seed, frames, motion), lambda: _new_street(seed, frames, motion))


def _new_street(seed: int, frames: int, motion: Motion) -> Street:
    drive = simulated(
        SimulationConfig(
            seed=seed,
            frames=frames,
            motion=motion,
            width=621,
            height=188,
            azimuth_limit_deg=55.0,
            azimuth_step_deg=0.35,
            vehicle_density=0.3,
            moving_fraction=0.0,
            time_offset_s=0.05,
        )
    )
    return _street(drive, drive, VEHICLES, seed)


def _street(
    drive: SimulatedDrive, frames: Iterable[Frame], classes: tuple[SemanticClass, ...], seed: int
) -> Street:
    """What a user has of a drive, from its frames."""
    scans, images = [], []
    for frame in frames:
        assert frame.scan is not None and frame.image is not None
        scan, image = features_of(frame.scan, frame.image, classes, drive.camera)
        scans.append(scan)
        images.append(image)
    rng, stamps = np.random.default_rng(seed), [scan.stamp_ns for scan in scans]
    sigmas = np.repeat([1e-4, 2e-3], 3)
    motions = []
    for a, b in itertools.pairwise(stamps):
        step = drive.wTl(a * 1e-9).between(drive.wTl(b * 1e-9))
        motions.append(
            RelativeMotion(a, b, step.retract(sigmas * rng.standard_normal(6)), np.diag(sigmas**2))
        )
    assert drive.truth.time_offset_s is not None
    truth = drive.truth.cTl, drive.truth.time_offset_s
    config = TermConfig(classes=classes)
    return Street(drive.camera, tuple(scans), tuple(images), tuple(motions), *truth, config)


OBJECTS, BOTH = (SemanticClass.OBJECT,), (SemanticClass.VEHICLE, SemanticClass.OBJECT)


@cache
def street_without_labels(classes: tuple[SemanticClass, ...] = OBJECTS, labelled: int = 0) -> Street:
    """A drive of which the first frames alone have labels."""
    return stored(("a street without labels", classes, labelled), lambda: _without_labels(classes, labelled))


def _without_labels(classes: tuple[SemanticClass, ...], labelled: int) -> Street:
    config = SimulationConfig(
        seed=504, frames=12, motion="no_stop", azimuth_limit_deg=50.0, time_offset_s=0.05, moving_fraction=0.0
    )
    drive = simulated(config)
    frames = [drive[k] if k < labelled else without_labels(drive[k]) for k in range(config.frames)]
    return _street(drive, frames, classes, config.seed)


def without_labels(frame: Frame) -> Frame:
    """The frame as nobody has labelled it."""
    assert frame.scan is not None and frame.image is not None
    nothing = np.full_like(frame.scan.classes, SemanticClass.IGNORE)
    scan = replace(frame.scan, classes=nothing, instances=None)
    mask = np.full_like(frame.image.mask, SemanticClass.IGNORE)
    return replace(frame, scan=scan, image=replace(frame.image, mask=mask, instances=None))
