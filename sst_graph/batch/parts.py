"""Answers of parts of the data by themselves: each solved anew from the answer of all, under wide kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.covariance.considered import AssumptionConfig, consider
from sst_graph.covariance.contradiction import PartAnswer
from sst_graph.covariance.static_objects import static_covariance
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import Tracks
from sst_graph.graph.matching import match_all, outlines_of
from sst_graph.graph.outer_loop import JointConfig, JointSolution, robust_weights, solve_joint
from sst_graph.graph.state import State
from sst_graph.hand_eye.solution import difference
from sst_graph.objects.tracks import ObjectId, tracks_of_scans

FloatArray = NDArray[np.float64]


_SETTLING = 3
"""Most further outer iterations at the last kernel scale: what is left of a step then is within a sigma."""


@dataclass(frozen=True)
class Part:
    """Some scans of one drive, by position, rising."""

    drive: int
    scans: tuple[int, ...]


@dataclass(frozen=True)
class SolvedPart:
    """A part and what it says by itself.

    Attributes:
        part: which.
        state: its own answer, on one clock.
        answer: the same as a step from the reference, with its covariance.
    """

    part: Part
    state: State
    answer: PartAnswer


@dataclass(frozen=True)
class Parts:
    """Drives whose parts are to be solved.

    Attributes:
        drives: all of them.
        tracks: with object tracks where objects have mask biases.
        objects: tracks of each drive's objects.
        reference: the answer of all drives together, where the parts start and what their weak priors are
            centred on.
        joint: settings of the joint method.
        assumptions: what each part's covariance has beside its matches.
        kernel_px: scales of the robust kernel of a part's solution, as in :class:`JointConfig` [px].
    """

    drives: Sequence[Drive]
    tracks: Tracks
    objects: Sequence[dict[ObjectId, int]]
    reference: State
    joint: JointConfig
    assumptions: AssumptionConfig
    kernel_px: tuple[float, ...] = (20.0, 12.0, 8.0, 5.0, 4.0, 3.0)

    def solve(self, part: Part) -> SolvedPart | None:
        """A part's own answer, from the reference; None where it has none."""
        return self._solved(part, self.reference_of(part), self.kernel_px)

    def solve_from(self, part: Part, start: State) -> SolvedPart | None:
        """The same from a start that is nearly right."""
        return self._solved(part, start, self.kernel_px[len(self.kernel_px) // 2 :])

    def best_start(self, part: Part, starts: Sequence[State]) -> State:
        """Of the reference and other states that which the part agrees with most."""
        candidates = [self.reference_of(part), *starts]
        return max(candidates, key=lambda start: float(self.support(part, start).sum()))

    def _solved(self, part: Part, start: State, kernel_px: tuple[float, ...]) -> SolvedPart | None:
        joint = replace(self.joint, kernel_px=kernel_px, max_outer=len(kernel_px) + _SETTLING)
        drive, tracks = self.drives[part.drive].part(part.scans), self.tracks.part(part.drive, part.scans)
        try:
            solution = solve_joint([drive], start, joint, guess=self.reference_of(part), tracks=tracks)
            return SolvedPart(part, solution.state, self._answer(part, solution))
        except (EstimationError, np.linalg.LinAlgError):
            return None

    def reference_of(self, part: Part) -> State:
        """The reference on the part's clock alone."""
        return State(self.reference.cTl, (self.reference.offset_s(part.drive),))

    def _answer(self, part: Part, solution: JointSolution) -> PartAnswer:
        state = solution.state
        objects = [tracks_of_scans(self.objects[part.drive], part.scans)]
        robust = robust_covariance(solution.graph, solution.values, solution.pairs, state, objects)
        beside = consider(robust, solution.pairs, solution.values, state, self.assumptions).covariance(7)
        # What moving objects alone tell is not called known: a vehicle that brakes looks like another offset.
        covariance = static_covariance(robust, solution.pairs)[:7, :7] + beside
        weights = np.bincount(robust.table.sides, robust.table.root_weights**2)
        clusters = float(weights.sum() ** 2 / max(float(weights @ weights), 1e-12))
        return PartAnswer(difference(self.reference_of(part), state), covariance, clusters)

    def support(self, part: Part, state: State) -> FloatArray:
        """(scans,) how much each scan of a part agrees with a state: matches, counted by robust weight."""
        drive, tracks = self.drives[part.drive].part(part.scans), self.tracks.part(part.drive, part.scans)
        kernel = RobustKernel("geman_mcclure", self.kernel_px[-1])
        found = np.zeros(len(part.scans))
        for own in match_all(outlines_of([drive], tracks, self.joint.graph), state, kernel):
            scans = np.array([pair.scan for pair in own.pairs])[own.pair_of]
            found += np.bincount(scans, robust_weights(own, state), len(found))
        return found
