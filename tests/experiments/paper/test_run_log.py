"""The file of runs: what is read back, what is refused, and which settings it is keyed by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.errors import ConfigError, DataError
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.drives import TableDrive
from sst_graph.experiments.paper.run_log import open_log
from sst_graph.experiments.paper.runs import Case, Run

RUN = Run("street 0", 1, 0, "joint", 0.1, 0.05, 0.01, None, 0.1036, "ok", True)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "new" / "runs.jsonl"
    with open_log(path) as opened:
        opened.add("a", RUN)
        opened.add("b", replace(RUN, start=1, time_offset_s=0.1))
    return path


def test_runs_are_read_back(log: Path) -> None:
    with open_log(log) as opened:
        assert opened.runs == {"a": RUN, "b": replace(RUN, start=1, time_offset_s=0.1)}
    with open_log(None) as opened:
        opened.add("a", RUN)
        assert opened.runs == {"a": RUN}


@pytest.mark.parametrize("left", [1, 5, 200])
def test_a_line_that_was_cut_off_is_run_again(log: Path, left: int) -> None:
    whole = log.read_bytes()
    log.write_bytes(whole[:-left])
    with open_log(log) as opened:
        assert list(opened.runs) == ["a"]
        opened.add("b", replace(RUN, start=1, time_offset_s=0.1))
    assert log.read_bytes() == whole


def test_a_kill_before_the_first_line(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:20])
    with open_log(log) as opened:
        assert opened.runs == {}
        opened.add("a", RUN)
    with open_log(log) as opened:
        assert opened.runs == {"a": RUN}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"some notes", "found no whole line"),
        (b'{"format": "else"}\n', "found format 'else'"),
        (b"[]\n", "found a JSON list"),
        (b"\xff\n", "found bytes that are no UTF-8"),
        (b'{"format": "sst-graph/experiment-runs", "version": 1}\n{"key": "a"}\n', "line 2"),
        (b'{"format": "sst-graph/experiment-runs", "version": 2}\n', "found version 2"),
    ],
)
def test_other_files_are_refused_and_stay(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "runs.jsonl"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message), open_log(path):
        pass
    assert path.read_bytes() == content


def test_one_at_a_time(log: Path, tmp_path: Path) -> None:
    with open_log(log), pytest.raises(ConfigError, match="another experiment"), open_log(log):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="nothing can be written"), open_log(tmp_path / "file/runs.jsonl"):
        pass


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
