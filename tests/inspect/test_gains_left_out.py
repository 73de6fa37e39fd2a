"""What a frame is said to bring, against the calibration that is solved again without it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from linear_systems import system_of
from scipy.stats import spearmanr
from stored import simulated

from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.factors import RobustKernel
from sst_graph.graph.building import joint_graph, state_from
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import PairMatches, associate
from sst_graph.graph.outer_loop import KERNELS_PX, JointConfig, JointProblem, solve_joint
from sst_graph.graph.state import State
from sst_graph.inspect.frame_gains import frame_gains
from sst_graph.objects.tracks import object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.types import SemanticClass

NOISE = 0.003
"""Relative changes of a sigma that matching again makes, whatever is left out."""


def bits(without: np.ndarray, full: np.ndarray) -> float:
    return float(0.5 * (np.linalg.slogdet(without)[1] - np.linalg.slogdet(full)[1]) / np.log(2.0))


@pytest.mark.slow
def test_bits_and_sigmas_agree_with_leaving_the_frame_out() -> None:
    source = simulated(
        SimulationConfig(
            seed=21,
            frames=42,
            width=621,
            height=188,
            azimuth_limit_deg=55.0,
            azimuth_step_deg=0.35,
            vehicle_density=0.25,
            moving_fraction=0.0,
            time_offset_s=0.05,
        )
    )
    drive = prepare_drive(source, [SemanticClass.VEHICLE], PrepareConfig(use_visual_odometry=False))
    config, objects = JointConfig(), [object_tracks(drive)]
    motions, truth = motions_of([drive], objects), State(source.truth.cTl, (0.05,))
    solution = solve_joint(JointProblem([drive], motions, config), truth)
    frozen = solution.graph, solution.values, solution.pairs, solution.state
    robust = robust_covariance(solution.system, *frozen[1:], objects)
    frames = frame_gains(*frozen, [drive], robust)
    kernel = RobustKernel("geman_mcclure", KERNELS_PX[-1])
    steps = gtsam.GaussNewtonParams()
    steps.setMaxIterations(2)
    # all frames, too, matched again: what is left is due to the frame
    again = associate([drive], motions, solution.state, kernel, config.graph)

    def calibrated(pairs: list[PairMatches]) -> np.ndarray:
        graph, values = joint_graph(pairs, solution.state, config.graph, truth)
        values = gtsam.GaussNewtonOptimizer(graph, values, steps).optimize()
        state = state_from(values, solution.state, pairs)
        return robust_covariance(system_of(graph, values), values, pairs, state, objects).matrix[:7, :7]

    full = calibrated(again)
    claimed, found, ratios = [], [], []
    for pair, frame in zip(solution.pairs, frames, strict=True):
        rest = calibrated([each for each in again if each.pair.image != pair.pair.image])
        claimed.append(frame.bits)
        found.append(bits(rest, full))
        ratios.append(np.sqrt(np.diag(rest) / np.diag(full)))
    claimed, found = np.array(claimed), np.array(found)
    assert len(found) >= 40
    assert spearmanr(claimed, found)[0] > 0.9
    large = np.abs(found) > 0.1  # a change of all sigmas together by 1 % is 0.1 bit
    assert large.sum() > 5
    np.testing.assert_array_equal(np.sign(claimed[large]), np.sign(found[large]))
    predicted, grown = np.array([frame.without for frame in frames]), np.array(ratios)
    for one, other in zip(predicted.T, grown.T, strict=True):
        assert spearmanr(one, other)[0] > 0.8
        large = np.abs(np.log(other)) > NOISE
        assert large.sum() > 20 and np.mean((one > 1.0)[large] == (other > 1.0)[large]) > 0.9
        clear = np.abs(np.log(other)) > 0.01
        np.testing.assert_array_equal((one > 1.0)[clear], (other > 1.0)[clear])
