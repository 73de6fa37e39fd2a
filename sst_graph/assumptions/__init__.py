"""What a calibration assumes: tested against the data, considered in the covariance, or estimated.

To add an assumption, define an :class:`Assumption` in a file here and append it to :data:`ASSUMPTIONS`; its
place in that order is its key in the graph and in checkpoints.
"""

import math
from collections.abc import Sequence

from sst_graph.assumptions.model import Assumption, Effect, View, combined
from sst_graph.assumptions.of_camera import CX, CY, FOCAL, K1, K2
from sst_graph.assumptions.of_lidar import ELEVATION, RANGE_BIAS, RANGE_SCALE
from sst_graph.assumptions.of_time import LINE_DELAY, SKEW, SWEEP
from sst_graph.errors import ConfigError

ASSUMPTIONS: dict[str, Assumption] = {
    assumption.name: assumption
    for assumption in (FOCAL, CX, CY, K1, K2, SWEEP, SKEW, LINE_DELAY, RANGE_BIAS, RANGE_SCALE, ELEVATION)
}
"""All assumptions by name, in the order in which they are shown."""

OF_LIDAR: tuple[str, ...] = tuple(name for name, each in ASSUMPTIONS.items() if each.of_lidar)
"""Names of those about the LiDAR; the others are about a camera or its clock."""

__all__ = [
    "ASSUMPTIONS",
    "OF_LIDAR",
    "Assumption",
    "Effect",
    "View",
    "combined",
    "held_at_zero",
    "named_sigmas",
]


def named_sigmas(texts: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Names and deviations from ``name`` (with the assumption's span) or ``name=sigma``.

    Raises:
        ConfigError: a name is no assumption's, or given twice; a deviation out of range.
    """
    found = tuple(_named_sigma(text) for text in texts)
    names = [name for name, _ in found]
    if len(set(names)) < len(names):
        raise ConfigError(f"estimate: found {', '.join(names)}, expected each name once")
    return found


def held_at_zero(estimate: Sequence[str]) -> tuple[str, ...]:
    """Names of the assumptions whose parameters are not among those that are estimated.

    Args:
        estimate: as :func:`named_sigmas` takes it.
    """
    estimated = dict(named_sigmas(estimate))
    return tuple(name for name in ASSUMPTIONS if name not in estimated)


def _named_sigma(text: str) -> tuple[str, float]:
    name, equals, number = (part.strip() for part in text.partition("="))
    if name not in ASSUMPTIONS:
        raise ConfigError(f"estimate: found {name!r:.60}, expected one of {', '.join(ASSUMPTIONS)}")
    span = ASSUMPTIONS[name].span
    if not equals:
        return name, span
    try:
        sigma = float(number)
    except ValueError:
        sigma = math.nan
    if not 1e-6 * span <= sigma <= 100.0 * span:
        expected = f"{1e-6 * span:g} to {100.0 * span:g} {ASSUMPTIONS[name].unit}".rstrip()
        raise ConfigError(f"estimate: {name}: found {number!r:.60}, expected {expected}")
    return name, sigma
