"""Rows of the matches of several pairs, evaluated at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stored import simulated

from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.factors import Alignment, RobustKernel, weighted_residuals
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, PairMatches, associate
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.tracker.sums.rows import PairAt, PairColumns, rows_of_pairs
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE


@pytest.fixture(scope="module")
def matched() -> tuple[list[PairMatches], dict[ObjectId, int], Point]:
    config = SimulationConfig(
        seed=4, frames=3, width=621, height=188, time_offset_s=0.03, azimuth_step_deg=0.35
    )
    street = simulated(config)
    drive = prepare_drive(street, [VEHICLE], PrepareConfig(use_visual_odometry=False))
    tracks, state = object_tracks(drive), State(street.truth.cTl, (0.03,))
    kernel = RobustKernel("geman_mcclure", 3.0)
    pairs = associate([drive], motions_of([drive], [tracks]), state, kernel, GraphConfig())
    return pairs, tracks, Point.unbiased(state.cTl, 0.03, [VEHICLE])


@pytest.mark.parametrize("own_times", [False, True])
def test_rows_of_pairs_are_those_of_each(
    matched: tuple[list[PairMatches], dict[ObjectId, int], Point], own_times: bool
) -> None:
    """Biases are zero: residual and motion columns are those of each pair's own alignment."""
    pairs, tracks, point = matched
    if own_times:
        pairs = [_with_times(pair) for pair in pairs]
    pairs = [_with_velocities(pairs[0]), *pairs[1:]]
    each = []
    for pair in pairs:
        own = {(c, n): track for (k, c, n), track in tracks.items() if k == pair.pair.scan}
        columns = PairColumns([VEHICLE], own)
        each.append(PairAt(pair, point.seen(columns.object_places(pair)), columns))
    for pair, rows in zip(pairs, rows_of_pairs(each), strict=True):
        alignment = pair.matches[VEHICLE].alignment
        r, J, _ = weighted_residuals(alignment, point.cTl, point.time_offset_s, pair.motion.c_twist, 0.0)
        np.testing.assert_allclose(rows.residuals, r, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(rows.J[:, :7], J[:, :7], rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(rows.by_twist, J[:, 7:13], rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(rows.J[:, 7:].sum(axis=1), J[:, 13])
        np.testing.assert_allclose(rows.roots, J[:, 13] * alignment.sigmas_px)


def _with(pair: PairMatches, alignment: Alignment) -> PairMatches:
    matches = replace(pair.matches[VEHICLE], alignment=alignment)
    return replace(pair, matches={VEHICLE: matches})


def _with_times(pair: PairMatches) -> PairMatches:
    alignment = pair.matches[VEHICLE].alignment
    times = np.linspace(-0.05, 0.05, len(alignment))
    return _with(pair, replace(alignment, base_taus_s=alignment.base_taus_s - times))


def _with_velocities(pair: PairMatches) -> PairMatches:
    alignment = pair.matches[VEHICLE].alignment
    velocities = np.random.default_rng(0).normal(0.0, 3.0, (len(alignment), 3))
    return _with(pair, replace(alignment, l_velocities=velocities))
