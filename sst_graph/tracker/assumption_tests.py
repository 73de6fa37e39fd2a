"""Score tests of the assumptions in the tracker, from its sums.

What leaves the window is kept as one Gaussian on the unknowns x and the parameters of all assumptions
(:class:`~sst_graph.tracker.window.gaussian.Gaussian`), and as sums of the scores of sides over both.
With H the information of past and window on [x, theta], g its vector at the estimate and a = [-H_xx^-1 H_xt,
1], the score of theta with all unknowns free is a'g, its variance a'(H + S)a where S is what clusters of
matches and shifts from image to image add, and

    theta = a'g / (a'H a / f + s^-2)

is one Newton step: f is the mean robust weight over the mean curvature, s the span of the parameter. The
threshold, and what few objects make of it, are the batch's (:mod:`sst_graph.batch.assumption_tests`).
There is no jackknife over objects: where an assumption is wrong, the residuals of all objects show it.
"""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.assumption_tests import ParameterTest, few_objects_factor
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.jackknife import bounded_ratio
from sst_graph.tracker.window.gaussian import inverted
from sst_graph.tracker.window.smoother import WindowSmoother

EVERY = 10
"""Scans between two tests: they cost about as much as the covariance, which each frame has."""


def score_findings(smoother: WindowSmoother, config: AssumptionConfig) -> tuple[ParameterTest, ...]:
    """Score test of each assumption that the matches determine, the most contradicted first; none where the
    settings want none.

    Raises:
        EstimationError: a direction without any information.
    """
    if not config.test:
        return ()
    H, g, n = smoother.information(), smoother.vector(), smoother.past.point.size
    follows = -(inverted(H[:n, :n]) @ H[:n, n:])
    A = np.concatenate([follows, np.eye(smoother.past.held)])
    score, information = A.T @ g, np.einsum("nk,nm,mk->k", A, H, A)
    sums = smoother.sums_on_last_epoch()
    beyond = sums.excess(smoother.model, with_held=True) + sums.shift_excess.sum(axis=0)
    excess = np.einsum("nk,nm,mk->k", A, beyond, A)
    spans = {name: assumption.span for name, assumption in ASSUMPTIONS.items()}
    before = np.array([spans.get(name, 1.0) ** -2.0 for name in smoother.held_names])
    curvature = np.maximum(information, 0.0) / bounded_ratio(sums.weight_curvature_ratio) + before
    values = score / curvature
    sigmas = np.sqrt(np.maximum(information + excess, 0.0) + before) / curvature
    sigmas *= few_objects_factor(smoother.objects, config.threshold)
    found = []
    for place, name in enumerate(smoother.held_names):
        assumption = ASSUMPTIONS.get(name)
        if assumption is None or not assumption.by_matches:
            continue
        value, sigma = float(values[place]), float(sigmas[place])
        found.append(ParameterTest.of(assumption, value, sigma, config.threshold))
    return tuple(sorted(found, key=lambda finding: -finding.score))
