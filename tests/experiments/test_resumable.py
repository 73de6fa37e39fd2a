"""Tasks in processes, and the file of what is done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from sst_graph.errors import ConfigError, DataError, SstGraphError
from sst_graph.experiments.resumable import Work, rows_of

RUNS: list[int] = []


@dataclass(frozen=True)
class Task:
    number: int


@dataclass(frozen=True)
class Row:
    value: float
    name: str = ""


def squared(task: Task) -> list[Row]:
    RUNS.append(task.number)
    if task.number < 0:
        raise DataError("a drive", "nothing", "something")
    return [Row(float(task.number**2), str(task.number))]


def work(path: Path, jobs: int = 1) -> Work[Task, Row]:
    return Work(squared, Row, jobs, str(path))


def test_only_what_is_not_done_is_run(tmp_path: Path) -> None:
    RUNS.clear()
    path = tmp_path / "records"
    assert rows_of(work(path), [Task(2), Task(3)]) == [[Row(4.0, "2")], [Row(9.0, "3")]]
    assert rows_of(work(path), [Task(3), Task(4), Task(2)])[1] == [Row(16.0, "4")]
    assert RUNS == [2, 3, 4]


def test_a_line_that_a_kill_left_unfinished_is_done_again(tmp_path: Path) -> None:
    RUNS.clear()
    path = tmp_path / "records"
    rows_of(work(path), [Task(2), Task(3)])
    path.write_bytes(path.read_bytes()[:-20])
    assert rows_of(work(path), [Task(2), Task(3)])[1] == [Row(9.0, "3")]
    assert RUNS == [2, 3, 3]
    assert rows_of(work(path), [Task(2), Task(3)])[1] == [Row(9.0, "3")]
    assert RUNS == [2, 3, 3]


def test_what_was_done_before_an_error_is_kept(tmp_path: Path) -> None:
    RUNS.clear()
    with pytest.raises(DataError):
        rows_of(work(tmp_path / "records"), [Task(5), Task(-1)])
    rows_of(work(tmp_path / "records"), [Task(5)])
    assert RUNS == [5, -1]


def test_processes_give_the_same_rows_in_the_order_of_the_tasks(tmp_path: Path) -> None:
    tasks = [Task(k) for k in range(4)]
    assert rows_of(work(tmp_path / "records", jobs=2), tasks) == rows_of(Work(squared, Row), tasks)


@pytest.mark.parametrize(
    "content",
    [
        "something else\n",
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [{"other": 1}]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [{"value": "x"}]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [3]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n[]\n',
        "\udcff",
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "records"
    path.write_bytes(content.encode(errors="surrogateescape"))
    before = path.read_bytes()
    with pytest.raises(SstGraphError) as caught:
        rows_of(work(path), [Task(2)])
    assert "records" in str(caught.value) and "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SstGraphError):
        rows_of(work(tmp_path), [Task(2)])
    with pytest.raises(ConfigError, match="cannot be written"):
        rows_of(work(tmp_path / "none" / "records"), [Task(2)])
