"""The budget of the sigmas, as a file has it that somebody else may have written."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.considered import BUDGET
from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.budget_text import budget_lines, estimated_lines
from sst_graph.result import CalibrationResult


def _result(diagnostics: dict[str, Any]) -> CalibrationResult:
    camera = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
    return CalibrationResult(gtsam.Pose3(), 0.0, 1e-6 * np.eye(7), "ok", camera, diagnostics=diagnostics)


def test_a_part_is_a_line() -> None:
    lines = budget_lines(_result({BUDGET: {"matches": [np.radians(0.1)] * 3 + [0.02] * 3 + [1e-3]}}))
    assert lines[1].split() == ["matches", "0.100", "deg", "2.00", "cm", "1.00", "ms"]


@pytest.mark.filterwarnings("error")
def test_parts_of_a_covariance_by_edges_are_named_in_words() -> None:
    lines = budget_lines(_result({"spread": {"objects": [0.001] * 7, "samples": 16}}))
    assert len(lines) == 2 and lines[1].split("0.057 deg")[0].strip() == "which objects there are"


@pytest.mark.parametrize("value", [1e300, 10**400, float("inf"), float("nan"), -1.0, True, "1", None])
def test_what_is_no_sigma_is_left_out(value: Any) -> None:
    diagnostics = {BUDGET: {"focal": [value] * 7}, "estimated": {"focal": {"value": value, "sigma": 1.0}}}
    assert budget_lines(_result(diagnostics)) == []
    if value != -1.0:  # which is a value, though no sigma
        assert estimated_lines(_result(diagnostics)) == []


def test_a_name_is_no_escape_sequence() -> None:
    lines = budget_lines(_result({BUDGET: {"\x1b[31m": [0.0] * 7}}))
    assert all(line.isprintable() for line in lines) and "x1b" in lines[1]
