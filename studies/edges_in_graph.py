"""Alignment terms in a user's graph, by edges, by labels or by both: errors, sigmas, NEES on a real drive.

    OMP_NUM_THREADS=1 python -m studies.edges_in_graph DRIVE             by edges, LM, starts 0 to 2
    OMP_NUM_THREADS=1 python -m studies.edges_in_graph DRIVE --classes vehicle object --solver isam2

The drive is read with ``--image-shift 1``, its reference taken for exact. A start is ``--off`` times 1 deg,
5 cm and 10 ms off in a random direction, the priors as many times 0.01 rad, 3 cm and 10 ms. Errors and sigmas
are in the LiDAR's axes: roll, pitch, yaw [deg]; forward, left, up [cm]; time offset [ms].
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import D, E, X
from numpy.typing import NDArray

from sst_graph import (
    AlignmentKeys,
    AlignmentTerm,
    IncrementalTerms,
    SemanticClass,
    TermConfig,
    Trajectory,
    follow_objects,
    open_source,
    solve_with_terms,
)
from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.metrics import nees
from sst_graph.objects.tracks import scan_poses

FloatArray = NDArray[np.float64]
UNITS = np.array([*[180.0 / np.pi] * 3, 100.0, 100.0, 100.0, 1e3])
SIGMAS = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03, 0.01])
LAG_S = 4.05
Found = tuple[gtsam.Values, FloatArray, bool, list[str]]


@dataclass(frozen=True)
class Problem:
    """A drive, the classes that are aligned, and a start of extrinsic and time offset [s]."""

    drive: Drive
    classes: tuple[SemanticClass, ...]
    cTl: gtsam.Pose3
    time_offset_s: float
    off: float

    def new_at(self, k: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Odometry to scan k; with the first, priors."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(k), scan_poses(self.drive)[k])
        if k:
            motion = self.drive.lidar_motions[k - 1]
            noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), motion.aTb, noise))
            return graph, values
        sigmas = self.off * SIGMAS
        graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
        graph.add(gtsam.PriorFactorPose3(E(0), self.cTl, gtsam.noiseModel.Diagonal.Sigmas(sigmas[:6])))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigmas[6])
        graph.add(gtsam.PriorFactorVector(D(0), np.array([self.time_offset_s]), noise))
        values.insert(E(0), self.cTl)
        values.insert(D(0), np.array([self.time_offset_s]))
        return graph, values

    def terms(self, keys: AlignmentKeys) -> list[AlignmentTerm]:
        """One an image, with the scans around it."""
        found = follow_objects(self.drive.scans, scan_poses(self.drive), self.classes)
        config, terms = TermConfig(classes=self.classes), []
        for k, image in enumerate(self.drive.images):
            near = slice(max(k - 1, 0), k + 4)
            scans, moving = found.features[near], found.l_velocities[near]
            terms.append(AlignmentTerm(scans, image, self.drive.camera, keys, config, moving))
        return terms

    def at_once(self) -> Found:
        """By Levenberg-Marquardt."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        trajectory = Trajectory()
        for k, stamp_ns in enumerate(self.drive.scan_stamps_ns):
            more, starts = self.new_at(k)
            graph.push_back(more)
            values.insert(starts)
            trajectory.append(X(k), stamp_ns)
        found = solve_with_terms(graph, values, self.terms(AlignmentKeys(trajectory, E(0), D(0))))
        return found.values, found.covariance, found.converged, [str(each) for each in found.warnings]

    def frame_by_frame(self, solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother) -> Found:
        """By an incremental solver."""
        trajectory = Trajectory()
        keys = AlignmentKeys(trajectory, E(0), D(0))
        online, terms = IncrementalTerms(solver, keys), self.terms(keys)
        first_ns = self.drive.scan_stamps_ns[0]
        for k, stamp_ns in enumerate(self.drive.scan_stamps_ns):
            trajectory.append(X(k), stamp_ns)
            online.update(*self.new_at(k), terms[k : k + 1], {X(k): 1e-9 * (stamp_ns - first_ns)})
        found = online.converge(20)
        return found.values, found.covariance, found.converged, [str(each) for each in found.warnings]


def solved(problem: Problem, solver: str) -> Found:
    """The estimate, its covariance, whether it converged, warnings."""
    if solver == "lm":
        return problem.at_once()
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e-4)
    parameters.relinearizeSkip = 1
    if solver == "isam2":
        return problem.frame_by_frame(gtsam.ISAM2(parameters))
    return problem.frame_by_frame(gtsam.IncrementalFixedLagSmoother(LAG_S, parameters))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("drive")
    names = [c.name.lower() for c in SemanticClass]
    parser.add_argument("--classes", nargs="+", default=["object"], choices=names)
    parser.add_argument("--solver", default="lm", choices=["lm", "isam2", "smoother"])
    parser.add_argument("--starts", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--off", type=float, default=1.0)
    arguments = parser.parse_args()
    classes = tuple(SemanticClass[name.upper()] for name in arguments.classes)
    source = open_source(arguments.drive, image_shift=1)
    truth = source.truth
    if truth is None or truth.time_offset_s is None:
        parser.error(f"{arguments.drive}: no reference calibration")
    config = PrepareConfig(use_visual_odometry=False)
    drive = prepare_drive(source, classes, config, with_lower_edges=False)
    for seed in arguments.starts:
        rng = np.random.default_rng(seed)
        axes = [axis / np.linalg.norm(axis) for axis in rng.standard_normal((2, 3))]
        step = arguments.off * np.concatenate([np.radians(1.0) * axes[0], 0.05 * axes[1]])
        late_s = arguments.off * 0.01 * float(rng.choice([-1.0, 1.0]))
        begin = truth.cTl.retract(step), truth.time_offset_s + late_s
        problem = Problem(drive, classes, *begin, arguments.off)
        values, covariance, converged, warnings = solved(problem, arguments.solver)
        late = values.atVector(D(0))[0] - truth.time_offset_s
        error = np.append(truth.cTl.localCoordinates(values.atPose3(E(0))), late)
        sizes = np.linalg.norm(error[:3]) * UNITS[0], np.linalg.norm(error[3:6]) * UNITS[3]
        print(f"start {seed}: {sizes[0]:.2f} deg, {sizes[1]:.1f} cm, {error[6] * UNITS[6]:+.1f} ms, ", end="")
        print(f"NEES/7 {nees(error, covariance) / 7.0:.2f}{'' if converged else ', not converged'}")
        print(f"  errors {np.round(error * UNITS, 2)}")
        print(f"  sigmas {np.round(np.sqrt(np.diag(covariance)) * UNITS, 2)}", flush=True)
        for warning in warnings:
            print(f"  {warning}")


if __name__ == "__main__":
    main()
