"""The covariance of a hand-eye estimate follows how the scores of neighbours go together."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.graph.state import EXTRINSIC, time_offset_key
from sst_graph.hand_eye.covariance import MOST_TAKEN_OFF, SharedErrors, hand_eye_covariance
from sst_graph.hand_eye.graph import HandEyeTerm

PAIRS = 600
NOTHING_SHARED = SharedErrors(direction_deg=0.0, turn_rate_deg_s=0.0)


def _covariance(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance with residuals (n, 6) of n consecutive pairs of like rows, and that of independent ones."""
    J = np.random.default_rng(1).normal(size=(6, 7)) * 20.0
    J = np.vstack([J, np.random.default_rng(2).normal(size=(6, 7)) * 20.0])
    values = gtsam.Values()
    values.insert(EXTRINSIC, gtsam.Pose3())
    values.insert(time_offset_key(), np.zeros(1))
    unit, still = gtsam.noiseModel.Unit.Create(6), np.zeros((6, 6))
    step = SimpleNamespace(covariance=still, twist_covariance=still)
    graph, terms = gtsam.NonlinearFactorGraph(), []
    for k, row in enumerate(noise):
        block = J[6 * (k // (PAIRS // 2)) :][:6]  # two sorts of views, one after the other
        linear = gtsam.JacobianFactor(EXTRINSIC, block[:, :6], time_offset_key(), block[:, 6:], row, unit)
        factor: Any = gtsam.LinearContainerFactor(linear, values)
        camera = SimpleNamespace(drive=0, from_ns=k, to_ns=k + 1)
        pair: Any = SimpleNamespace(camera=camera, lidar=step)
        graph.add(factor)
        terms.append(HandEyeTerm(pair, factor, np.eye(6), 0.0, still))
    found = hand_eye_covariance(graph, values, terms, NOTHING_SHARED)
    H = PAIRS // 2 * (J[:6].T @ J[:6] + J[6:].T @ J[6:])
    return found, np.linalg.inv(H)


def _ratios(noise: np.ndarray) -> np.ndarray:
    """Of the covariance to that of independent pairs, along all directions."""
    found, independent = _covariance(noise)
    root = np.linalg.inv(np.linalg.cholesky(independent))
    return np.asarray(np.linalg.eigvalsh(root @ found @ root.T))


@pytest.fixture
def white() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(PAIRS + 1, 6))


def test_independent_pairs_count_as_such(white: np.ndarray) -> None:
    assert _ratios(white[1:]) == pytest.approx(np.ones(7), abs=0.45)


def test_correlated_neighbours_count_less(white: np.ndarray) -> None:
    together = (white[1:] + white[:-1]) / np.sqrt(2.0)
    assert 1.3 < np.mean(_ratios(together)) < 2.2


def test_neighbours_that_cancel_count_more_up_to_a_bound(white: np.ndarray) -> None:
    ratios = _ratios((white[1:] - white[:-1]) / np.sqrt(2.0))
    assert ratios == pytest.approx(np.full(7, 1.0 - MOST_TAKEN_OFF), abs=1e-6)
