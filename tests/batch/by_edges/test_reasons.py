"""Which reason against an estimate by edges is said first."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.batch.by_edges.reasons import (
    EdgeContrast,
    contrast_reasons,
    edges_reasons,
    pose_reasons,
    with_lens_reasons,
)
from sst_graph.graph.state import State

LENS = ("the pictures look distorted: k1 = -0.1 ± 0.017",)


def test_a_lens_is_blamed_first_where_the_pose_is_right() -> None:
    right = EdgeContrast(score=500.0, sigmas=12.0, ratio=2.0, other=300.0)
    of_pose = contrast_reasons(right)
    assert with_lens_reasons(("farther edges",), LENS, of_pose) == (*LENS, "farther edges")


def test_a_pose_that_may_be_wrong_altogether_is_said_before_its_lens() -> None:
    for doubtful in (
        EdgeContrast(score=500.0, sigmas=4.7, ratio=1.1, other=0.0),
        EdgeContrast(score=502.0, sigmas=12.0, ratio=2.0, other=476.0),
    ):
        reasons = tuple(contrast_reasons(doubtful))
        assert len(reasons) == 1 and with_lens_reasons(reasons, LENS, reasons) == (*reasons, *LENS)


@pytest.mark.parametrize(("pitch_deg", "contradicts"), [(0.3, False), (0.7, False), (1.5, True)])
def test_a_pitch_that_motion_knows_better_is_contradicted(pitch_deg: float, contradicts: bool) -> None:
    """Motion knows pitch to 0.1 deg, the estimate claims 0.16 deg; of roll it knows little."""
    truth = State(gtsam.Pose3(), (0.05,))
    step = np.array([*np.radians([3.0, pitch_deg, 0.0]), 0.0, 0.0, 0.0, 0.0])
    sigmas = np.array([*np.radians([3.0, 0.1, 0.1]), 0.3, 0.3, 0.3, 0.003])
    motion: Any = SimpleNamespace(state=truth, covariance=np.diag(sigmas**2), misfit=None)
    own = np.diag(np.array([*np.radians([0.16] * 3), 0.02, 0.02, 0.02, 0.004]) ** 2)
    solution: Any = SimpleNamespace(state=truth.moved(step), converged=True)
    right = EdgeContrast(score=500.0, sigmas=12.0, ratio=2.0, other=300.0)
    of_pose = pose_reasons(solution.state, right, motion, own)
    reasons = edges_reasons(solution, of_pose, truth)
    assert any("motion alone gives another calibration" in reason for reason in reasons) == contradicts
    # Pictures of the camera beside lead to such a pose, and to a wrong principal point that fits it.
    first = with_lens_reasons(reasons, LENS, of_pose)[0]
    assert (first in of_pose) == contradicts and (first in LENS) != contradicts
