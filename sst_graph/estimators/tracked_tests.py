"""Do the data contradict what a tracker takes for granted? Score tests from its sums, at any time.

What leaves the window is kept as one belief on the unknowns x that carries the parameters of all assumptions
along (:class:`~sst_graph.estimators.gaussian.Gaussian`), and as sums of the scores of sides over both. With H
the information of past and window on [x, theta], g its vector at the estimate and a = [-H_xx^-1 H_xt, 1], the
score of theta with all unknowns free is a'g, its variance a'(H + S)a where S is what clusters of matches add
(:mod:`sst_graph.uncertainty.covariance`), and

    theta = a'g / (a'H a / f + s^-2)

is one Newton step: f is the mean robust weight over the mean curvature, s the parameter's span. The
threshold, and what few objects make of it, are the batch's (:mod:`sst_graph.estimators.assumption_tests`).
"""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.errors import EstimationError
from sst_graph.estimators.assumption_tests import Finding, few_objects
from sst_graph.estimators.gaussian import scaled_inverse
from sst_graph.estimators.smoother import WindowSmoother
from sst_graph.uncertainty.assumptions import AssumptionConfig
from sst_graph.uncertainty.object_spread import believed_flatness

EVERY = 10
"""Scans between two tests: they cost about as much as the covariance, which each frame has."""


def score_findings(smoother: WindowSmoother, config: AssumptionConfig) -> tuple[Finding, ...]:
    """What the data so far say of each assumption that the matches test, the most contradicted first.

    Raises:
        EstimationError: a direction without any information.
    """
    whole, n = smoother.whole(), smoother.past.point.size
    H, g = whole.information, whole.vector
    try:
        follows = -(scaled_inverse(H[:n, :n]) @ H[:n, n:])
    except np.linalg.LinAlgError as error:
        raise EstimationError(str(error)) from error
    A = np.concatenate([follows, np.eye(whole.held)])
    score, information = A.T @ g, np.einsum("nk,nm,mk->k", A, H, A)
    surplus = np.einsum("nk,nm,mk->k", A, smoother.surplus(with_held=True), A)
    flatness = believed_flatness(smoother.flatness)
    wider = few_objects(smoother.objects, config.threshold)
    found = []
    for place, name in enumerate(smoother.held_names):
        assumption = ASSUMPTIONS[name]
        if not assumption.by_matches:
            continue
        before = assumption.span**-2.0
        curvature = max(float(information[place]), 0.0) / flatness + before
        variance = max(float(information[place] + surplus[place]), 0.0) + before
        value, sigma = float(score[place]) / curvature, float(np.sqrt(variance)) / curvature * wider
        contradicted = abs(value) > config.threshold * sigma
        found.append(Finding(assumption, value, sigma, value * follows[:7, place], contradicted))
    return tuple(sorted(found, key=lambda finding: -abs(finding.value) / finding.sigma))


class AssumptionTests:
    """When a running tracker tests what it takes for granted, and what it has found.

    Attributes:
        findings: of the last test, the most contradicted first.
    """

    def __init__(self, config: AssumptionConfig) -> None:
        self.config = config
        self.findings: tuple[Finding, ...] = ()

    def restart(self) -> None:
        """A new calibration begins."""
        self.findings = ()

    def take(self, scan: int, smoother: WindowSmoother) -> None:
        """The smoother knows a scan of this number."""
        if scan % EVERY == 0:
            self.look(smoother)

    def look(self, smoother: WindowSmoother) -> None:
        """Test now.

        Raises:
            EstimationError: a direction without any information.
        """
        if self.config.test:
            self.findings = score_findings(smoother, self.config)
