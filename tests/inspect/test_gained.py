"""What results of the tracker and of other methods say of their frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.state import EXTRINSIC, State, time_offset_key
from sst_graph.hand_eye.graph import PRIOR_SIGMAS
from sst_graph.inspect.gained import KEY, gained_of, pair_gains, to_document
from sst_graph.inspect.inspection import inspect_result, to_dict
from sst_graph.inspect.inspection_text import general_advice, inspection_text
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.tracker.window.information_log import InformationLog


def _covariance(seed: int) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(7, 30)) * np.array([1e-3] * 3 + [1e-2] * 3 + [2e-3])[:, None]
    return np.asarray(A @ A.T / 30.0)


def _result(method: str, gained: Any = None) -> CalibrationResult:
    camera = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
    diagnostics = {} if gained is None else {KEY: gained}
    result = CalibrationResult(gtsam.Pose3(), 0.0, _covariance(0), "ok", camera, diagnostics=diagnostics)
    return replace(result, method=method)


def _factors(count: int) -> tuple[list[gtsam.NonlinearFactor], list[np.ndarray]]:
    rng, factors, rows = np.random.default_rng(1), [], []
    values = gtsam.Values()
    values.insert(EXTRINSIC, gtsam.Pose3())
    values.insert(time_offset_key(), np.zeros(1))
    for _ in range(count):
        J = rng.normal(size=(6, 7)) * 20.0
        unit = gtsam.noiseModel.Unit.Create(6)
        linear = gtsam.JacobianFactor(EXTRINSIC, J[:, :6], time_offset_key(), J[:, 6:], np.zeros(6), unit)
        factors.append(gtsam.LinearContainerFactor(linear, values))
        rows.append(J)
    return factors, rows


def test_a_pair_is_worth_what_the_others_lack_without_it() -> None:
    factors, rows = _factors(3)
    frames = [FrameId("a", k) for k in range(3)]
    gained = pair_gains(factors, frames, State(gtsam.Pose3()))
    H = np.diag(PRIOR_SIGMAS**-2.0) + sum(J.T @ J for J in rows)
    for gain, J in zip(gained.gains, rows, strict=True):
        rest = H - J.T @ J
        bits = 0.5 * np.log2(np.linalg.det(H) / np.linalg.det(rest))
        assert gain.bits == pytest.approx(bits, rel=1e-6)
        ratios = np.sqrt(np.diag(np.linalg.inv(rest)) / np.diag(np.linalg.inv(H)))
        np.testing.assert_allclose(gain.values, ratios, rtol=1e-6)
    text = inspection_text(inspect_result(_result("motion", to_document(gained))))
    assert "what each pair of consecutive images adds" in text and "no view" in text


def test_bits_of_arrivals_add_up() -> None:
    log = InformationLog()
    covariances = [_covariance(seed) / (1.0 + seed) for seed in range(5)]
    for scan, covariance in enumerate(covariances):
        log.add(10 + scan, covariance)
    gained = log.gained("a/00")
    assert gained.gains[0].bits is None
    total = 0.5 * np.log2(np.linalg.det(1e3 * covariances[0]) / np.linalg.det(1e3 * covariances[-1]))
    assert sum(gain.bits or 0.0 for gain in gained.gains) == pytest.approx(total, rel=1e-6)
    again = gained_of(CalibrationResult.from_json(_result("track", to_document(gained)).to_json()))
    assert again is not None and again.kind == gained.kind
    assert [gain.frame for gain in again.gains] == [FrameId("a/00", 10 + k) for k in range(5)]
    np.testing.assert_allclose(again.gains[-1].values, gained.gains[-1].values, rtol=1e-3)


def test_a_new_start_is_no_gain() -> None:
    log = InformationLog()
    log.add(0, _covariance(1))
    log.restart()
    log.add(1, 100.0 * _covariance(1))
    assert [gain.bits for gain in log.gained("a").gains] == [None, None]


def test_the_tracker_s_scans_in_words_and_in_json() -> None:
    log = InformationLog()
    for scan in range(30):
        log.add(scan, _covariance(2) / (1.0 + scan))
    inspection = inspect_result(_result("track", to_document(log.gained("a/00"))))
    text = inspection_text(inspection)
    assert "what each scan brought as it came" in text and "18 more with --all-frames" in text
    assert "half of them from" in text and "\n0              start" in text
    assert len(inspection_text(inspection, all_frames=True).splitlines()) == len(text.splitlines()) + 18
    document = to_dict(inspection)["gained"]
    assert document["frames"][0]["bits"] is None and len(document["frames"][1]["sigma_after"]) == 7


@pytest.mark.parametrize("method", ["paper", "static", "semalign", "track", "joint"])
def test_where_nothing_can_be_said_it_says_why(method: str) -> None:
    text = inspection_text(inspect_result(_result(method)))
    assert f"is not known for this result of method {method}: " in text
    assert ("independent" in text) == (method in ("paper", "static", "semalign"))


@pytest.mark.parametrize(
    ("method", "rule"),
    [
        ("edges", "record motion with a change of speed or a turn"),
        ("motion", "record turns that begin and end"),
    ],
)
def test_without_predictions_the_rule_for_the_weakest_direction_is_given(method: str, rule: str) -> None:
    covariance = np.diag(np.square([*np.radians([0.01] * 3), 0.001, 0.001, 0.001, 0.008]))
    result = replace(_result(method), covariance=covariance, frames_used=(FrameId("a", 0),))
    last = inspection_text(inspect_result(result)).splitlines()[-1]
    assert last.startswith(f"- the rule for its weakest direction: {rule}")
    untrusted = inspect_result(replace(result, status="not_converged", reasons=("a clock jumps",)))
    assert general_advice(untrusted) == "" and "the rule for" not in inspection_text(untrusted)


@pytest.mark.parametrize(
    "document",
    [
        [],
        {"kind": "of another kind"},
        {"kind": "as they came", "drive": ["a"], "frame": [1], "bits": [1.0]},
        {"kind": "as they came", "drive": ["a"], "frame": [1], "bits": [1.0], "values": [[1.0, 2.0]]},
        {"kind": "as they came", "drive": ["a"], "frame": [1], "bits": [1.0], "values": [[1e300] * 7]},
        {"kind": "as they came", "drive": ["a"], "frame": [1, 2], "bits": [1.0], "values": [[1.0] * 7]},
    ],
)
def test_malformed_gains_are_named(document: Any) -> None:
    with pytest.raises(DataError, match=KEY):
        gained_of(_result("track", document))
