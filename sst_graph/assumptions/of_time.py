"""Times are those of the stamps: clocks of one rate, rows exposed at once, no motion within a sweep."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _skew(view: View) -> Effect:
    """The time offset grows by one second a second."""
    return Effect(time_s=np.full(len(view.lPs), view.image_s))


def _line_delay(view: View) -> Effect:
    """A row is exposed one second after the row above; the middle row has the picture's stamp."""
    rows = view.uvs[:, 1] - 0.5 * (view.camera.height - 1)
    return Effect(time_s=np.where(np.isfinite(rows), rows, 0.0))


SKEW = Assumption(
    name="skew",
    unit="s/s",
    effect=_skew,
    sigma=1e-6,
    source="synchronised clocks (PTP, GPS) drift less; free quartz clocks 2e-5",
    span=0.05,
    violation="one clock runs faster than the other, or exposures change: the time offset grows",
    remedy="synchronise the clocks, or estimate the skew with --estimate skew",
    misleads_motion=True,
)
LINE_DELAY = Assumption(
    name="line_delay",
    unit="s",
    effect=_line_delay,
    sigma=1e-7,
    source="global shutter; rolling shutters take 1e-5 to 5e-5 s a row",
    span=1e-4,
    prevalence=0.1,  # of the cameras on vehicles most have a global shutter
    violation="rows of the pictures are exposed one after the other (rolling shutter)",
    remedy="use a camera with a global shutter, or estimate it with --estimate line_delay",
)


def _sweep(view: View) -> Effect:
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
    effect=_sweep,
    sigma=0.03,
    source="compensation with the odometry of the vehicle: 3 % of its speed",
    span=1.0,
    of_lidar=True,
    violation="the clouds are not compensated as assumed (share of a clockwise sweep that is left)",
    by_matches=False,
    remedy="say how the clouds were made with --sweep, or give the time of each point",
)
