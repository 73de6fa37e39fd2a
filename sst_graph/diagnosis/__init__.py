"""Likely causes of wrong results: common mistakes in the input, and the evidence for them in the data.

A check is a function of the prepared data that returns a :class:`Finding` or None. :func:`preflight` runs
those that are certain by themselves, for every calibration; :func:`likely_causes` those that explain a result
that may be wrong, among them changes of the data that would make the labels agree.
"""

from __future__ import annotations

from sst_graph.diagnosis.cameras import uncalibrated
from sst_graph.diagnosis.causes import likely_causes, mirror, preflight
from sst_graph.diagnosis.finding import INVERTED, Finding
from sst_graph.diagnosis.fit import Fitter, LabelFit
from sst_graph.diagnosis.labels import copied, few_labelled
from sst_graph.diagnosis.lasers import other_axes, unknown_lasers
from sst_graph.diagnosis.poses import other_camera

__all__ = [
    "INVERTED",
    "Finding",
    "Fitter",
    "LabelFit",
    "copied",
    "few_labelled",
    "likely_causes",
    "mirror",
    "other_axes",
    "other_camera",
    "preflight",
    "uncalibrated",
    "unknown_lasers",
]
