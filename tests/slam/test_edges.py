"""Terms of scans and pictures without labels, alone and beside labels, in every solver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from alignment_streets import BOTH, OBJECTS, D, E, Street, isam2_params, street_without_labels

from sst_graph import AlignmentKeys, AlignmentTerm, TermConfig, follow_objects, open_source, solve_with_terms
from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.objects.tracks import scan_poses
from sst_graph.slam.align import EDGE_KERNEL_PX, EDGE_KERNEL_SHARE
from sst_graph.slam.alignment_keys import POSITIONS
from sst_graph.slam.covariance import TermSums, calibration_covariance, rows_of
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.solving import RematchSolution
from sst_graph.slam.term_warnings import WarningKind, far_from_start
from sst_graph.types import SemanticClass

STOP = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti_2011_09_26_stop"
OBJECT, VEHICLE = SemanticClass.OBJECT, SemanticClass.VEHICLE
NEAR = (0.05, 0.1, 0.05)
"""Prior sigmas of a calibration that is nearly known [rad, m, s]."""


def start(street: Street) -> tuple[gtsam.Pose3, float]:
    """1 deg, 5 cm and 20 ms off."""
    off = np.array([*np.radians([0.6, -0.5, 0.62]), 0.03, -0.03, 0.027])
    return street.cTl.retract(off), street.time_offset_s - 0.02


def solved(street: Street) -> RematchSolution:
    keys = AlignmentKeys(street.trajectory(), E, D)
    terms = [street.term(k, keys) for k in range(len(street.images))]
    return solve_with_terms(*street.whole(start(street), NEAR), terms)


@pytest.fixture(scope="module")
def by_edges() -> RematchSolution:
    return solved(street_without_labels())


def test_edges_alone_come_to_the_truth(by_edges: RematchSolution) -> None:
    street = street_without_labels()
    rotation_deg, translation_m, time_offset_s = street.errors(by_edges.values)
    assert by_edges.converged
    assert rotation_deg < 0.25 and translation_m < 0.03 and time_offset_s < 0.005
    assert street.nees(by_edges.values, by_edges.covariance) < 14.0
    sigmas = np.sqrt(np.diag(by_edges.covariance))
    assert (sigmas[:3] < np.radians(0.5)).all() and (sigmas[4:6] < 0.03).all()
    # at one speed, forward and later hardly differ: its sigmas say so
    assert WarningKind.WEAK_DIRECTION in {warning.kind for warning in by_edges.warnings}


@pytest.mark.parametrize("kind", ["isam2", "smoother"])
def test_edges_in_incremental_solvers(kind: str, by_edges: RematchSolution) -> None:
    street = street_without_labels()
    incremental = kind == "isam2"
    solver = (
        gtsam.ISAM2(isam2_params())
        if incremental
        else gtsam.IncrementalFixedLagSmoother(0.85, isam2_params())
    )
    found = street.frame_by_frame(solver, start(street), NEAR)
    rotation_deg, translation_m, time_offset_s = street.errors(found.values)
    assert found.converged and found.kernel_px == 4.0
    assert rotation_deg < 0.3 and translation_m < 0.04 and time_offset_s < 0.006
    assert street.nees(found.values, found.covariance) < 14.0
    if incremental:  # the same minimum
        step = by_edges.values.atPose3(E).localCoordinates(found.values.atPose3(E))
        assert (np.abs(step) < 0.5 * np.sqrt(np.diag(found.covariance)[:6])).all()


def test_labels_and_edges_in_one_graph(by_edges: RematchSolution) -> None:
    """A third of the frames has labels: these by contours and by the rest's edges, the others by edges."""
    street = street_without_labels(BOTH, labelled=4)
    solution = solved(street)
    classes = [set(each.found.classes) for each in solution.matches if each.factor is not None]
    assert {VEHICLE, OBJECT} in classes and {OBJECT} in classes
    rotation_deg, translation_m, time_offset_s = street.errors(solution.values)
    assert solution.converged
    assert rotation_deg < 0.2 and translation_m < 0.03 and time_offset_s < 0.004
    assert street.nees(solution.values, solution.covariance) < 14.0
    smaller = np.diag(solution.covariance) / np.diag(by_edges.covariance)
    assert np.exp(np.log(smaller).mean()) < 1.0


def test_a_labelled_object_is_matched_once() -> None:
    street, alone = street_without_labels(BOTH, labelled=4), street_without_labels()
    with_labels, without = street.scans[1].boundaries, alone.scans[1].boundaries
    assert VEHICLE in with_labels and VEHICLE not in without
    assert 0 < len(with_labels[OBJECT]) < len(without[OBJECT])
    vehicles, objects = with_labels[VEHICLE].lPs, with_labels[OBJECT].lPs
    assert np.linalg.norm(vehicles[:, None] - objects, axis=2).min() > 0.3
    # a frame without labels keeps all of its objects
    assert len(street.scans[6].boundaries[OBJECT]) == len(alone.scans[6].boundaries[OBJECT])


