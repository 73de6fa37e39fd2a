"""What a user gives to the terms' solvers by mistake is refused in one sentence, the solver untouched."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from alignment_streets import D, E, X, isam2_params, simulated_street

from sst_graph import AlignmentKeys, AlignmentTerm, IncrementalTerms, Trajectory, solve_with_terms
from sst_graph.errors import EstimationError
from sst_graph.factors import FactorError
from sst_graph.slam.alignment_term import TermState
from sst_graph.slam.incremental_terms import Solver
from sst_graph.types import SemanticClass

STREET = simulated_street(5)
BIAS = int(gtsam.symbol("B", 0))
FEW = 8
SOLVERS: dict[str, Callable[[], Solver]] = {
    "ISAM2": lambda: gtsam.ISAM2(isam2_params()),
    "smoother": lambda: gtsam.IncrementalFixedLagSmoother(10.0, isam2_params()),
}


def _keys(cTl: int | gtsam.Pose3 = E, time_offset_s: int | float = D) -> AlignmentKeys:
    return AlignmentKeys(STREET.trajectory(), cTl, time_offset_s)


def _terms(keys: AlignmentKeys) -> list[AlignmentTerm]:
    return [STREET.term(k, keys) for k in range(2, FEW)]


def _stamps() -> dict[int, float]:
    return {X(k): 0.1 * k for k in range(len(STREET.scans))}


def _problem() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    return STREET.whole(STREET.start(1))


def test_a_variable_has_a_key_of_its_own() -> None:
    trajectory = STREET.trajectory()
    for keys in ((E, E), (X(3), D), (E, X(0))):
        with pytest.raises(FactorError, match="distinct keys"):
            AlignmentKeys(trajectory, *keys)
    for bias in (E, D, X(2)):
        with pytest.raises(FactorError, match="distinct keys"):
            AlignmentKeys(trajectory, E, D, {SemanticClass.VEHICLE: bias})
    shared = {SemanticClass.VEHICLE: BIAS, SemanticClass.POLE: BIAS}
    assert AlignmentKeys(trajectory, E, D, shared).lasting == (E, D, BIAS)
    with pytest.raises(FactorError, match="found X0 twice"):
        Trajectory([X(0), X(0)], [0, 1])


def _other(key: int, value: object) -> gtsam.Values:
    values = _problem()[1]
    values.erase(key)
    values.insert(key, value)
    return values


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (D, np.zeros(2), "Vector(2)"),
        (D, gtsam.Pose3(), "Pose3"),
        (D, np.array([np.nan]), "NaN"),
        (E, gtsam.Rot3(), "Rot3"),
        (E, gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan)), "NaN"),
        (X(3), gtsam.Rot3(), "Rot3"),
    ],
)
def test_a_value_of_another_kind_is_named(key: int, value: object, said: str) -> None:
    values, keys = _other(key, value), _keys()
    matches = STREET.term(3, keys).matched(_problem()[1], 40.0)
    name = gtsam.DefaultKeyFormatter(key)
    calls: list[Callable[[], object]] = [
        lambda: STREET.term(3, keys).matched(values, 40.0),
        lambda: matches.moved_px(values),
        lambda: matches.predicted_sigma_px(values, np.eye(7)),
    ]
    for call in calls:
        with pytest.raises(FactorError) as error:
            call()
        assert name in str(error.value) and said in str(error.value)


def test_solving_names_a_value_of_another_kind() -> None:
    graph, _ = _problem()
    for key, value in ((D, np.zeros(2)), (E, gtsam.Rot3())):
        with pytest.raises(FactorError, match=gtsam.DefaultKeyFormatter(key)):
            solve_with_terms(graph, _other(key, value), _terms(_keys()))


def test_terms_of_two_cameras_are_not_solved_as_one() -> None:
    graph, values = _problem()
    mixed = [*_terms(_keys())[:3], *_terms(_keys(E, 0.1))[3:]]
    with pytest.raises(FactorError, match="one camera"):
        solve_with_terms(graph, values, mixed)
    with pytest.raises(FactorError, match="one camera"):
        IncrementalTerms(SOLVERS["ISAM2"](), _keys()).update(graph, values, mixed)
    moved = STREET.cTl.retract(np.full(6, 1e-3))
    assert not _keys(STREET.cTl).is_same_camera(_keys(moved))
    assert _keys(STREET.cTl).is_same_camera(_keys(gtsam.Pose3(STREET.cTl.matrix())))


def test_a_term_counts_once() -> None:
    graph, values = _problem()
    terms = _terms(_keys())
    with pytest.raises(FactorError, match="each pair once"):
        solve_with_terms(graph, values, [*terms, terms[0]])
    with pytest.raises(FactorError, match="each pair once"):
        solve_with_terms(graph, values, [*terms, STREET.term(3, _keys())])
    solution = solve_with_terms(graph, values, terms)
    with pytest.raises(FactorError, match="6 further alignment factors"):
        solve_with_terms(solution.graph, solution.values, terms)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_term_that_is_in_the_solver_is_not_taken_again(solver: str) -> None:
    """All terms so far, at every update: each image would count as often as there are updates."""
    terms = _terms(_keys())
    online = IncrementalTerms(SOLVERS[solver](), _keys())
    online.update(*_problem(), terms[:3], _stamps())
    nothing = gtsam.NonlinearFactorGraph(), gtsam.Values()
    with pytest.raises(FactorError, match="each pair once"):
        online.update(*nothing, terms[:4])
    assert len(online.update(*nothing, terms[3:]).values.keys()) == len(STREET.scans) + 2


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_refused_update_leaves_the_solver_as_it_was(solver: str) -> None:
    graph, values = _problem()
    online = IncrementalTerms(SOLVERS[solver](), _keys())
    with pytest.raises(EstimationError, match="no update before it"):
        online.converge()
    without = gtsam.Values(values)
    without.erase(D)
    kinds = gtsam.Values(without)
    kinds.insert(D, np.zeros(2))
    gap = gtsam.Values(values)
    gap.erase(X(3))
    for wrong, said in ((without, "no D0"), (kinds, "Vector(2)"), (gap, "no X3")):
        with pytest.raises(FactorError) as error:
            online.update(graph, wrong, _terms(_keys()), _stamps())
        assert said in str(error.value)
    online.update(graph, values, _terms(_keys()), _stamps())
    with pytest.raises(FactorError, match="D0, which is there already"):
        online.update(gtsam.NonlinearFactorGraph(), values, (), _stamps())
    assert online.converge().converged
    for rounds in (0, -1, 1.5, "2", True):
        with pytest.raises(FactorError, match="most_rounds"):
            online.converge(rounds)  # type: ignore[arg-type]  # what a user may give


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solver_that_does_not_determine_the_calibration_is_named(solver: str) -> None:
    graph, values = _problem()
    for i in range(graph.size()):
        if set(graph.at(i).keys()) & {E, D}:
            graph.remove(i)
    online = IncrementalTerms(SOLVERS[solver](), _keys())
    with pytest.raises(EstimationError, match="expected priors"):
        online.update(graph, values, _terms(_keys()), _stamps())


def test_a_smoother_needs_the_stamps_of_poses() -> None:
    """Without, it would never marginalize them."""
    online = IncrementalTerms(SOLVERS["smoother"](), _keys())
    stamps = _stamps()
    for wrong, said in ((None, "none for X"), ({**stamps, X(0): np.nan}, "nan"), ({"a": 1.0}, "'a'")):
        with pytest.raises(FactorError, match=said):
            online.update(*_problem(), _terms(_keys()), wrong)  # type: ignore[arg-type]
    assert online.update(*_problem(), _terms(_keys()), stamps).values.exists(X(0))


@pytest.mark.parametrize("solver", SOLVERS)
def test_terms_with_a_fixed_calibration_converge_online(solver: str) -> None:
    """For trajectory and mask bias alone: nothing of the calibration is uncertain, the kernel may narrow."""
    keys = AlignmentKeys(STREET.trajectory(), STREET.cTl, STREET.time_offset_s, {SemanticClass.VEHICLE: BIAS})
    graph, values = _problem()
    graph.add(gtsam.PriorFactorVector(BIAS, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 3.0)))
    values.insert(BIAS, np.zeros(1))
    online = IncrementalTerms(SOLVERS[solver](), keys)
    online.update(graph, values, _terms(keys), {**_stamps(), E: 0.0, D: 0.0})
    update = online.converge()
    assert update.converged and update.kernel_px == 4.0 and not update.covariance.any()


@pytest.mark.parametrize("start_ns", [0, 1_700_000_000_123_456_789])
def test_an_image_at_the_first_pose_is_within_the_trajectory(start_ns: int) -> None:
    """Stamps since 1970 have more digits than a float."""
    scans = [dataclasses.replace(each, stamp_ns=each.stamp_ns + start_ns) for each in STREET.scans[:3]]
    trajectory = Trajectory([X(k) for k in range(3)], [each.stamp_ns for each in scans])
    keys = AlignmentKeys(trajectory, STREET.cTl, 0.0)
    values = _problem()[1]
    for k in (0, 2):
        image = dataclasses.replace(STREET.images[k], stamp_ns=scans[k].stamp_ns)
        state = AlignmentTerm(scans, image, STREET.camera, keys).matched(values, 40.0).state
        assert state not in (TermState.BEFORE_TRAJECTORY, TermState.AFTER_TRAJECTORY)


def test_terms_compare_by_identity() -> None:
    terms = _terms(_keys())
    assert (
        terms.index(terms[2]) == 2 and STREET.term(2, _keys()) not in terms and len(set(terms)) == len(terms)
    )
    matches = terms[0].matched(_problem()[1], 40.0)
    assert matches == matches and matches != terms[0].matched(_problem()[1], 40.0)


class _Uncopied(Trajectory):
    """Of hours at 10 Hz a copy takes milliseconds, and each term would take several at every update."""

    @property
    def keys(self) -> tuple[int, ...]:
        raise AssertionError("the keys were copied")

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        raise AssertionError("the stamps were copied")


def test_a_term_finds_its_place_without_a_copy_of_the_trajectory() -> None:
    trajectory = _Uncopied([X(k) for k in range(len(STREET.scans))], STREET.stamps_ns)
    keys = AlignmentKeys(trajectory, STREET.cTl, STREET.time_offset_s)
    matches = STREET.term(3, keys).matched(_problem()[1], 40.0)
    assert matches.state == TermState.MATCHED
