"""Columns of the assumptions' parameters, through the matches of a drive."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.drive.preparation import Drive
from sst_graph.factors import RobustKernel, residuals
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, edges_of
from sst_graph.graph.state import State

L_TWIST = np.array([0.02, -0.03, 0.2, 5.0, 0.3, -0.1])
OFFSET_S = 0.05


def moving() -> Drive:
    """The standing street as if the LiDAR had turned and driven."""
    drive = prepared_street()
    motions = [
        replace(motion, aTb=gtsam.Pose3.Expmap(motion.seconds * L_TWIST)) for motion in drive.lidar_motions
    ]
    return replace(drive, lidar_motions=tuple(motions))


@pytest.mark.parametrize("known", [{"sweep": -0.5}, {"skew": 0.01}, {"line_delay": 2e-5}])
def test_the_column_of_the_sweep_where_parameters_have_changed_times(known: dict[str, float]) -> None:
    """The points have no times of their own, whatever has been added to their intervals."""
    drive, cTl = moving(), standing_street().truth.cTl
    config = GraphConfig(estimate=("sweep", *(set(known) - {"sweep"})))
    (edges,) = edges_of([drive], motions_of([drive]), config)
    matches = edges.match(State(cTl, (OFFSET_S,), nuisances=known), RobustKernel("geman_mcclure", 5.0))
    assert matches is not None
    x, y, _ = edges.points.lPs[matches.points].T
    later_s = np.arctan2(y, x) / (2.0 * np.pi) * drive.scan_period_s
    twists = matches.c_twists[matches.pair_of].T

    def residuals_at(sweep: float) -> np.ndarray:
        taus_s = matches.alignment.base_taus_s + sweep * later_s
        moved = replace(matches.alignment, base_taus_s=taus_s)
        return residuals(moved, cTl, OFFSET_S, twists, 0.0, jacobians=False)[0]

    derivative = (residuals_at(1e-4) - residuals_at(-1e-4)) / 2e-4
    np.testing.assert_allclose(matches.terms["sweep"], derivative, atol=1e-3)
    assert np.abs(derivative).max() > 0.3
    whole = np.concatenate([own.offsets_s for pair in matches.by_pair() for own in pair.matches.values()])
    assert not whole.any()


def test_a_turn_lasts_as_long_where_every_second_scan_is_used() -> None:
    drive, state = moving(), State(standing_street().truth.cTl, (OFFSET_S,))
    (motion,) = motions_of([drive])
    some = drive.part([0, 2]), motion.part([0, 2])
    periods = []
    for own, own_motion in ((drive, motion), some):
        (edges,) = edges_of([own], [own_motion], GraphConfig())
        matches = edges.match(state, RobustKernel("geman_mcclure", 5.0))
        assert matches is not None
        periods += [pair.scene.period_s for pair in matches.by_pair() if pair.scene is not None]
    assert len(periods) == 5 and len(set(periods)) == 1
