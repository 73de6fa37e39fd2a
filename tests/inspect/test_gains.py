"""What frames bring, against the covariance computed again from some of the frames."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest
from linear_systems import system_of, unknowns_of
from stored import simulated

from sst_graph.covariance.cluster_robust import covariance_of, robust_covariance
from sst_graph.covariance.error_model import ErrorModel, fit_error_model
from sst_graph.covariance.match_table import MatchTable, match_table
from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.factors import RobustKernel
from sst_graph.graph.building import PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M, joint_graph
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, PairMatches, associate
from sst_graph.graph.state import State
from sst_graph.inspect.frame_gains import frame_gains
from sst_graph.inspect.frame_information import FrameInformation
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.types import SemanticClass

CONFIG = GraphConfig()


@cache
def matched(motion: str) -> tuple[Drive, State, list[PairMatches], list[dict[ObjectId, int]]]:
    """A small drive of three frames, matched at the truth."""
    source = simulated(
        SimulationConfig(
            seed=3, frames=3, width=621, height=188, motion=motion, time_offset_s=0.0, azimuth_step_deg=0.35
        )
    )
    drive = prepare_drive(source, [SemanticClass.VEHICLE], PrepareConfig(use_visual_odometry=False))
    objects = [object_tracks(drive)]
    state = State(source.truth.cTl)
    kernel = RobustKernel("geman_mcclure", 3.0)
    return drive, state, associate([drive], motions_of([drive], objects), state, kernel, CONFIG), objects


@cache
def optimum(motion: str) -> gtsam.Values:
    """Of all frames, their matches as they are."""
    _, state, pairs, _ = matched(motion)
    exact = gtsam.GaussNewtonParams()
    exact.setRelativeErrorTol(0.0)
    exact.setAbsoluteErrorTol(1e-12)
    return gtsam.GaussNewtonOptimizer(*joint_graph(pairs, state, CONFIG), exact).optimize()


@cache
def gains(motion: str) -> tuple[ErrorModel, tuple[FrameInformation, ...]]:
    drive, state, pairs, objects = matched(motion)
    graph, _ = joint_graph(pairs, state, CONFIG)
    robust = robust_covariance(system_of(graph, optimum(motion)), optimum(motion), pairs, state, objects)
    return robust.model, frame_gains(graph, optimum(motion), pairs, state, [drive], robust)


def frozen(motion: str, positions: list[int]) -> tuple[gtsam.NonlinearFactorGraph, np.ndarray, MatchTable]:
    """Graph, bread and matches of some of the frames, at the optimum of all."""
    _, state, pairs, objects = matched(motion)
    some = [pairs[k] for k in positions]
    graph, _ = joint_graph(some, state, CONFIG)
    values = values_of(motion, graph)
    system = system_of(graph, values)
    return graph, system.covariance(), match_table(system, values, some, state, objects)


def values_of(motion: str, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """The optimum of all frames, for the unknowns of a graph."""
    values = gtsam.Values(optimum(motion))
    for key in set(values.keys()) - set(graph.keyVector()):
        values.erase(key)
    return values


def covariance_by_model(motion: str, positions: list[int]) -> np.ndarray:
    """(7, 7) covariance of some of the frames, with the error model of all."""
    _, bread, table = frozen(motion, positions)
    excess = table.scores.excess(gains(motion)[0])
    return np.asarray(bread + bread @ excess @ bread)[:7, :7]


def claimed(motion: str, positions: list[int]) -> np.ndarray:
    """(7, 7) covariance that a calibration from some of the frames claims at its own optimum, one
    Gauss-Newton step away."""
    graph, bread, table = frozen(motion, positions)
    step = graph.linearize(values_of(motion, graph)).optimize()
    table = table.after(np.concatenate([step.at(key) for key in unknowns_of(graph).keys]))
    return covariance_of(bread, table, fit_error_model(table.residuals))[:7, :7]


@pytest.mark.parametrize("motion", ["standing", "constant"])
def test_without_each_frame_and_frame_by_frame(motion: str) -> None:
    _, frames = gains(motion)
    covariance = covariance_by_model(motion, [0, 1, 2])
    sigmas = np.sqrt(np.diag(covariance))
    assert len(frames) == 3
    for k, frame in enumerate(frames):
        whole, rest = claimed(motion, [0, 1, 2]), claimed(motion, [i for i in range(3) if i != k])
        np.testing.assert_allclose(frame.without, np.sqrt(np.diag(rest) / np.diag(whole)), rtol=1e-4)
        bits = 0.5 * (np.linalg.slogdet(rest)[1] - np.linalg.slogdet(whole)[1]) / np.log(2.0)
        assert frame.bits == pytest.approx(bits, abs=1e-3)
        first = covariance_by_model(motion, list(range(k + 1)))
        np.testing.assert_allclose(frame.so_far, np.sqrt(np.diag(first)) / sigmas, rtol=1e-6)
    np.testing.assert_allclose(frames[-1].so_far, 1.0, rtol=1e-9)


@pytest.mark.parametrize("motion", ["standing", "constant"])
def test_a_view_is_the_frame_alone(motion: str) -> None:
    for k, frame in enumerate(gains(motion)[1]):
        priors = np.diag(np.repeat([PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M], 3) ** -2.0)
        alone = covariance_by_model(motion, [k])
        given_offset = np.linalg.inv(np.linalg.inv(alone)[:6, :6])
        found = np.linalg.inv(frame.view + priors)
        ratio = np.sqrt(np.diag(found) / np.diag(given_offset))
        # The sandwich with the offset held differs a little from the sandwich's conditional.
        np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_the_offset_follows_from_the_twist() -> None:
    _, state, pairs, objects = matched("constant")
    graph, values = joint_graph(pairs, state, CONFIG)
    table = match_table(system_of(graph, values), values, pairs, state, objects)
    start = 0
    for pair, frame in zip(pairs, gains("constant")[1], strict=True):
        J = table.J[start : start + len(pair)].toarray()
        start += len(pair)
        # Up to the acceleration that odometry sees in a constant motion.
        assert np.abs(J[:, 6] + J[:, :6] @ frame.l_twist).max() < 0.05 * np.abs(J[:, 6]).max()
        assert frame.speed > 3.0


def test_what_is_said_of_a_scene() -> None:
    drive, _, pairs, _ = matched("standing")
    for pair, frame in zip(pairs, gains("standing")[1], strict=True):
        (matches,) = pair.matches.values()
        assert (frame.frame.drive, frame.frame.frame) == (drive.name, drive.scans[pair.pair.scan].index)
        assert frame.matches == len(pair) and frame.objects == len(set(matches.objects.tolist()))
        assert frame.nearest_m == pytest.approx(min(np.linalg.norm(p) for p in matches.alignment.lPs))
        assert frame.left == pytest.approx(np.mean(matches.alignment.pixels[:, 0] < drive.camera.cx))
        assert frame.speed < 0.05
