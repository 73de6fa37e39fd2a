"""Edges towards the ground: kept apart, and matched only where the labels agree about them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.batch.config import UseLowerEdges
from sst_graph.batch.lower_edges import MIN_CONCENTRATION, lower_edge_support, with_lower_edges
from sst_graph.drive.preparation import Drive, image_features
from sst_graph.features.lidar_edges import Edge
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import associate
from sst_graph.graph.outer_loop import (
    NARROW_KERNELS_PX,
    JointConfig,
    JointProblem,
    JointSolution,
    solve_joint,
)
from sst_graph.graph.state import State
from sst_graph.types import CameraImage, SemanticClass

VEHICLE = SemanticClass.VEHICLE
JOINT = JointConfig(min_matches=10)


@cache
def street(shadow_px: int = 0) -> Drive:
    """The standing street; its masks go on below every vehicle, as if a shadow were part of it."""
    drive = prepared_street()
    images = []
    for image in drive.images:
        mask = image.mask.copy()
        for _ in range(shadow_px):
            below = np.zeros(mask.shape, dtype=bool)
            below[1:] = mask[:-1] == VEHICLE
            mask[below] = VEHICLE
        blank = np.zeros((*mask.shape, 3), np.uint8)
        images.append(image_features(image.index, CameraImage(image.stamp_ns, mask, blank), [VEHICLE]))
    return replace(drive, images=tuple(images))


def solved(drive: Drive) -> tuple[JointSolution, State]:
    start = State(standing_street().truth.cTl)
    return solve_joint(JointProblem.of([drive], JOINT), start, NARROW_KERNELS_PX), start


def test_edges_towards_the_ground_are_kept_apart() -> None:
    for scan in prepared_street().scans:
        assert Edge.BOTTOM not in scan.boundaries[VEHICLE].edges
        below = scan.lower_edges[VEHICLE]
        assert len(below) > 20 and (below.edges == Edge.BOTTOM).all()
        assert np.isin(below.objects, scan.boundaries[VEHICLE].objects).all()


def test_matched_where_they_are_asked_for() -> None:
    drive, motions = prepared_street(), motions_of([prepared_street()])
    state, kernel = (
        State(standing_street().truth.cTl),
        solved(drive)[0].pairs[0].matches[VEHICLE].alignment.kernel,
    )
    without = associate([drive], motions, state, kernel, JOINT.graph)
    graph = replace(JOINT.graph, lower_edges=(VEHICLE,))
    for few, many in zip(without, associate([drive], motions, state, kernel, graph), strict=True):
        assert not (few.matches[VEHICLE].sides == 3).any()
        assert (many.matches[VEHICLE].sides == 3).sum() > 10
        assert (many.matches[VEHICLE].sides < 3).sum() >= len(few)


def test_used_where_the_labels_agree() -> None:
    drive = street()
    below = with_lower_edges(JointProblem([drive], motions_of([drive]), JOINT), [solved(drive)], "auto")
    assert below.joint.graph.lower_edges == (VEHICLE,)
    assert below.concentration[VEHICLE] > MIN_CONCENTRATION
    truth = standing_street().truth.cTl
    off = [
        np.linalg.norm(truth.localCoordinates(s.state.cTl)[:3])
        for s in (solved(drive)[0], below.solutions[0])
    ]
    assert off[1] < off[0]


@pytest.mark.parametrize("use", ["auto", "never", "always"])
def test_left_out_where_the_shadow_belongs_to_the_mask(use: UseLowerEdges) -> None:
    drive = street(shadow_px=5)
    one, centre = solved(drive)
    motions = motions_of([drive])
    shares = lower_edge_support([drive], motions, one.state, JOINT).agreed(use)[1]
    assert shares[VEHICLE] < MIN_CONCENTRATION
    below = with_lower_edges(JointProblem([drive], motions, JOINT), [(one, centre)], use)
    if use == "always":
        assert below.joint.graph.lower_edges == (VEHICLE,)
    else:
        assert below.solutions[0] is one and below.joint == JOINT


def test_too_few_say_nothing() -> None:
    drive = street()
    one, _ = solved(drive)
    assert (
        lower_edge_support([drive], motions_of([drive]), one.state, JOINT).agreed("auto", min_support=1e6)[1]
        == {}
    )
