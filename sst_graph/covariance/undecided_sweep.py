"""What a sweep that the scans leave undecided adds to a covariance, and whether it matters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sst_graph.odometry.sweep import REMEDY, SweepDecision
from sst_graph.types import FloatArray

MATTERS = 0.5
"""An undecided sweep matters where it makes up more than this share of the sigma claimed for an unknown."""


@dataclass(frozen=True)
class SweepEffect:
    """The effect of one drive's sweep.

    Attributes:
        covariance: (7, 7) that it adds: mean square of the changes under the hypotheses, by their
            probability; 0 where the sweep is decided.
        sentence: that it is undecided and matters; empty where not.
    """

    covariance: FloatArray
    sentence: str = ""

    @classmethod
    def of(
        cls, decision: SweepDecision, steps: Mapping[float, FloatArray], covariance: FloatArray
    ) -> SweepEffect:
        """Of an undecided sweep.

        Args:
            steps: (7,) change of extrinsic and time offset under each hypothesis that is not excluded, by its
                fraction [rad, m, s].
            covariance: (7, 7) of the estimate without it.
        """
        if decision.kind != "undecided" or not steps:
            return cls(np.zeros((7, 7)))
        added = np.asarray(
            sum(decision.shares[fraction] * np.outer(step, step) for fraction, step in steps.items())
        )
        if np.sqrt(np.diag(added) / np.diag(covariance + added)).max() <= MATTERS:
            return cls(added)
        worst = max(steps.values(), key=lambda step: float((step**2 / np.diag(covariance)).max()))
        return cls(
            added,
            f"the scans do not show whether they are compensated ({decision.evidence}), and "
            f"it matters: {np.degrees(np.linalg.norm(worst[:3])):.2f} deg, "
            f"{100.0 * np.linalg.norm(worst[3:6]):.1f} cm, {1e3 * abs(worst[6]):.1f} ms; {REMEDY}",
        )
