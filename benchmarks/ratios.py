"""The hot paths beside the same work done otherwise, as ratios of one run. Prints a Markdown table.

    OMP_NUM_THREADS=1 python -m benchmarks.ratios

Linearization: a frame's factor (5,000 points, 1,500 pixels) and the normal equations of a whole drive.
Matching: nearest pixels and points of a frame, contours of a whole drive. Beside them: one factor a match;
what scipy needs (``least_squares`` with one evaluation of residuals and Jacobian written in plain NumPy,
robust weights included; for matching KD-trees); a fused loop compiled by numba (extra ``bench``). All give
the same result, which is checked first. That of the compiled loop is what the package hands on, too: gtsam's
linear factor, normal equations, checked matches; what of its time the loop itself takes has a column of its
own. The ways take turns, and the least time of many calls counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from benchmarks.compiled import CompiledEdges, CompiledFrame, CompiledNearest, CompiledProblem
from benchmarks.test_alignment_speed import single_match_factor
from benchmarks.workloads import (
    C_TWIST,
    KERNEL,
    POSE,
    TIME_OFFSET_S,
    D,
    DriveWork,
    E,
    V,
    best_seconds,
    class_view,
    frame_matches,
    frame_values,
    street,
)
from sst_graph.association.edge_matching import match_edges
from sst_graph.association.nearest import match_nearest
from sst_graph.experiments import markdown
from sst_graph.experiments.markdown import NONE
from sst_graph.factors import Alignment, frame_factor, silhouette_factor
from sst_graph.factors.motion import se3_left_jacobian
from sst_graph.graph.building import motion_factor, prior_graph
from sst_graph.graph.frozen_problem import FrozenProblem
from sst_graph.graph.state import EXTRINSIC, object_bias_key, time_offset_key, twist_key

FloatArray = NDArray[np.float64]
Ways = dict[str, Callable[[], object]]
OURS, SINGLE, SCIPY, COMPILED = "ours", "one factor a match", "scipy", "compiled loop"
LOOP = "the loop alone"


def plain_residuals(
    alignment: Alignment, cTl: gtsam.Pose3, tau_s: float, c_twist: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted residuals (n, 2) and Jacobian (n, 2, 13) of point-to-pixel matches, as one writes them for
    scipy."""
    moved = gtsam.Pose3.Expmap(-tau_s * c_twist) * cTl
    R, camera = moved.rotation().matrix(), alignment.camera
    cPs = alignment.lPs @ R.T + moved.translation()
    r = (camera.project(cPs) - alignment.pixels) / alignment.sigmas_px[:, None]
    skew = np.zeros((len(cPs), 3, 3))
    skew[:, [2, 0, 1], [1, 2, 0]], skew[:, [1, 2, 0], [2, 0, 1]] = cPs, -cPs
    cP_H_left = np.concatenate([-skew, np.broadcast_to(np.eye(3), skew.shape)], axis=2)
    left = se3_left_jacobian(-tau_s * c_twist)
    by_offset = -(left @ c_twist)[:, None]
    J = camera.uv_H_cP(cPs) @ (cP_H_left @ np.hstack([moved.AdjointMap(), by_offset, -tau_s * left]))
    w = 1.0 / (1.0 + (r * r).sum(axis=1) / alignment.kernel.scale**2)
    return w[:, None] * r, (w / alignment.sigmas_px)[:, None, None] * J


def frame_ways() -> Ways:
    """Linearization of a frame."""
    frame, values = [frame_matches(0, 5000), frame_matches(1, 1500)], frame_values()
    factor, compiled, graph = frame_factor(frame, E, D, V), CompiledFrame(frame), gtsam.NonlinearFactorGraph()
    for alignment in frame:
        for i in range(len(alignment)):
            graph.add(single_match_factor(alignment, i))

    def by_scipy() -> object:
        parts = [plain_residuals(each, POSE, TIME_OFFSET_S, C_TWIST) for each in frame]
        r = np.concatenate([r.reshape(-1) for r, _ in parts])
        J = np.concatenate([J.reshape(-1, 13) for _, J in parts])
        return least_squares(lambda x: r, np.zeros(13), lambda x: J, max_nfev=1)

    fused = compiled.factor(E, D, V)
    system = factor.linearize(values).augmentedInformation()
    near = {"atol": 1e-9 * np.abs(system).max()}
    np.testing.assert_allclose(fused.linearize(values).augmentedInformation(), system, **near)
    np.testing.assert_allclose(fused.error(values), factor.error(values), rtol=1e-9)
    solution = by_scipy()
    np.testing.assert_allclose(solution.jac.T @ solution.jac, system[:13, :13], **near)
    np.testing.assert_allclose(solution.grad, -system[:13, 13], **near)
    return {
        OURS: lambda: factor.linearize(values),
        SINGLE: lambda: graph.linearize(values),
        SCIPY: by_scipy,
        COMPILED: lambda: fused.linearize(values),
        LOOP: lambda: compiled.alone(POSE, TIME_OFFSET_S, C_TWIST),
    }


