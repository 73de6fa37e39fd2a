"""The sums that a tracker fills frame by frame, against the batch's from the same matches."""

from __future__ import annotations

import numpy as np
import pytest
from linear_systems import system_of
from numpy.typing import NDArray
from stored import simulated

from sst_graph.covariance.cluster_robust import (
    RobustCovariance,
    robust_covariance,
    steps_without_objects,
)
from sst_graph.covariance.image_shifts import columns_by_image, shifts_of
from sst_graph.covariance.jackknife import ObjectSpread, composed
from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.factors import RobustKernel
from sst_graph.graph.building import joint_graph
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.linear import unit_scale
from sst_graph.graph.matching import GraphConfig, PairMatches, associate
from sst_graph.graph.state import EXTRINSIC, State, bias_key, object_bias_key, time_offset_key
from sst_graph.objects.tracks import object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.tracker.monitor.statistic import ChangeStatistic, ComparedEstimate, EstimateCovariance
from sst_graph.tracker.sums.linearized_pair import LinearizedPair, linearize_pairs
from sst_graph.tracker.sums.rows import PairColumns
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import SemanticClass

VEHICLE, CONFIG, OFFSET_S = SemanticClass.VEHICLE, GraphConfig(), 0.03


@pytest.fixture(scope="module")
def matched() -> tuple[RobustCovariance, list[PairMatches], Point, list[LinearizedPair]]:
    """The batch's covariance of six frames at the truth, and the same frames as a tracker linearizes them."""
    street = simulated(
        SimulationConfig(
            seed=4,
            frames=6,
            width=621,
            height=188,
            motion="no_stop",
            time_offset_s=OFFSET_S,
            azimuth_step_deg=0.35,
        )
    )
    drive = prepare_drive(street, [VEHICLE], PrepareConfig(use_visual_odometry=False))
    tracks, state = object_tracks(drive), State(street.truth.cTl, (OFFSET_S,))
    kernel = RobustKernel("geman_mcclure", 3.0)
    pairs = associate([drive], motions_of([drive], [tracks]), state, kernel, CONFIG)
    graph, values = joint_graph(pairs, state, CONFIG)
    robust = robust_covariance(system_of(graph, values), values, pairs, state, [tracks])
    seen = {t: 0 for pair in pairs for t in pair.tracks[VEHICLE].tolist()}
    point = Point.unbiased(state.cTl, OFFSET_S, [VEHICLE]).seen(seen)
    named = [{(c, n): track for (k, c, n), track in tracks.items() if k == pair.pair.scan} for pair in pairs]
    linear = linearize_pairs(pairs, point, [PairColumns([VEHICLE], own) for own in named])
    return robust, pairs, point, linear


def _columns(robust: RobustCovariance, point: Point) -> NDArray[np.intp]:
    """Of the batch's unknowns, among those of the tracker."""
    keys = [bias_key(0, VEHICLE), *(object_bias_key(0, track) for track in point.tracks)]
    places = [7, *range(point.core_size, point.size)]
    found = dict(
        zip([EXTRINSIC, time_offset_key(), *keys], [[*range(6)], [6], *([p] for p in places)], strict=True)
    )
    return np.array([column for key in robust.unknowns.keys for column in found[key]])


def _parted(
    point: Point, linear: list[LinearizedPair], left: int
) -> tuple[RunningSums, list[LinearizedPair], list[NDArray[np.intp]]]:
    """Sums of the frames that have left, those of the window, and the columns of these."""
    sums, columns = RunningSums.empty(point.size), [point.columns(p.information.point.tracks) for p in linear]
    for scan in range(left):
        sums.add(linear[scan], columns[scan], scan)
    return sums, linear[left:], columns[left:]


