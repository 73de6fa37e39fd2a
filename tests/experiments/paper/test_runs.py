"""A run, and which settings it is keyed by."""

from __future__ import annotations

from dataclasses import replace

from sst_graph.batch import CalibrationConfig
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.drives import TableDrive
from sst_graph.experiments.paper.runs import Case


def test_a_run_is_keyed_by_what_it_depends_on() -> None:
    config = PaperTableConfig()
    case = Case(TableDrive("street 0", street=0), 1, 0, "static")
    key = case.key(config)
    same = replace(config, jobs=4, streets=3, starts=9, methods=("paper",), plot=False, failed_deg=1.0)
    assert case.key(same) == key
    cases = [replace(case, start=1), replace(case, images_late=2), replace(case, method="static-single")]
    cases += [replace(case, drive=TableDrive("street 1", street=1, seed=1)), replace(case, method="start")]
    cases.append(replace(case, drive=TableDrive("x", path="/x")))
    configs = [replace(config, start_deg=5.0), replace(config, frames=20), replace(config, label_noise=0.0)]
    configs.append(replace(config, calibration=CalibrationConfig(seed=1)))
    keys = [key, *(other.key(config) for other in cases), *(case.key(other) for other in configs)]
    assert len(set(keys)) == len(keys)
