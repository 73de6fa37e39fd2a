"""Whether frames past the alarm's threshold mean that the calibration has changed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from factors.robust import RobustKernel
from sst_graph.estimators.alarm import Joint, StepAlarm
from sst_graph.estimators.gaussian import Point
from sst_graph.estimators.matcher import WindowMatcher
from sst_graph.uncertainty.covariance import ErrorModel


@dataclass(frozen=True)
class Watch:
    """The latest frames under the alarm's wide kernel.

    Attributes:
        scans: the frames that are compared together.
        restless: tracks of objects that moved lately; they are not asked.
    """

    matcher: WindowMatcher
    alarm: StepAlarm
    scans: Collection[int]
    restless: Collection[int]

    def is_change(self, before: Point, joint: Joint, model: ErrorModel) -> bool:
        """Whether they speak against the estimate before them, with any one object left out, too.

        Where a single object says so, its labels may err for a while. With one object in view, or one that
        tells far more than the others, that is not decidable.
        """
        config = self.alarm.config
        kernel = RobustKernel("geman_mcclure", config.kernel_px)

        def value(*without: int) -> float:
            scores = self.matcher.scores(before, self.scans, kernel, {*without, *self.restless})
            return self.alarm.value(scores, joint, model)

        whole, asked = value(), self.matcher.objects_of(self.scans) - set(self.restless)
        least = max(config.chi2, config.others * whole)
        return whole > least and all(value(track) > least for track in asked)