def test_edges_have_a_narrower_kernel() -> None:
    street = street_without_labels(BOTH, labelled=4)
    _, values = street.whole((street.cTl, street.time_offset_s))
    keys = AlignmentKeys(street.trajectory(), E, D)
    both, edges = (street.term(k, keys).matched(values, 10.0) for k in (1, 6))
    scales = {c: a.kernel.scale for c, a in zip(both.found.classes, both.found.alignments, strict=True)}
    assert scales == {VEHICLE: 10.0, OBJECT: pytest.approx(10.0 * EDGE_KERNEL_SHARE)}
    assert both.scale_px == 10.0 and edges.scale_px == pytest.approx(3.0)
    assert street.term(6, keys).matched(values, 40.0).scale_px == EDGE_KERNEL_PX


def test_what_edges_have_in_common_is_considered(by_edges: RematchSolution) -> None:
    """Positions between the beams, and the floor of 1 cm and 4 ms; not of labels."""
    street = street_without_labels()
    rows = [rows_of(each, ObjectSides(), by_edges.values) for each in by_edges.matches]
    sums = [TermSums.of(each, 1.0) for each in rows]
    for each, own in zip(rows, sums, strict=True):
        np.testing.assert_allclose(own.by_edges, own.claimed)
        assert (each.J[:, POSITIONS] != 0.0).any(axis=1).all() or not len(each)
    found = calibration_covariance(by_edges.graph, by_edges.values, by_edges.matches)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(by_edges.covariance), rtol=0.05)
    assert (np.sqrt(np.diag(found.covariance))[3:] > [0.009, 0.009, 0.009, 0.0035]).all()
    # of masks, none of this
    labelled = street_without_labels(BOTH, labelled=4)
    only = replace(labelled, config=replace(labelled.config, classes=(VEHICLE,)))
    keys = AlignmentKeys(only.trajectory(), E, D)
    _, values = only.whole((street.cTl, street.time_offset_s))
    matches = only.term(1, keys).matched(values, 5.0)
    own = TermSums.of(rows_of(matches, ObjectSides(), values), 1.0)
    assert own.claimed.any() and not own.by_edges.any()


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not STOP.is_dir(), reason="no ../shared")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_real_drive_without_labels(seed: int) -> None:
    """1 deg, 5 cm and 10 ms off: within 0.2 deg, 2 cm, 12 ms."""
    source = open_source(STOP, image_shift=1)
    drive = prepare_drive(source, OBJECTS, PrepareConfig(use_visual_odometry=False), with_lower_edges=False)
    assert source.truth is not None and source.truth.time_offset_s is not None
    truth = source.truth.cTl, source.truth.time_offset_s
    street = Street(drive.camera, drive.scans, drive.images, drive.lidar_motions, *truth)
    followed = follow_objects(drive.scans, scan_poses(drive), OBJECTS)
    rng = np.random.default_rng(seed)
    axes = [axis / np.linalg.norm(axis) for axis in rng.standard_normal((2, 3))]
    off = np.concatenate([np.radians(1.0) * axes[0], 0.05 * axes[1]])
    begin = truth[0].retract(off), truth[1] + 0.01 * float(rng.choice([-1.0, 1.0]))
    keys, config = AlignmentKeys(street.trajectory(), E, D), TermConfig(classes=OBJECTS)
    terms = []
    for k, image in enumerate(drive.images):
        near = slice(max(k - 1, 0), k + 4)
        scans, moving = followed.features[near], followed.l_velocities[near]
        terms.append(AlignmentTerm(scans, image, drive.camera, keys, config, moving))
    solution = solve_with_terms(*street.whole(begin, (0.01, 0.03, 0.01)), terms)
    rotation_deg, translation_m, time_offset_s = street.errors(solution.values)
    assert solution.converged
    assert rotation_deg < 0.2 and translation_m < 0.02 and time_offset_s < 0.012
    assert street.nees(solution.values, solution.covariance) < 14.0


def test_an_estimate_far_from_the_start_is_reported(by_edges: RematchSolution) -> None:
    street = street_without_labels()
    keys = AlignmentKeys(street.trajectory(), E, D)
    _, values = street.whole((street.cTl, street.time_offset_s))
    step = np.array([0.02, 0.0, 0.0, 0.0, 0.06, 0.0])
    values.update(E, by_edges.values.atPose3(E).retract(step))
    values.update(D, by_edges.values.atVector(D))
    for sigmas, expected in ((0.5, 2.0 * 2.0**0.5), (0.25, 4.0 * 2.0**0.5)):
        known = np.diag(sigmas**2 * np.array([0.02, 0.02, 0.02, 0.06, 0.06, 0.06, 0.01]) ** 2)
        found = far_from_start(keys, values, by_edges.values, known)
        assert [w.kind for w in found] == [WarningKind.FAR_FROM_START] * (expected > 4.3)
        for warning in found:
            assert warning.value == pytest.approx(expected, rel=0.01)
    assert far_from_start(keys, values, by_edges.values, np.full((7, 7), np.inf)) == []


def test_a_picture_is_needed() -> None:
    street = street_without_labels()
    image = replace(street.images[4], contours={})
    term = replace(street.term(4, AlignmentKeys(street.trajectory(), E, D)), image=image)
    _, values = street.whole((street.cTl, street.time_offset_s))
    matches = term.matched(values, 5.0)
    assert matches.factor is None and len(matches) == 0 and term.config.classes == OBJECTS
