"""Updates without a matched image: before the first one, and in gaps longer than the lag of a smoother."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import pytest
from alignment_streets import D, E, Street, X, isam2_params, simulated_street

from sst_graph import AlignmentKeys, IncrementalTerms, Trajectory
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.incremental_terms import IncrementalUpdate, Solver
from sst_graph.slam.term_warnings import WarningKind

LAG_S, CONFIG = 0.35, RematchConfig(first_px=8.0)
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
        self.terms = IncrementalTerms(solver, self.keys, CONFIG)

    def update(self, k: int, with_image: bool = True) -> IncrementalUpdate:
        stamp_ns = self.street.stamps_ns[k]
        self.trajectory.append(X(k), stamp_ns)
        new = [self.street.term(k, self.keys)] if with_image else []
        given = self.street.new_at(k, self.start, self.sigmas)
        return self.terms.update(*given, new, {X(k): 1e-9 * (stamp_ns - self.street.stamps_ns[0])})

    def converge(self) -> IncrementalUpdate:
        return self.terms.converge()


def kinds(update: IncrementalUpdate) -> set[WarningKind]:
    return {warning.kind for warning in update.warnings}


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
