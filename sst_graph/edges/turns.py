"""Random rotations away from a state: what it is compared with where edges of pictures are the only data."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.edges.search import turned
from sst_graph.graph.state import State

_TURNS = 24
"""Random rotations that a state is compared with."""
_TURN_DEG = (2.0, 4.0)
"""Their angles [deg]."""


def turned_states(state: State, seed: int) -> list[State]:
    """The state turned in random ways; those with one seed are turned alike."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(_TURNS, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.radians(rng.uniform(*_TURN_DEG, _TURNS))[:, None] * axes
    poses = [gtsam.Pose3(gtsam.Rot3.ClosestTo(R), state.cTl.translation()) for R in turned(state.cTl, turns)]
    return [State(pose, state.time_offsets_s, state.biases_px) for pose in poses]
