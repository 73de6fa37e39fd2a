"""The covariance of a hand-eye estimate follows how the scores of neighbours go together."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.graph.state import State
from sst_graph.hand_eye.covariance import (
    MOST_TAKEN_OFF,
    MotionErrors,
    few_pairs_factor,
    hand_eye_covariance,
)
from sst_graph.hand_eye.graph import HandEyeTerms, MotionPairs

PAIRS = 600
NOTHING_SHARED = MotionErrors(direction_deg=0.0, turn_rate_deg_s=0.0)


def _blocks(pairs: int) -> np.ndarray:
    """(n, 6, 7) rows of consecutive pairs: two sorts of views, one after the other."""
    J = np.random.default_rng(1).normal(size=(6, 7)) * 20.0
    J = np.vstack([J, np.random.default_rng(2).normal(size=(6, 7)) * 20.0])
    return np.asarray(J.reshape(2, 6, 7).repeat(pairs // 2, axis=0))


def _covariance(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance with residuals (n, 6) of n consecutive pairs of like rows, and that of independent ones."""
    pairs = len(noise)
    still, blocks = np.zeros((pairs, 6, 6)), _blocks(pairs)
    cameras: Any = tuple(SimpleNamespace(drive=0, from_ns=k, to_ns=k + 1) for k in range(pairs))
    lidars: Any = SimpleNamespace(covariances=still, twist_covariances=still)
    residuals: Any = SimpleNamespace(
        directed=np.ones(pairs, bool),
        evaluate=lambda cTl, time_offset_s, jacobians: (noise, blocks),
        jacobians_by_camera=lambda cTl, time_offset_s: blocks,
    )
    units, none = np.tile(np.eye(6), (pairs, 1, 1)), np.zeros((pairs, 6))
    terms = HandEyeTerms(MotionPairs(cameras, lidars), residuals, units, np.zeros(pairs), still, none)
    H = np.einsum("nki,nkj->ij", blocks, blocks)
    found = hand_eye_covariance(terms, State(gtsam.Pose3()), H, NOTHING_SHARED)
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


@pytest.mark.parametrize("pairs", [12, 40])
def test_sigmas_of_few_pairs_hold_as_many_errors_as_those_of_many(pairs: int) -> None:
    blocks, rng, within = _blocks(pairs), np.random.default_rng(pairs), []
    for _ in range(300):
        noise = rng.normal(size=(pairs, 6))
        at_the_estimate = noise.reshape(-1) - (rows := blocks.reshape(-1, 7)) @ (
            error := np.linalg.lstsq(rows, noise.reshape(-1), rcond=None)[0]
        )
        found, _ = _covariance(at_the_estimate.reshape(pairs, 6))
        within.append(np.abs(error) < 1.96 * np.sqrt(np.diag(found)))
    assert 0.94 < np.mean(within) < 0.985


def test_many_pairs_need_no_correction() -> None:
    assert few_pairs_factor(10_000) == pytest.approx(1.0, abs=2e-3)
    # With every lag summed, b = 1: the critical value of 5 % is 4.81 (Kiefer and Vogelsang 2002).
    assert 1.96 * np.sqrt(few_pairs_factor(4)) == pytest.approx(4.81, abs=0.02)
