"""Marginals of the same sensors: what they assume errs in all of them together."""

from __future__ import annotations

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.covariance.contradiction import Difference, PartEstimate, disagreement
from sst_graph.errors import ContradictionError, DataError, EstimationError
from sst_graph.export import CalibrationMarginal, Common, common_errors, fuse_marginals, marginal_of_result
from sst_graph.factors import FactorError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.marginal import carried, separated
from sst_graph.result import CalibrationResult
from sst_graph.types import Calibration

FloatArray = NDArray[np.float64]

TRUE = gtsam.Pose3(gtsam.Rot3.Ypr(-1.5, 0.02, -1.55), np.array([0.06, -0.08, -0.27]))
SIGMAS = np.array([*np.radians([0.05] * 3), 0.01, 0.01, 0.01, 0.003])
CAMERA = PinholeCamera(718.0, 718.0, 607.0, 185.0, 1242, 375)
LENS = {
    "cx": np.array([0.0, 0.0, 0.002, 0.01, 0.0, 0.0, 0.0]),
    "cy": np.array([0.0, 0.0015, 0.0, 0.0, 0.004, 0.0, 0.0]),
}


def own_covariance(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(7, 20)) * SIGMAS[:, None]
    return np.asarray(A @ A.T / 20.0)


def steps(seed: int) -> dict[str, FloatArray]:
    """Of a drive: nearly those of the others."""
    rng = np.random.default_rng(seed)
    return {name: step * rng.uniform(0.8, 1.2, 7) for name, step in LENS.items()}


def result(seed: int, error: FloatArray | None = None) -> CalibrationResult:
    common, d = steps(seed), np.zeros(7) if error is None else error
    S = np.array([*common.values()])
    said = {name: {"sigma": 2.0, "sensitivity": (step / 2.0).tolist()} for name, step in common.items()}
    return CalibrationResult(
        TRUE.retract(d[:6]),
        0.02 + d[6],
        own_covariance(seed) + S.T @ S,
        "ok",
        CAMERA,
        diagnostics={"assumptions": said},
    )


def marginals(rng: np.random.Generator, count: int) -> list[CalibrationMarginal]:
    """Of drives with errors as they claim: their own, and one shift of the lens for all."""
    lens = rng.normal(size=len(LENS))
    found = []
    for k in range(count):
        error = rng.multivariate_normal(np.zeros(7), own_covariance(k))
        error = error + lens @ np.array([*steps(k).values()])
        found.append(marginal_of_result(result(k, error)))
    return found


def error_of(marginal: CalibrationMarginal) -> FloatArray:
    return Calibration(TRUE, 0.02).local_coordinates(marginal.best())


def test_the_steps_of_a_result() -> None:
    one = marginal_of_result(result(1))
    assert [*one.common.errors] == ["cx", "cy"]
    np.testing.assert_allclose(one.common.errors["cx"], steps(1)["cx"])
    np.testing.assert_allclose(one.covariance(), result(1).covariance, rtol=1e-6, atol=1e-15)
    # another covariance than that which they are a part of
    assert common_errors(replace(result(1), covariance=1e-3 * result(1).covariance)) == {}


def test_their_own_part() -> None:
    one = marginal_of_result(result(2))
    apart = separated(one)
    np.testing.assert_allclose(apart.own.covariance(), own_covariance(2), rtol=1e-6, atol=1e-15)
    again = apart.together()
    np.testing.assert_allclose(again.information, one.information, rtol=1e-6)
    np.testing.assert_array_equal(again.common.errors["cy"], one.common.errors["cy"])


@pytest.mark.slow
def test_what_they_have_in_common_does_not_average_out() -> None:
    """Many fusions of eight drives: errors as the covariance says, which independent ones are not."""
    rng, squared, alone = np.random.default_rng(1), [], []
    for _ in range(200):
        parts = marginals(rng, 8)
        fused = fuse_marginals(parts, significance=0.0)
        d = error_of(fused)
        squared.append(d @ fused.information @ d)
        independent = fuse_marginals([replace(part, common=Common()) for part in parts], significance=0.0)
        d = error_of(independent)
        alone.append(d @ independent.information @ d)
    assert np.mean(squared) == pytest.approx(7.0, rel=0.15)  # deviation of the mean: 0.26
    assert np.mean(alone) > 14.0


