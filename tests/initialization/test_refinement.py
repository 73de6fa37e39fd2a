"""Candidates refined side by side converge where a graph converges."""

from __future__ import annotations

import gtsam
import numpy as np
from streets import prepared_street, standing_street

from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, edges_of
from sst_graph.graph.outer_loop import KERNELS_PX, JointConfig, JointProblem, solve_joint
from sst_graph.graph.state import State
from sst_graph.initialization.pose_batch import BatchEquations, Poses
from sst_graph.initialization.refinement import RefinementProblem, refine_steps
from sst_graph.stepwise import run_to_end
from sst_graph.types import SemanticClass

JOINT = JointConfig()


def problem(*drives: Drive) -> RefinementProblem:
    edges = edges_of(drives, motions_of(drives), GraphConfig())
    return RefinementProblem.of(edges, GraphConfig())


def refined(drive: Drive, start: Poses) -> Poses:
    """Under all kernels, and some more steps under the last one."""
    return run_to_end(refine_steps(problem(drive), start, start, (*KERNELS_PX, *[KERNELS_PX[-1]] * 8)))


def equations(of: RefinementProblem, poses: Poses, scale_px: float) -> BatchEquations:
    return run_to_end(of.equation_steps(poses, scale_px))


def around(*degrees: tuple[float, float, float]) -> Poses:
    """The truth turned about its own axes, as many poses."""
    truth = standing_street().truth.cTl
    turned = [truth.compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.radians(d)), np.zeros(3))) for d in degrees]
    return Poses(
        np.stack([cTl.rotation().matrix() for cTl in turned]),
        np.stack([cTl.translation() for cTl in turned]),
        np.zeros(len(turned)),
        np.zeros((len(turned), 1)),
    )


def test_starts_lead_to_the_graphs_solution() -> None:
    """Contours as the masks have them."""
    config = PrepareConfig(use_visual_odometry=False, image_edges=False)
    drive = prepare_drive(standing_street(), [SemanticClass.VEHICLE], config)
    start = around((-2.0, 1.0, -1.0), (1.0, 1.0, 0.5), (0.0, 0.0, 0.0))
    poses = refined(drive, start)
    solution = solve_joint(JointProblem.of([drive], JOINT), State(standing_street().truth.cTl)).state.cTl
    for R, t in zip(poses.rotations, poses.translations, strict=True):
        step = solution.between(gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t))
        assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))) < 0.3
        assert np.linalg.norm(step.translation()) < 0.15


def test_starts_lead_where_a_graph_leads() -> None:
    """Contours that follow the picture. From (1, 1, 0.5) degrees both end at a second minimum of roll."""
    turns = ((-2.0, 1.0, -1.0), (-1.5, 1.0, -1.0), (0.0, 0.0, 0.0))
    start = around(*turns)
    poses = refined(prepared_street(), start)
    truth = standing_street().truth.cTl
    for degrees, R, t in zip(turns, poses.rotations, poses.translations, strict=True):
        turned = truth.compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.radians(degrees)), np.zeros(3)))
        solution = solve_joint(JointProblem.of([prepared_street()], JOINT), State(turned)).state.cTl
        step = solution.between(gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t))
        assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))) < 0.3
        assert np.linalg.norm(step.translation()) < 0.15
        assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(truth.between(solution).rotation()))) < 1.0


def test_nothing_in_view_stays_with_its_prior() -> None:
    backwards = around((0.0, 0.0, 180.0))
    far = Poses(
        backwards.rotations,
        backwards.translations + np.array([0.0, 500.0, 0.0]),
        np.zeros(1),
        np.zeros((1, 1)),
    )
    steps = equations(problem(prepared_street()), far, 20.0)
    assert steps.seen[0] == 0.0 and not steps.H.any()
    moved = run_to_end(refine_steps(problem(prepared_street()), far, far, (20.0,)))
    np.testing.assert_allclose(moved.translations, far.translations)


def test_two_drives_have_a_bias_each() -> None:
    both = problem(prepared_street(), prepared_street())
    one, start = problem(prepared_street()), around((1.0, 0.0, 0.0))
    twice = Poses(start.rotations, start.translations, start.offsets, np.zeros((1, 2)))
    assert both.biases == 2
    alone, together = equations(one, start, 10.0), equations(both, twice, 10.0)
    np.testing.assert_allclose(together.H[0, :7, :7], 2.0 * alone.H[0, :7, :7])
    np.testing.assert_allclose(together.g[0, 7:], np.repeat(alone.g[0, 7:], 2))
    assert together.H[0, 7, 8] == 0.0 and together.support[0] == 2.0 * alone.support[0]