def nearest_ways() -> Ways:
    """Nearest pixels of 5,000 points and nearest points of 1,500 pixels."""
    view = class_view(5000, 1500)
    compiled = CompiledNearest(view)
    w = view.nearest.index.shape[1]
    own = np.unique(view.nearest.index)
    tree = cKDTree(np.stack([own % w, own // w], axis=1).astype(np.float64))

    def by_scipy() -> tuple[FloatArray, FloatArray, FloatArray]:
        cPs = view.lPs @ POSE.rotation().matrix().T + POSE.translation()
        cPs -= (TIME_OFFSET_S + view.base_tau_s) * C_TWIST[3:]
        on = view.camera.in_front(cPs)
        uvs = view.camera.project(cPs)
        on &= view.camera.in_image(uvs)
        lPs, uvs = view.lPs[on], uvs[on]
        pixels = tree.data[tree.query(np.rint(uvs))[1]]
        return lPs, pixels, lPs[cKDTree(uvs).query(view.pixels)[1]]

    ours = match_nearest(view, POSE, TIME_OFFSET_S, C_TWIST, 5.0)
    assert ours is not None and ours.pixel_to_point is not None
    matched = ours.point_to_pixel.lPs, ours.point_to_pixel.pixels, ours.pixel_to_point.lPs
    fused = compiled.match(POSE, TIME_OFFSET_S, C_TWIST, 5.0)
    for one, other in zip(ours.alignments, fused.alignments, strict=True):
        for name in ("lPs", "pixels", "weights"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-9)
    points, pixels, nearest = by_scipy()
    np.testing.assert_allclose(points, matched[0])
    np.testing.assert_allclose(nearest, matched[2])
    centres = np.rint(view.camera.project(_moved_by_translation(points)))
    both = [np.linalg.norm(centres - each, axis=1) for each in (pixels, matched[1])]
    np.testing.assert_allclose(*both, atol=1e-9)  # of equally near pixels either may be named
    return {
        OURS: lambda: match_nearest(view, POSE, TIME_OFFSET_S, C_TWIST, 5.0),
        SCIPY: by_scipy,
        COMPILED: lambda: compiled.match(POSE, TIME_OFFSET_S, C_TWIST, 5.0),
        LOOP: lambda: compiled.alone(POSE, TIME_OFFSET_S, C_TWIST),
    }


def _moved_by_translation(lPs: FloatArray) -> FloatArray:
    return lPs @ POSE.rotation().matrix().T + POSE.translation() - TIME_OFFSET_S * C_TWIST[3:]


def single_graph(work: DriveWork) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The problem of a drive with a factor for each match."""
    state, matches = work.state, work.matches
    classes = [(0, c) for c in matches.classes]
    graph, values = prior_graph(classes, sorted(matches.tracked), state, work.edges.config)
    for pair in matches.by_pair():
        keys = EXTRINSIC, time_offset_key(0), twist_key(0, pair.pair.image)
        values.insert(keys[2], pair.motion.c_twist)
        graph.add(motion_factor(pair, *keys, state.cTl, state.time_offset_s(0)))
        for c, found in pair.matches.items():
            for i, track in enumerate(pair.tracks[c].tolist()):
                one = found.alignment.take(np.array([i]))
                graph.add(silhouette_factor(one, *keys, object_bias_key(0, track)))
    return graph, values


def scipy_drive(problem: FrozenProblem) -> Callable[[], object]:
    """One evaluation by ``least_squares`` of a drive's matches: dense rows in a sparse Jacobian."""
    point, frames = problem.start, problem._frames[0]
    alignment, camera = frames.alignment, frames.alignment.camera
    n, f = len(point.scalars) + 6, len(point.twists)
    each = np.broadcast_to(alignment.c_acceleration, (len(alignment), 6))
    rows = np.repeat(np.arange(len(alignment)), 14)
    columns = np.empty((len(alignment), 14), np.intp)
    columns[:, :6], columns[:, 6], columns[:, 13] = np.arange(6), frames.clock, frames.biases
    columns[:, 7:13] = n + 6 * frames.images[:, None] + np.arange(6)

    def evaluated() -> object:
        r, J = np.empty(len(alignment)), np.empty((len(alignment), 14))
        for image, a, b in frames.spans:
            tau_s = float(point.scalars[frames.clock - 6] + alignment.base_taus_s[a])
            xi = -tau_s * (point.twists[image] - 0.5 * tau_s * each[a])
            moved = gtsam.Pose3.Expmap(xi) * point.cTl
            cPs = alignment.lPs[a:b] @ moved.rotation().matrix().T + moved.translation()
            normals, left = alignment.normals[a:b], se3_left_jacobian(xi)
            r[a:b] = ((camera.project(cPs) - alignment.pixels[a:b]) * normals).sum(axis=1)
            g = (normals[:, None, :] @ camera.uv_H_cP(cPs))[:, 0]
            by_left = np.hstack([np.cross(cPs, g), g])
            rate = point.twists[image] - tau_s * each[a]
            J[a:b, :6], J[a:b, 6] = by_left @ moved.AdjointMap(), -by_left @ left @ rate
            J[a:b, 7:13], J[a:b, 13] = -tau_s * by_left @ left, 1.0
        r += point.scalars[frames.biases - 6]
        w = np.sqrt(alignment.weights) / alignment.sigmas_px
        w /= 1.0 + (r / (alignment.sigmas_px * alignment.kernel.scale)) ** 2
        r, J = w * r, w[:, None] * J
        sparse = coo_array((J.reshape(-1), (rows, columns.reshape(-1))), (len(r), n + 6 * f)).tocsr()
        return least_squares(lambda x: r, np.zeros(n + 6 * f), lambda x: sparse, max_nfev=1)

    return evaluated


def drive_ways(work: DriveWork) -> Ways:
    """Normal equations of a drive."""
    problem, config = work.problem, work.edges.config
    compiled = CompiledProblem([work.matches], work.state, config)
    graph, values = single_graph(work)
    by_scipy, point = scipy_drive(problem), problem.start
    ours, theirs = problem.linearized(point), compiled.linearized(point)
    for one, other in zip(vars(ours).values(), vars(theirs).values(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(one).max())
    H, _ = graph.linearize(values).hessian(problem.ordering)
    n = len(ours.g)
    np.testing.assert_allclose(H[:n, :n], ours.H, atol=1e-8 * np.abs(H).max())
    J = by_scipy().jac
    added = ours.H_mixed - replace_matches(problem, point)
    np.testing.assert_allclose((J.T @ J).toarray()[n:, :n], added.reshape(-1, n), atol=1e-9 * np.abs(H).max())
    return {
        OURS: lambda: problem.linearized(point),
        SINGLE: lambda: graph.linearize(values),
        SCIPY: by_scipy,
        COMPILED: lambda: compiled.linearized(point),
    }


def replace_matches(problem: FrozenProblem, point: object) -> FloatArray:
    """What the odometry alone adds to H_mixed."""
    alone = FrozenProblem.__new__(FrozenProblem)
    vars(alone).update(vars(problem), _frames=[])
    return alone.linearized(point).H_mixed


def edge_ways(work: DriveWork) -> Ways:
    """Contours of a drive's boundary points."""
    state, config = work.state, work.edges.config
    paired = work.edges.paired(state)
    assert paired is not None
    paired = replace(paired, velocities=None)
    at = state.calibration()
    compiled = CompiledEdges(paired, KERNEL, config)
    ours, fused = match_edges(paired, at, KERNEL, config), compiled.match(*at)
    for name in ("index", "sides", "bounds", "seen"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(fused, name))
    for name in ("lPs", "base_taus_s", "c_acceleration", "pixels", "normals", "sigmas_px", "weights"):
        each = (getattr(matches.alignment, name) for matches in (ours, fused))
        np.testing.assert_allclose(*each, atol=1e-3)
    return {
        OURS: lambda: match_edges(paired, at, KERNEL, config),
        COMPILED: lambda: compiled.match(*at),
        LOOP: lambda: compiled.alone(*at),
    }


def table(rows: Sequence[tuple[str, Ways]], rounds: int) -> str:
    others = SINGLE, SCIPY, COMPILED, LOOP
    found = []
    for name, ways in rows:
        slow = {key: ways[key] for key in ways if key == SINGLE}
        took = best_seconds({key: ways[key] for key in ways if key not in slow}, rounds)
        took |= {key: best_seconds({key: way}, 3)[key] for key, way in slow.items()}
        cells = [f"{took[key] / took[OURS]:.3g}" if key in took else NONE for key in others]
        ratio = took[OURS] / took[COMPILED]
        found.append([name, f"{1e3 * took[OURS]:.2f}", *cells, f"{ratio:.2f}"])
    return markdown.table(f"| | ours [ms] | {' | '.join(others)} | ours / {COMPILED} |", found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, nargs="+", default=[20], help="of each drive")
    parser.add_argument("--rounds", type=int, default=40, help="turns, of which the best counts")
    args = parser.parse_args()
    rows = [
        ("linearize a frame: 5,000 points, 1,500 pixels", frame_ways()),
        ("match a frame: 5,000 points, 1,500 pixels", nearest_ways()),
    ]
    for frames in args.frames:
        work = DriveWork.of(street(frames, width=1242, height=375, moving_fraction=0.0))
        rows += [
            (f"linearize a drive: {len(work.matches):,} matches in {frames} frames", drive_ways(work)),
            (f"match a drive: {len(work.edges):,} boundary points", edge_ways(work)),
        ]
    print(table(rows, args.rounds))


if __name__ == "__main__":
    main()
