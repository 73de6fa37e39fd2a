"""Updates without a matched image: before the first one, and in gaps longer than the lag of a smoother."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from alignment_streets import D, E, Street, X, isam2_params, simulated_street

from sst_graph import AlignmentKeys, IncrementalTerms, Trajectory
from sst_graph.factors import time_offset_prior
from sst_graph.slam.alignment_term import TermState
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.incremental_terms import IncrementalUpdate, Solver
from sst_graph.slam.term_warnings import WarningKind
from sst_graph.types import FloatArray

LAG_S, CONFIG = 0.35, RematchConfig(first_px=8.0, side_sigma_px=0.2)  # errors are those of the residuals
SIGMAS = (0.05, 0.1, 0.05)


@pytest.fixture(scope="module")
def street() -> Street:
    return simulated_street(5)


class Online:
    """A drive as it comes, in a smoother whose window holds four poses."""

    def __init__(
        self,
        street: Street,
        start: tuple[gtsam.Pose3, float],
        sigmas: Sequence[float] = SIGMAS,
        solver: Solver | None = None,
    ) -> None:
        self.street, self.start, self.sigmas = street, start, sigmas
        self.trajectory = Trajectory()
        self.keys = AlignmentKeys(self.trajectory, E, D)
        solver = gtsam.IncrementalFixedLagSmoother(LAG_S, isam2_params()) if solver is None else solver
        self.solver, self.terms = solver, IncrementalTerms(solver, self.keys, CONFIG)

    def update(self, k: int, with_image: bool = True) -> IncrementalUpdate:
        stamp_ns = self.street.stamps_ns[k]
        self.trajectory.append(X(k), stamp_ns)
        new = [self.street.term(k, self.keys)] if with_image else []
        given = self.street.new_at(k, self.start, self.sigmas)
        return self.terms.update(*given, new, {X(k): 1e-9 * (stamp_ns - self.street.stamps_ns[0])})

    def converge(self) -> IncrementalUpdate:
        return self.terms.converge()

    def marginal(self) -> FloatArray:
        isam = self.solver if isinstance(self.solver, gtsam.ISAM2) else self.solver.getISAM2()
        return np.asarray(isam.jointMarginalCovariance([E, D]).fullMatrix())


def kinds(update: IncrementalUpdate) -> set[WarningKind]:
    return {warning.kind for warning in update.warnings}


def sigmas_of(update: IncrementalUpdate) -> FloatArray:
    return np.asarray(np.sqrt(np.diag(update.covariance)))


@pytest.mark.parametrize(
    ("sigmas", "kind"),
    [((0.005, 0.02, 0.005), WarningKind.FAR_FROM_START), ((1.0, 1.0, 1.0), WarningKind.WIDE_UNCERTAINTY)],
)
def test_the_start_stays_the_one_before_the_first_matches(
    street: Street, sigmas: tuple[float, ...], kind: WarningKind
) -> None:
    """The images contradict narrow priors, wide ones tell nothing; after a gap the estimate holds those
    before it."""
    online = Online(street, street.start(1), sigmas)
    for k in range(7):
        online.update(k)
    assert kind in kinds(online.converge())
    for k in range(7, 13):
        online.update(k, with_image=False)
    assert not online.update(13).values.exists(X(6))
    online.update(14)
    assert kind in kinds(online.converge())


def test_before_the_first_image_the_covariance_is_that_of_the_other_factors(street: Street) -> None:
    for solver in (gtsam.ISAM2(isam2_params()), None):
        online = Online(street, street.start(1), solver=solver)
        for k in range(2):
            update = online.update(k, with_image=False)
            np.testing.assert_allclose(sigmas_of(update), np.repeat(SIGMAS, (3, 3, 1)), rtol=1e-6)
            assert not update.converged and update.rematched == 0


def test_a_gap_changes_neither_covariance_nor_convergence(street: Street) -> None:
    """Whatever is asked for in it; what was known before is known still, and nothing more."""
    online = Online(street, (street.cTl, street.time_offset_s))
    for k in range(8):
        online.update(k)
    online.converge()
    online.update(8)
    later = [online.update(k, with_image=False) for k in range(9, 15)]
    before, gap = [update for update in later if update.values.exists(X(8))][-1], later[-1]
    asked = online.converge()
    assert before.converged and not gap.values.exists(X(9))
    assert gap.rematched == 0 and not gap.waiting
    for each in (gap, asked):
        assert each.converged and each.kernel_px == CONFIG.last_px
        np.testing.assert_allclose(sigmas_of(each), sigmas_of(before), rtol=0.02)
    # errors that matches share are in it: the solver's own marginal is another
    P = online.marginal()
    assert (sigmas_of(gap) > 1.02 * np.sqrt(np.diag(P))).any()
    online.update(15)
    after = [online.update(k) for k in (16, 17)][-1]
    assert after.converged and (sigmas_of(after) < sigmas_of(gap) * 1.02).all()


def test_a_gap_keeps_its_warnings(street: Street) -> None:
    online = Online(street, street.start(1), (0.005, 0.02, 0.005))
    for k in range(7):
        online.update(k)
    before = online.converge()
    for k in range(7, 13):
        gap = online.update(k, with_image=False)
    assert {WarningKind.FAR_FROM_START} <= kinds(before) & kinds(gap)


@pytest.mark.parametrize("kind", ["ISAM2", "smoother"])
def test_a_term_before_the_trajectory_waits(street: Street, kind: str) -> None:
    """An offset that begins 80 ms early has the first image before the first pose, until it is known."""
    start = street.cTl, street.time_offset_s - 0.08
    for steps in (2, 6):  # until the first pose has left the smoother
        solver = gtsam.ISAM2(isam2_params()) if kind == "ISAM2" else None
        online = Online(street, start, (0.05, 0.1, 0.1), solver)
        for k in range(steps):
            update = online.update(k, with_image=k == 0)
        assert update.values.exists(X(0)) == (kind == "ISAM2" or steps == 2)
        waits = update.values.exists(X(0))
        assert update.waiting == ({TermState.BEFORE_TRAJECTORY: 1} if waits else {})
        assert update.rematched == 0 and not update.converged
        told = gtsam.NonlinearFactorGraph()
        told.add(time_offset_prior(D, street.time_offset_s, 1e-4))
        after = online.terms.update(told, gtsam.Values())
        assert not after.waiting and (after.rematched > 0) == waits


def test_images_that_show_nothing_are_said(street: Street) -> None:
    """Most of a window without a factor: the estimate lives on what has left."""
    empty = tuple(image.with_contours({}) for image in street.images)
    blind = replace(street, images=street.images[:7] + empty[7:])
    online = Online(blind, (street.cTl, street.time_offset_s))
    for k in range(8):
        online.update(k)
    seen = online.converge()
    for k in range(8, 12):
        online.update(k)
    blinded = online.converge()
    assert WarningKind.NO_MATCHES not in kinds(seen)
    assert WarningKind.NO_MATCHES in kinds(blinded)