def test_fused_in_any_order_it_is_the_same() -> None:
    parts = marginals(np.random.default_rng(2), 3)
    whole = fuse_marginals(parts)
    added = parts[0].plus(parts[1]).plus(parts[2])
    in_turn = fuse_marginals([fuse_marginals(parts[:2]), parts[2]])
    for other in (added, in_turn):
        assert np.linalg.norm((error_of(other) - error_of(whole)) / SIGMAS) < 1e-3
        np.testing.assert_allclose(
            other.covariance() / np.outer(SIGMAS, SIGMAS),
            whole.covariance() / np.outer(SIGMAS, SIGMAS),
            atol=0.01,
        )
        assert [*other.common.errors] == ["cx", "cy"]


def test_agreement_is_as_likely_as_said() -> None:
    """Drives that share a lens which is off agree; a knock that its sigma would hide is found."""
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(100):
        try:
            fuse_marginals(marginals(rng, 4), significance=0.1)
        except ContradictionError:
            refused += 1
    assert 2 <= refused <= 20
    *others, last = marginals(rng, 4)
    knock = np.array([0.0, 0.0, np.radians(0.4), 0.0, 0.0, 0.0])  # three deviations of yaw
    knocked = replace(last, cTl=last.cTl.retract(knock))
    with pytest.raises(ContradictionError, match=r"'d' differs from the others in rotation by 0\.\d+°"):
        fuse_marginals([*others, knocked], names=[*"abcd"])
    independent = [replace(one, common=Common()) for one in (*others, knocked)]
    fuse_marginals(independent)


def test_another_point_keeps_the_errors_that_it_stands_for() -> None:
    one = marginal_of_result(result(4, np.full(7, 1e-3)))
    turn = np.radians(2.0)
    there = carried(one, Calibration(TRUE.retract(np.array([turn, -turn, turn, 0.05, 0.0, 0.02])), 0.03))
    best, d = there.best(), there.covariance() @ there.vector
    assert best.cTl.equals(one.cTl, 1e-12)
    for name, step in one.common.errors.items():
        # the optimum moved by a small part of the step, from here and from there
        moved = one.cTl.retract(1e-4 * step[:6])
        seen = there.cTl.localCoordinates(moved) - d[:6]
        np.testing.assert_allclose(seen, 1e-4 * there.common.errors[name][:6], atol=1e-9)


def test_in_a_file() -> None:
    one = marginal_of_result(result(5))
    assert CalibrationMarginal.from_json(one.to_json()) == one
    without = replace(one, common=Common())
    assert "common_errors" not in json.loads(without.to_json())
    for wrong in ({"cx": [1.0] * 6}, {"cx": [1e3] * 7}, {"c\nx": [0.0] * 7}, [1.0], {"cx": "text"}):
        with pytest.raises(DataError, match="common"):
            CalibrationMarginal.from_json(json.dumps({**json.loads(one.to_json()), "common_errors": wrong}))


def test_refuses_what_is_no_part_of_it() -> None:
    one = marginal_of_result(result(6))
    for wrong in ({"cx": np.full(7, 1.0)}, {"cx": np.zeros(6)}, {3: np.zeros(7)}, None, {"cx": [np.nan] * 7}):
        with pytest.raises(FactorError, match="common"):
            replace(one, common=Common(wrong))  # type: ignore[arg-type]
    nothing = CalibrationMarginal(TRUE, 0.0, np.diag([1.0] * 6 + [0.0]), np.zeros(7))
    with pytest.raises(EstimationError):
        replace(nothing, common=Common({"cx": np.full(7, 1e-3)}))


def test_what_a_drive_adds_to_the_disagreement_names_the_wrong_one() -> None:
    """Among drives that are known unequally well, and that a lens moves unequally far."""
    rng, wrong = np.random.default_rng(0), 1
    for _ in range(100):
        lens, estimates = rng.normal(size=len(LENS)), []
        for k in range(3):
            A = rng.normal(size=(7, 20)) * SIGMAS[:, None] * rng.uniform(0.3, 3.0)
            common = {name: 2.0 * step * rng.uniform(0.5, 1.5, 7) for name, step in LENS.items()}
            step = rng.multivariate_normal(np.zeros(7), A @ A.T / 20.0)
            step = step + lens @ np.array([*common.values()])
            step[rng.integers(3)] += np.radians(1.0) * (k == wrong)
            estimates.append(PartEstimate(step, A @ A.T / 20.0, common=common))
        against = [
            Difference.from_others([*estimates[:k], *estimates[k + 1 :]], estimates[k]) for k in range(3)
        ]
        assert int(np.argmax([difference.chi2 for difference in against])) == wrong
        rest = disagreement([estimates[0], estimates[2]])
        np.testing.assert_allclose(against[wrong].chi2, disagreement(estimates) - rest, rtol=1e-6)
