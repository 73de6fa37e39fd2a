"""The starts of the paper's tables, their streets, statistics and plots."""

from __future__ import annotations

import csv
import io
import sys
from xml.etree import ElementTree

import gtsam
import numpy as np
import pytest

from sst_graph.errors import MissingDependencyError
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.drives import TableDrive, table_drives
from sst_graph.experiments.paper.plot import check_plot, plot_svg
from sst_graph.experiments.paper.runs import Case, CaseRun, start_of
from sst_graph.experiments.paper.summary import csv_text, markdown
from sst_graph.experiments.paper.tables import TABLES

CONFIG = PaperTableConfig(streets=3, methods=("paper", "joint"))
DRIVE = TableDrive("street 0", street=0)


def run(
    method: str, qad_deg: float, atd_m: float, offset_s: float | None = None, status: str = "ok"
) -> CaseRun:
    return CaseRun("street 0", 1, 0, method, qad_deg, 0.5 * qad_deg, atd_m, offset_s, 0.1036, status, True)


RUNS = [
    *(run("start", 9.0, 0.1, None, "") for _ in range(3)),
    *(run("joint", 0.1 * k, 0.01 * k, 0.1036 + 0.001 * k) for k in (1, 2, 6)),
    run("paper", 1.0, 0.1, 0.0836),
    run("paper", 20.0, 3.0, 0.0, "not_converged"),
    run("paper", 30.0, 3.0, 0.0),
]


def cells(table: str) -> dict[str, list[str]]:
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if "|" in line
    ]
    return {row[0]: row[1:] for row in rows}


def test_starts_are_uniform_seeded_and_the_same_for_every_method() -> None:
    cTl = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))
    starts = [start_of(Case(DRIVE, 1, k, "joint"), CONFIG, cTl) for k in range(300)]
    steps = np.array([cTl.localCoordinates(start) for start in starts])
    for values, limit in ((np.degrees(steps[:, :3]), 10.0), (steps[:, 3:], 0.1)):
        assert 0.97 * limit < np.abs(values).max() <= 1.0001 * limit
        assert np.std(values) == pytest.approx(limit / np.sqrt(3.0), rel=0.05)
    assert start_of(Case(DRIVE, 2, 7, "paper"), CONFIG, cTl).equals(starts[7], 0.0)
    other = TableDrive("street 1", street=1, seed=1)
    assert not start_of(Case(other, 1, 7, "joint"), CONFIG, cTl).equals(starts[7], 1e-3)


def test_streets_have_the_stamps_of_kitti() -> None:
    street = CONFIG.street(2, 2)
    assert street.seed == 2 and street.time_offset_s == pytest.approx(2 * 0.103652)
    assert street.period_s == pytest.approx(0.103652) and street.motion == "mixed"
    assert TABLES["table1"].config.street(0, 0).motion == "standing"
    assert [drive.name for drive in table_drives(CONFIG)] == ["street 0", "street 1", "street 2"]
    assert CONFIG.nominal_offset_s(2) == pytest.approx(0.2)


def test_failures_are_counted_and_left_out_of_the_means() -> None:
    assert run("joint", 5.1, 0.0).failed(CONFIG) and run("joint", 0.0, 0.51).failed(CONFIG)
    assert not run("joint", 5.0, 0.5).failed(CONFIG)
    rows = cells(markdown(RUNS, TABLES["table3"].layout, CONFIG))
    late = "1: 103.6 / 100"
    assert rows["joint"] == [
        *(late, "0 of 3 (0–71 %)", "–", "0.20", "0.30 / 0.20", "0.15 / 0.10", "3.0 / 2.0"),
        *("105.6", "3.0 / 2.0", "6.6 / 5.6"),
    ]
    assert rows["paper"][:5] == [late, "2 of 3 (9–99 %)", "1 of 2", "20.00", "1.00 / 1.00"]
    assert rows["paper"][-3:] == ["83.6", "20.0 / 20.0", "16.4 / 16.4"]
    assert rows["start"][1:4] == ["3 of 3 (29–100 %)", "–", "9.00"] and set(rows["start"][4:]) == {"–"}
    assert rows["*printed:* SST-Calib, joint stage"][4:] == [
        "0.67 / 0.66",
        "–",
        "7.45 / 5.52",
        "–",
        "3.4",
        "–",
    ]


def test_a_table_without_time_offsets_has_no_such_columns() -> None:
    rows = cells(markdown(RUNS, TABLES["table1"].layout, CONFIG))
    assert rows["joint"] == ["0 of 3 (0–71 %)", "–", "0.20", "0.30 / 0.20", "0.15 / 0.10", "3.0 / 2.0"]
    assert {len(row) for row in rows.values()} == {6}


def test_every_run_is_in_the_csv() -> None:
    rows = list(csv.DictReader(io.StringIO(csv_text(RUNS, CONFIG))))
    assert len(rows) == len(RUNS) and [row["failed"] for row in rows[-3:]] == ["False", "True", "True"]
    assert float(rows[3]["true_error_ms"]) == pytest.approx(1.0)
    assert float(rows[3]["nominal_error_ms"]) == pytest.approx(4.6)
    assert rows[0]["time_offset_s"] == "" and rows[0]["true_error_ms"] == ""


@pytest.mark.parametrize("name", sorted(TABLES))
def test_a_plot_has_the_methods_below_its_dots(name: str) -> None:
    svg = plot_svg(RUNS, TABLES[name].layout, CONFIG)
    assert ElementTree.fromstring(svg).tag.endswith("svg")
    assert "<!-- joint -->" in svg and "<!-- paper -->" in svg and "<!-- ATD [cm] -->" in svg
    assert ("time offset" in svg) == TABLES[name].layout.with_time
    assert all(f"<!-- {row.name}, as printed -->" in svg for row in TABLES[name].layout.printed)
    assert svg == plot_svg(RUNS, TABLES[name].layout, CONFIG)


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"pip install matplotlib, or --set plot=false"):
        check_plot()
