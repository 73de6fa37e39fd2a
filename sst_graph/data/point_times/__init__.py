"""Times of points, in whichever way and by whichever clock a driver counts them."""

from __future__ import annotations

from sst_graph.data.point_times.clock import (
    PointClock,
    ScanTimes,
    clock_of_points,
    seconds_after_stamp,
)
from sst_graph.data.point_times.seconds import FARTHEST_S, WITHOUT_TIMES, tells_nothing
from sst_graph.data.point_times.stream import StreamClock

__all__ = [
    "FARTHEST_S",
    "WITHOUT_TIMES",
    "PointClock",
    "ScanTimes",
    "StreamClock",
    "clock_of_points",
    "seconds_after_stamp",
    "tells_nothing",
]
