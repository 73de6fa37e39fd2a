"""The experiment on the share of close points: a small run."""

from __future__ import annotations

from dataclasses import replace

import pytest
from streets import CROWDED_STREET

from sst_graph import CalibrationConfig
from sst_graph.experiments.fit import FitTableConfig, run


@pytest.mark.slow
def test_a_turned_calibration_has_fewer_close_points() -> None:
    street = replace(CROWDED_STREET, frames=6)
    config = FitTableConfig(seeds=(5000,), label_noises=(1.0,), turn_deg=1.0, street=street)
    steps: list[tuple[str, int, int]] = []
    *_, row = run(config, lambda *step: steps.append(step)).splitlines()
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    estimate, truth, allowed, *turned = [float(cell.split(" %")[0]) for cell in cells[3:9]]
    assert cells[:2] == ["1", "5000"] and steps == [("streets", 1, 1)]
    assert abs(allowed - truth) < 6.0 and estimate > 50.0
    assert max(turned[1:]) < 0.7 * estimate


@pytest.mark.slow
def test_by_edges_there_is_a_share_at_random_rotations() -> None:
    street = replace(CROWDED_STREET, frames=6)
    calibration = CalibrationConfig(method="edges")
    config = FitTableConfig((5000,), (1.0,), turn_deg=1.0, street=street, calibration=calibration)
    head, lines, row = run(config).splitlines()
    assert head.endswith("| at random rotations |") and head.count("|") == lines.count("|") == row.count("|")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    estimate, by_chance = (float(cells[k].split(" %")[0]) for k in (3, 10))
    assert estimate > 1.5 * by_chance > 0.0
