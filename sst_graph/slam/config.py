"""Schedule of matching alignment terms again, and the bounds of their information."""

from __future__ import annotations

from dataclasses import dataclass, field

from sst_graph.config import Settings, setting
from sst_graph.covariance.observability import ObservabilityConfig

NARROWING = 0.7
"""From one scale of the kernel to the next: the next matches lie within the last kernel."""
CALM = 0.1
"""The kernel is narrowed when a round has moved the matched points by less than this share of it (RMS)."""


@dataclass(frozen=True)
class RematchConfig(Settings):
    """Kernels, rounds of matching, and how sure the result may be.

    Attributes:
        first_px: scale of the robust kernel at the start [px].
        last_px: its scale at the end [px].
        most_rounds: rounds of matching, at most.
        side_sigma_px: least error that a side of an object keeps over all images that show it [px].
        observability: directions known worse than this are reported.
    """

    first_px: float = setting(40.0, at_least=0.1, at_most=1000.0)
    last_px: float = setting(4.0, at_least=0.1, at_most=1000.0)
    most_rounds: int = setting(60, at_least=1, at_most=10_000)
    side_sigma_px: float = setting(1.0, at_least=0.0, at_most=100.0)
    observability: ObservabilityConfig = field(default_factory=ObservabilityConfig)

    def __post_init__(self) -> None:
        self.expect_at_most("last_px", self.first_px, "first_px")

    def narrower(self, kernel_px: float) -> float:
        """The next scale of the kernel [px]."""
        return max(self.last_px, NARROWING * kernel_px)