@pytest.mark.parametrize("left", [0, 3, 6])
def test_the_sums_are_the_batch_s(
    matched: tuple[RobustCovariance, list[PairMatches], Point, list[LinearizedPair]], left: int
) -> None:
    """Wherever the frames are: in the window, or gone from it."""
    robust, _, point, linear = matched
    columns, (sums, window, own) = _columns(robust, point), _parted(point, linear, left)
    model = sums.error_model(window)
    np.testing.assert_allclose(
        [model.side, model.side_frame, model.match],
        [robust.model.side, robust.model.side_frame, robust.model.match],
        rtol=1e-9,
    )
    whole = sums.with_pairs(window, own)
    excess = whole.excess(model)[np.ix_(columns, columns)]
    expected = robust.table.scores.excess(robust.model)
    scale = unit_scale(expected) * (np.diag(expected) > 0.0)
    np.testing.assert_allclose(excess * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-9)
    ratio = whole.weight_curvature_ratio
    assert ratio == pytest.approx(robust.table.weight_curvature_ratio, rel=1e-9)
    # The whole covariance, given that of independent matches: with the batch's jackknife the same, with the
    # tracker's nearly. There an object's matches have no columns of other objects' biases, which the twist of
    # their image ties to them.
    naive = np.eye(point.size)
    naive[np.ix_(columns, columns)] = robust.bread
    objects = [pair.objects for pair in window if pair.objects is not None]
    spread = sums.objects.spread(objects, naive, point)
    steps = steps_without_objects(robust.table, robust.bread)
    of_batch = ObjectSpread.of(steps, robust.table.object_weights)
    assert spread.number == pytest.approx(of_batch.number, rel=1e-9)
    by_model = naive + naive @ whole.excess(model) @ naive
    exact = composed(by_model[np.ix_(columns, columns)], of_batch, ratio)[:7, :7]
    found = composed(by_model, spread, ratio)[:7, :7]
    sigmas = np.sqrt(np.diag(robust.matrix)[:7])
    batch, both = robust.matrix[:7, :7], np.outer(sigmas, sigmas)
    np.testing.assert_allclose(exact / both, batch / both, atol=1e-8)
    np.testing.assert_allclose(found / both, batch / both, atol=0.02)


@pytest.mark.parametrize("left", [0, 3, 6])
def test_shifts_from_image_to_image_are_the_batch_s(
    matched: tuple[RobustCovariance, list[PairMatches], Point, list[LinearizedPair]], left: int
) -> None:
    robust, pairs, point, linear = matched
    columns, (sums, window, own) = _columns(robust, point), _parted(point, linear, left)
    whole = sums.with_pairs(window, own)
    state = State(point.cTl, (OFFSET_S,))
    values = joint_graph(pairs, state, CONFIG)[1]
    by_image = columns_by_image(robust.table, pairs, values, state)
    batch = shifts_of(robust.table, robust.bread, *by_image)
    assert batch.sigmas.max() > 0.0
    np.testing.assert_allclose(np.sqrt(whole.shift_variances), batch.sigmas, rtol=1e-7)
    found = robust.bread @ whole.shift_excess[:, columns[:, None], columns] @ robust.bread
    scale = unit_scale(batch.covariance)
    np.testing.assert_allclose(
        found * np.outer(scale, scale), batch.parts * np.outer(scale, scale), atol=1e-7
    )


def test_parts_of_frames_are_compared_as_each_by_itself(
    matched: tuple[RobustCovariance, list[PairMatches], Point, list[LinearizedPair]],
) -> None:
    _, _, point, linear = matched
    model = RunningSums.empty(point.size).error_model(linear)
    covariance = EstimateCovariance(1e-6 * np.eye(point.size), point.tracks, point.core_size)
    known = ComparedEstimate(point, covariance, model)
    statistic, n = ChangeStatistic(25.0, 0.5), len(linear)
    parts = [(0, 2), (2, n), (n - 3, n), (1, n - 1)]
    alone = [statistic.normalized(statistic.compare(linear[a:b], known)) for a, b in parts]
    assert len({round(value, 6) for value in alone}) == len(parts)
    for part, value in zip(parts, alone, strict=True):
        assert statistic.largest_of_parts(linear, [part], known) == (pytest.approx(value, rel=1e-9), part)
    largest = (pytest.approx(max(alone), rel=1e-9), parts[int(np.argmax(alone))])
    assert statistic.largest_of_parts(linear, parts, known) == largest
    assert statistic.largest_of_parts(linear, [(1, 1)], known) == (0.0, (0, 0))
