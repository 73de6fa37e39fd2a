"""How far fused marginals lie from the joint estimate, by how much two drives disagree.

Two synthetic drives of six frames (80 silhouette matches each, sigma 3 px, Geman-McClure kernel, twists and
a mask bias free), the second's calibration set apart from the first's by so many sigmas. Prints medians over
six pairs.

    python studies/marginal_disagreement.py
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.export import CalibrationMarginal, fuse_graphs, fuse_marginals, marginal_of_graph
from sst_graph.factors import (
    Alignment,
    PinholeCamera,
    RobustKernel,
    frame_factor,
    time_offset_prior,
    velocity_factor,
)
from sst_graph.types import Calibration

FloatArray = NDArray[np.float64]
E, D = gtsam.symbol("E", 0), gtsam.symbol("D", 0)
CAMERA = PinholeCamera(718.0, 700.0, 607.0, 185.0, 1242, 375)
FORWARD = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
RIG = gtsam.Pose3(FORWARD, np.array([0.06, -0.08, -0.27]))
ROUNDS = 3
"""How often marginals are taken again at the fused estimate."""


def drive(
    seed: int, cTl: gtsam.Pose3, time_offset_s: float
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A drive whose matches fit a calibration, solved."""
    rng = np.random.default_rng(seed)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.symbol("B", seed)
    for k in range(6):
        lPs = np.stack([rng.uniform(6, 40, 80), rng.uniform(-6, 6, 80), rng.uniform(-2, 1, 80)], axis=1)
        twist = rng.normal(0.0, 1.0, 6) * [0.3, 0.5, 0.2, 1.0, 0.5, 6.0]
        moved = gtsam.Pose3.Expmap(-(time_offset_s - 0.02) * twist) * cTl
        pixels = CAMERA.project(moved.transformFrom(lPs.T).T) + rng.normal(0.0, 3.0, (80, 2))
        angles, seen = rng.uniform(0.0, 2.0 * np.pi, 80), np.isfinite(pixels).all(axis=1)
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        kernel, base_tau = RobustKernel("geman_mcclure", 5.0), np.full(np.count_nonzero(seen), -0.02)
        sigmas = np.full(len(base_tau), 3.0)
        matches = Alignment(CAMERA, lPs[seen], base_tau, pixels[seen], sigmas, normals[seen], kernel)
        V = gtsam.symbol("V", 1000 * seed + k)
        graph.add(frame_factor([matches], E, D, V, bias))
        graph.add(velocity_factor(V, twist + rng.normal(0.0, 0.02, 6), 4e-4 * np.eye(6)))
        values.insert(V, twist)
    graph.add(time_offset_prior(bias, 0.0, 1.0))
    graph.add(gtsam.PriorFactorPose3(E, cTl, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    graph.add(time_offset_prior(D, time_offset_s, 1.0))
    values.insert(bias, np.zeros(1))
    values.insert(E, cTl)
    values.insert(D, np.array([time_offset_s]))
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def pair(seed: int, apart: float) -> tuple[float, list[float]]:
    """How far the two drives' estimates lie apart [sigmas of their difference], and by how many sigmas of the
    joint estimate the fused marginals miss it: each taken at its own estimate, then again, round by round."""
    rng = np.random.default_rng(100 + seed)
    graph_1, values_1 = drive(2 * seed + 1, RIG, 0.1)
    C_1 = _covariance(graph_1, values_1)
    way = rng.standard_normal(7)
    step = np.sqrt(2.0) * apart * np.linalg.cholesky(C_1) @ (way / np.linalg.norm(way))
    graph_2, values_2 = drive(2 * seed + 2, RIG.retract(step[:6]), 0.1 + step[6])
    one, other = (Calibration(v.atPose3(E), float(v.atVector(D)[0])) for v in (values_1, values_2))
    distance = _length(one.local_coordinates(other), C_1 + _covariance(graph_2, values_2))
    graphs = [(graph_1, values_1), (graph_2, values_2)]
    joint, _ = fuse_graphs(graphs, E, D, significance=0.0)
    fused = fuse_marginals(
        [marginal_of_graph(graph, values, E, D) for graph, values in graphs], significance=0.0
    )
    misses = [_miss(joint, fused)]
    for _ in range(ROUNDS):
        again = [marginal_of_graph(graph, values, E, D, at=fused.at) for graph, values in graphs]
        fused = fuse_marginals(again, significance=0.0)
        misses.append(_miss(joint, fused))
    return distance, misses


def _covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> FloatArray:
    found = np.asarray(gtsam.Marginals(graph, values).jointMarginalCovariance([E, D]).fullMatrix())
    return 0.5 * (found + found.T)


def _length(step: FloatArray, covariance: FloatArray) -> float:
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))


def _miss(joint: CalibrationMarginal, fused: CalibrationMarginal) -> float:
    step = joint.at.local_coordinates(fused.at)
    return float(np.sqrt(step @ joint.information @ step))


def main() -> None:
    print("| drives apart | at their own estimates |" + "".join(f" round {k + 1} |" for k in range(ROUNDS)))
    print("|---" * (2 + ROUNDS) + "|")
    for apart in (0.0, 2.0, 4.0, 8.0, 16.0):
        found = [pair(seed, apart) for seed in range(6)]
        misses = np.median([misses for _, misses in found], axis=0)
        cells = " | ".join(f"{miss:.4f}" for miss in misses)
        print(f"| {np.median([distance for distance, _ in found]):.1f} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
