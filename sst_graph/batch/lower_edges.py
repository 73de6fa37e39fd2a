"""Edges towards the ground, which are matched only where image and LiDAR labels agree about them.

They determine roll and height better than any other edge. But some labels end an object at its body, others
at its shadow, or cut straight across the gap between the wheels, and a LiDAR sees below it. Only the
data show which: where the two sorts of labels agree, most lower edges lie within the narrow kernel of
the last iterations; where they do not, distances are spread as widely as a kernel can see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sst_graph.association.edge_matching import BOTTOM
from sst_graph.batch.config import UseLowerEdges
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.matching import edges_of
from sst_graph.graph.outer_loop import (
    JointConfig,
    JointProblem,
    JointSolution,
    close_and_wide_matches,
    solve_all,
    support_of,
)
from sst_graph.graph.state import State
from sst_graph.types import SemanticClass

MIN_CONCENTRATION = 0.7
"""Share of the support under a kernel five times as wide that must remain under the last one: labels that
agree leave 0.67 to 0.83 (simulated streets), others 0.45 to 0.68 (real drives; docs/results/accuracy.md)."""
MIN_SUPPORT = 30.0
"""Least matches under the last kernel, each counted by its robust weight: a share of fewer says little."""
_KERNELS_PX = (5.0, 4.0, 3.0)
"""Scales of the robust kernel with the lower edges, outer iteration by outer iteration [px]: the last ones of
the joint method, for the solution without them is near."""


@dataclass(frozen=True)
class WithLowerEdges:
    """Joint solutions after their lower edges were tested.

    Attributes:
        solutions: with them among the matches, or as they were; the one that agrees best first.
        joint: settings that lead to it.
        concentration: of the lower edges of each class that has any.
    """

    solutions: Sequence[JointSolution]
    joint: JointConfig
    concentration: Mapping[SemanticClass, float] = field(default_factory=dict)


def with_lower_edges(
    problem: JointProblem,
    finals: Sequence[tuple[JointSolution, State]],
    use: UseLowerEdges,
    progress: Progress | None = None,
) -> WithLowerEdges:
    """Joint solutions with the edges towards the ground, of classes whose labels agree about them.

    Args:
        finals: solutions without them, the best first, and what the weak priors of each are centred on.

    Raises:
        EstimationError: too few matches at any step.
    """
    solutions, joint = [solution for solution, _ in finals], problem.config
    if use == "never":
        return WithLowerEdges(solutions, joint)
    support = lower_edge_support(problem.drives, problem.motions, solutions[0].state, joint)
    chosen, concentration = support.agreed(use)
    if not chosen:
        return WithLowerEdges(solutions, joint, concentration)
    joint = replace(joint, graph=replace(joint.graph, lower_edges=chosen))
    starts = [(one.state, centre) for one, centre in finals]
    fuller = solve_all(replace(problem, config=joint), starts, _KERNELS_PX, progress)
    return WithLowerEdges(fuller, joint, concentration)


@dataclass(frozen=True)
class LowerEdgeSupport:
    """Support of each class's lower edges: the matches, each counted by its robust weight.

    Attributes:
        narrow, wide: under the last kernel and under a wide one.
    """

    narrow: Mapping[SemanticClass, float] = field(default_factory=dict)
    wide: Mapping[SemanticClass, float] = field(default_factory=dict)

    def plus(self, other: LowerEdgeSupport) -> LowerEdgeSupport:
        """Support by these scans and others together."""
        return LowerEdgeSupport(_summed(self.narrow, other.narrow), _summed(self.wide, other.wide))

    def agreed(
        self, use: UseLowerEdges, min_support: float = MIN_SUPPORT
    ) -> tuple[tuple[SemanticClass, ...], dict[SemanticClass, float]]:
        """Classes whose labels agree, and the share of the wide support that remains under the last kernel.

        Classes with too little support under the last kernel are left out.
        """
        concentration = {
            c: self.narrow[c] / self.wide[c] for c in sorted(self.narrow) if self.narrow[c] >= min_support
        }
        least = MIN_CONCENTRATION if use == "auto" else 0.0
        return tuple(c for c, share in concentration.items() if share >= least), concentration


def _summed(a: Mapping[SemanticClass, float], b: Mapping[SemanticClass, float]) -> dict[SemanticClass, float]:
    return {c: a.get(c, 0.0) + b.get(c, 0.0) for c in {*a, *b}}


def lower_edge_support(
    drives: Sequence[Drive], motions: Sequence[DriveMotion], state: State, joint: JointConfig
) -> LowerEdgeSupport:
    """Support of the lower edges of some scans at a state."""
    classes = {c for drive in drives for scan in drive.scans for c in scan.lower_edges}
    graph = replace(joint.graph, lower_edges=tuple(sorted(classes)))
    edges = edges_of(drives, motions, graph)
    return LowerEdgeSupport(
        *(support_of(matches, state, BOTTOM) for matches in close_and_wide_matches(edges, state))
    )
