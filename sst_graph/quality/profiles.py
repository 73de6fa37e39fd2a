"""Profile likelihood along each unknown: on frozen matches, and by the score of edges of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sst_graph.association.edge_matching import PairedEdges
from sst_graph.edges.agreement import score_of_pairs
from sst_graph.factors.motion import CameraTwist
from sst_graph.fit import Profile
from sst_graph.graph.frozen_problem import FrozenPoint, FrozenProblem
from sst_graph.graph.matching import DriveEdges
from sst_graph.graph.state import State
from sst_graph.types import Calibration, FloatArray

_STEPS = (1.0, 2.0, 3.0, 4.0)
"""How far a profile goes to either side, in standard deviations."""
_FEW_STEPS = (2.0, 4.0)
"""Steps of profiles of large problems, so that these take a few seconds at most."""
_SCORE_STEPS = (0.5, 1.0, 2.0, 3.0)
"""How far a profile by the score goes to either side, in standard deviations."""
_SCORE_BLUR_PX = 1.5
"""Blur of that score [px]: that under which solutions are compared."""
_SCORE_POINTS = 60_000
"""Most points of a drive in that score."""
_BESIDE_PX = 50.0
"""Points farther than this beside the picture do not come into it by a profile's steps [px]."""
_LARGE = 20_000
"""Matches from which on a problem is large."""
REACH: FloatArray = np.array([np.radians(1.0)] * 3 + [0.5] * 3 + [0.1])
"""(7,) farthest step of a profile [rad, m, s]: beyond it, frozen matches say nothing."""


def profiles(
    frozen: FrozenProblem, optimum: FrozenPoint, sigmas: FloatArray, matches: int
) -> tuple[Profile, ...]:
    """Along the seven unknowns of a result, all other unknowns optimised again at every step.

    Args:
        optimum: of the frozen problem.
        sigmas: (7,) of the result, in which steps are counted [rad, m, s].
        matches: how many the problem has.
    """
    system = frozen.linearized(optimum)
    counts = _STEPS if matches < _LARGE else _FEW_STEPS
    found = []
    for unknown in range(7):
        unit = min(float(sigmas[unknown]), float(REACH[unknown]) / counts[-1])
        steps, costs = [0.0], [system.cost]
        for sign in (-1.0, 1.0):
            for count in counts:
                step = sign * count * unit
                # The other unknowns follow by one linear step, then by a second one from there.
                point = frozen.moved(optimum, *system.step_along(unknown, step))
                point = frozen.moved(point, *frozen.linearized(point).step_along(unknown, 0.0))
                steps.append(step)
                costs.append(frozen.linearized(point).cost)
        order = np.argsort(steps)
        profile = _profile(unknown, np.array(steps)[order], np.array(costs)[order] - min(costs))
        found.append(profile)
    return tuple(found)


def score_profiles(
    edges: Sequence[DriveEdges], state: State, covariance: FloatArray, sigmas: FloatArray
) -> tuple[Profile, ...]:
    """What the score of edges of pictures loses along the seven unknowns.

    Scan and image are paired as at the estimate, so that the score is of the same points at every step.

    Args:
        state: the estimate.
        covariance: (7, 7) of the frozen problem, by which the other unknowns follow: they would be optimised
            again if matches were frozen.
        sigmas: (7,) of the result, in which steps are counted [rad, m, s].
    """
    some = [own.thinned(_SCORE_POINTS) for own in edges]
    pairs = [
        (own.number, _near_view(paired, state.calibration(own.number)))
        for own in some
        if (paired := own.paired(state)) is not None
    ]

    def score(step: FloatArray) -> float:
        moved = state.cTl.retract(step[:6])
        clocks = tuple(offset_s + float(step[6]) for offset_s in state.time_offsets_s)
        turned = moved.compose(state.cTl.inverse()).AdjointMap()
        there = [(number, _with_motion_in(turned, paired)) for number, paired in pairs]
        return score_of_pairs(there, replace(state, cTl=moved, time_offsets_s=clocks), _SCORE_BLUR_PX)

    middle = score(np.zeros(7))
    found = []
    for unknown in range(7):
        unit = min(float(sigmas[unknown]), float(REACH[unknown]) / _SCORE_STEPS[-1])
        way = covariance[:, unknown] / covariance[unknown, unknown]
        steps = unit * np.array(_SCORE_STEPS)
        steps = np.concatenate([-steps[::-1], [0.0], steps])
        scores = np.array([middle if step == 0.0 else score(step * way) for step in steps])
        costs = scores.max() - scores
        found.append(_profile(unknown, steps, costs, float(scores.max())))
    return tuple(found)


def _profile(unknown: int, steps: FloatArray, costs: FloatArray, best_score: float | None = None) -> Profile:
    """A profile, with the Gaussian of cost step^2 / (2 sigma^2) that is nearest to its costs."""
    sigma = np.sqrt((steps**4).sum() / max(2.0 * float(steps**2 @ costs), 1e-300))
    return Profile(unknown, steps, costs, float(sigma), best_score)


def _with_motion_in(other: FloatArray, paired: PairedEdges) -> PairedEdges:
    """The pairs with the motion of another camera on the vehicle; other: (6, 6) adjoint map to its frame."""
    motion = paired.motion
    return replace(paired, motion=CameraTwist(motion.c_twist @ other.T, motion.c_acceleration @ other.T))


def _near_view(paired: PairedEdges, at: Calibration) -> PairedEdges:
    """The points that are in the picture, or may come into it."""
    camera, uvs = paired.camera, paired.projected(paired.points.lPs, at)
    size = np.array([camera.width, camera.height])
    near = ((uvs > -_BESIDE_PX) & (uvs < size + _BESIDE_PX)).all(axis=1)
    return paired.take(np.flatnonzero(near))
