"""The principal point of an estimate by labels, tested by edges of some frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from stored import simulated, stored
from streets import LENS_STREET as STREET

from sst_graph import CalibrationConfig, CalibrationResult, SemanticClass, calibrate
from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.assumption_tests import ParameterTest, with_further_tests
from sst_graph.batch.by_edges import covariance
from sst_graph.batch.by_edges.covariance import SAMPLES
from sst_graph.batch.by_edges.lens import lens_beside_labels
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.edges_of_frames import with_edges
from sst_graph.drive.preparation import Drive, PrepareConfig
from sst_graph.experiments.wrong_drives import with_principal_point
from sst_graph.features.picture_gradients import PictureGradients
from sst_graph.graph.outer_loop import solve_joint_steps
from sst_graph.graph.state import State
from sst_graph.metrics import tangent_error
from sst_graph.types import Guess

CONFIG = CalibrationConfig(decide_sweep=False)


@cache
def truth() -> State:
    true = simulated(STREET).truth
    return State(true.cTl, (true.time_offset_s,))


@cache
def drive(right_px: float = 0.0) -> Drive:
    """The street, its principal point this far from the one given."""
    kept = with_principal_point(KeptDrive.of(simulated(STREET)), right_px, 0.0)
    return prepare_drives([kept], CONFIG)[0]


def found(own: Drive, beside: Sequence[ParameterTest] | None = None) -> dict[str, ParameterTest]:
    """What edges say, from an estimate that makes up for a principal point by a turn, as labels do."""
    turned = (own.camera.cx - simulated(STREET).camera.cx) / own.camera.fx
    state = replace(truth(), cTl=truth().cTl.retract(np.array([0.0, 0.0, turned, 0.0, 0.0, 0.0])))
    problem = CalibrationProblem.of([own], Guess(truth().cTl, truth().time_offsets_s[0]), CONFIG)
    return {each.assumption.name: each for each in lens_beside_labels(problem, state, beside)}


def counted(
    right_px: float, beside: Sequence[ParameterTest] | None = None
) -> tuple[dict[str, ParameterTest], int]:
    """What edges say, and how many half-samples were solved for it."""
    solved: list[int] = []

    def counting(*arguments: object) -> object:
        solved.append(1)
        return solve_joint_steps(*arguments)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covariance, "solve_joint_steps", counting)
        return found(drive(right_px), beside), len(solved)


def all_half_samples(right_px: float) -> tuple[dict[str, ParameterTest], int]:
    """:func:`counted` of all half-samples, made once a session."""
    return stored((STREET, "lens beside labels", right_px), lambda: counted(right_px))


@pytest.mark.slow
def test_the_right_principal_point_is_not_contradicted() -> None:
    tests, _ = all_half_samples(0.0)
    assert set(tests) == {"cx", "cy"}
    assert not any(each.contradicted for each in tests.values())
    assert tests["cx"].sigma < 3.0


@pytest.mark.parametrize("right_px", [8.0, -8.0])
@pytest.mark.slow
def test_a_wrong_one_is_found(right_px: float) -> None:
    cx = all_half_samples(right_px)[0]["cx"]
    assert cx.contradicted and cx.value == pytest.approx(right_px, abs=2.5)


@pytest.mark.parametrize("right_px", [0.0, 8.0])
def test_half_samples_that_decide_nothing_are_left_out(right_px: float) -> None:
    """The outcome is that of all of them."""
    labels = tuple(ParameterTest(ASSUMPTIONS[name], 2.0, 4.0, False) for name in ("cx", "cy"))
    (by_all, whole), (by_some, solved) = all_half_samples(right_px), counted(right_px, labels)
    everything = with_further_tests(labels, tuple(by_all.values()), 3.3)
    some = with_further_tests(labels, tuple(by_some.values()), 3.3)
    assert [(each.assumption, each.contradicted) for each in some] == [
        (each.assumption, each.contradicted) for each in everything
    ]
    for one, other in zip(some, everything, strict=True):
        assert one.value == pytest.approx(other.value, abs=0.5 * other.sigma)
    assert any(each.contradicted for each in everything) == (right_px > 0.0)
    assert whole == SAMPLES and (solved <= 3 if right_px == 0.0 else solved == SAMPLES)


def test_frames_without_pictures_or_that_cannot_be_read_tell_nothing() -> None:
    own, pairs = drive(), [(0, 0), (3, 3)]
    assert with_edges(replace(own, frames=None), pairs, PrepareConfig()) is None
    blank = KeptDrive.of(simulated(STREET)).with_images(
        lambda image: replace(image, pixels=np.zeros((0, 0, 3), np.uint8))
    )
    assert with_edges(prepare_drives([blank], CONFIG)[0], pairs, PrepareConfig()) is None


def test_edges_of_the_chosen_frames_alone() -> None:
    own = drive()
    chosen = with_edges(own, [(1, 2), (4, 5)], PrepareConfig())
    assert chosen is not None and len(chosen.scans) == len(own.scans)
    assert [bool(scan.boundaries) for scan in chosen.scans] == [k in (1, 4) for k in range(12)]
    assert all(set(scan.boundaries) <= {SemanticClass.OBJECT} for scan in chosen.scans)
    with_gradients = [k for k, image in enumerate(chosen.images) if image.contours]
    assert with_gradients == [2, 5]
    assert isinstance(chosen.images[2].contours[SemanticClass.OBJECT], PictureGradients)
    # Those of the drive itself are as they were.
    assert own.scans[1].boundaries and SemanticClass.OBJECT not in own.scans[1].boundaries


def test_two_tests_of_a_parameter_are_weighted_by_their_variances() -> None:
    cx, k1 = ASSUMPTIONS["cx"], ASSUMPTIONS["k1"]
    labels = (ParameterTest(k1, 0.01, 0.005, False), ParameterTest(cx, 6.0, 4.0, False))
    edges = (ParameterTest(cx, 8.0, 2.0, True),)
    first, second = with_further_tests(labels, edges, 3.3)
    assert first.assumption is cx and first.contradicted
    assert first.value == pytest.approx((6.0 / 16 + 8.0 / 4) / (1 / 16 + 1 / 4))
    assert first.sigma == pytest.approx((1 / 16 + 1 / 4) ** -0.5)
    assert second == labels[0]
    # What stays open together is considered as the labels have it.
    weak = (ParameterTest(cx, 3.0, 2.0, False),)
    assert set(with_further_tests(labels, weak, 3.3)) == set(labels)


def street(seed: int) -> KeptDrive:
    return KeptDrive.of(simulated(replace(STREET, seed=seed, frames=24, motion="mixed")))


def by_labels(own: KeptDrive, right_px: float) -> CalibrationResult:
    """The result by labels, the principal point this far from the one given."""
    config = with_overrides(CONFIG, ["find_causes=false"])
    assert own.truth is not None
    return calibrate(with_principal_point(own, right_px, 0.0), own.truth.cTl, config)


@pytest.mark.slow
def test_a_result_by_labels_is_not_ok_with_a_wrong_principal_point() -> None:
    """Five of the sigmas that cx would have as a variable are found."""
    right, wrong = (by_labels(street(507), px) for px in (0.0, 8.0))
    assert right.status == "ok"
    assert wrong.status == "not_converged"
    assert wrong.reasons[0].startswith("the pictures lie beside the principal point cx: cx = ")
    assert wrong.diagnostics["assumptions"]["cx"]["estimate"] == pytest.approx(8.0, abs=2.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [507, 508, 509, 510])
def test_less_is_found_or_in_the_sigmas(seed: int) -> None:
    """Three to four of these sigmas."""
    own = street(seed)
    less = by_labels(own, 6.0)
    assert own.truth is not None
    late_s = less.time_offset_s - own.truth.time_offset_s
    error = tangent_error(less.T_camera_lidar, own.truth.cTl, late_s)
    covered = bool((np.abs(error) < 3.0 * np.sqrt(np.diag(less.covariance))).all())
    assert covered or less.status == "not_converged"
