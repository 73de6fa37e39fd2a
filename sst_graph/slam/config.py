"""When alignment terms are matched again, under which kernel, and how sure they may be."""

from __future__ import annotations

from dataclasses import dataclass, field

from sst_graph.config import Settings, setting
from sst_graph.covariance.observability import ObservabilityConfig


@dataclass(frozen=True)
class RematchConfig(Settings):
    """When to match again, under which kernel, and how sure to be.

    Attributes:
        first_px: scale of the robust kernel at the start [px].
        last_px: its scale at the end [px].
        narrowing: from one scale to the next, below 1.
        settled: the kernel is narrowed when a round has moved the matched points by less than this share of
            it (RMS).
        step_px: at the last scale, a round that moves them by less ends the loop (RMS) [px]; matches that
            come and go in turn move them by a few hundredths for ever.
        most_rounds: rounds of matching, at most.
        inner_iterations: Levenberg-Marquardt iterations on frozen matches, at most.
        side_sigma_px: least error that a side of an object keeps over all images that show it [px].
        observability: directions known worse than this are told.
    """

    first_px: float = setting(40.0, at_least=0.1, at_most=1000.0)
    last_px: float = setting(4.0, at_least=0.1, at_most=1000.0)
    narrowing: float = setting(0.7, at_least=0.01, at_most=0.99)
    settled: float = setting(0.1, at_least=0.0, at_most=10.0)
    step_px: float = setting(0.1, at_least=0.0, at_most=100.0)
    most_rounds: int = setting(60, at_least=1, at_most=10_000)
    inner_iterations: int = setting(4, at_least=1, at_most=1000)
    side_sigma_px: float = setting(1.0, at_least=0.0, at_most=100.0)
    observability: ObservabilityConfig = field(default_factory=ObservabilityConfig)

    def __post_init__(self) -> None:
        self.expect_at_most("last_px", self.first_px, "first_px")

    def narrower(self, kernel_px: float) -> float:
        return max(self.last_px, self.narrowing * kernel_px)
