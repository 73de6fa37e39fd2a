"""The calibration over time: every epoch, smoothed over all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sst_graph.graph.linear import scaled_inverse
from sst_graph.tracker.window.epochs import RetiredEpoch
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import Calibration, FloatArray

MAX_EPOCHS = 5000
"""Epochs kept for smoothing: nearly an hour and a half, at some kilobytes each."""


@dataclass(frozen=True, eq=False)
class HistoryEntry(Calibration):
    """The smoothed calibration of one epoch.

    Attributes:
        stamp_ns: its first scan's stamp.
        covariance: (7, 7), cluster-robust epoch by epoch.
    """

    stamp_ns: int = field(kw_only=True)
    covariance: FloatArray = field(kw_only=True)


def smoothed_epochs(past: Iterable[RetiredEpoch], smoother: WindowSmoother) -> list[HistoryEntry]:
    """The calibration of each epoch given all of them: those that have left the window, then its own."""
    epochs = [*past, *smoother.live_epochs()]
    walks = [smoother.walk(a, b) for a, b in pairwise(epochs)]
    point = smoother.point.core()
    gaussians = [_cluster_robust(epoch, point) for epoch in epochs]
    forward = _messages(gaussians, walks, smoother.prior)
    nothing = Gaussian(point, np.zeros((point.size, point.size)), np.zeros(point.size))
    backward = _messages(gaussians[::-1], walks[::-1], nothing)[::-1]
    entries = []
    for epoch, own, a, b in zip(epochs, gaussians, forward, backward, strict=True):
        total = own.plus(a).plus(b)
        best = total.mean()
        covariance = scaled_inverse(total.information)[:7, :7]
        entries.append(
            HistoryEntry(best.cTl, best.time_offset_s, stamp_ns=epoch.start_ns, covariance=covariance)
        )
    return entries


def _messages(gaussians: Sequence[Gaussian], walks: Sequence[FloatArray], first: Gaussian) -> list[Gaussian]:
    """Gaussian on each epoch by those before it, through the random walk."""
    messages = [first]
    for own, walk in zip(gaussians[:-1], walks, strict=True):
        messages.append(own.plus(messages[-1]).drifted(walk))
    return messages


def _cluster_robust(epoch: RetiredEpoch, point: Point) -> Gaussian:
    """The epoch's Gaussian with its cluster-robust information: H M^-1 H, M = H + excess."""
    own = epoch.information.at(point)
    H = own.information
    diagonal = np.diag(H)
    if not (diagonal > 0.0).any():
        return own
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max()))
    K = H * np.outer(scale, scale)
    M = K + epoch.excess * np.outer(scale, scale) + 1e-9 * np.eye(len(H))
    shrink = np.linalg.solve(M, K).T  # K M^-1
    information = shrink @ K / np.outer(scale, scale)
    vector = (shrink @ (own.vector * scale)) / scale
    return Gaussian(point, 0.5 * (information + information.T), vector)
