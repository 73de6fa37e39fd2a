"""The clouds are compensated for the motion during the sweep, or bring the time of each point."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _effect(view: View) -> Effect:
    """The share of the sweep that is left: a point at azimuth a was measured a / (2 pi) of a turn away.

    Clockwise from above, forward at the stamp: a point to the left comes before it. Where the points
    have times, the share of them that is missing.
    """
    if view.offsets_s.any():
        return Effect(time_s=-view.offsets_s)
    azimuth = np.arctan2(view.lPs[:, 1], view.lPs[:, 0])
    return Effect(time_s=azimuth / (2.0 * np.pi) * view.period_s)


SWEEP = Assumption(
    name="sweep",
    unit="",
    effect=_effect,
    sigma=0.03,
    source="compensation with the odometry of the vehicle: 3 % of its speed",
    span=1.0,
    of_lidar=True,
    violation="the clouds are not compensated as assumed (share of a clockwise sweep that is left)",
    by_matches=False,
    remedy="say how the clouds were made with --sweep, or give the time of each point",
)
