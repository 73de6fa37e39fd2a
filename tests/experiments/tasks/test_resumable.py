"""Tasks in processes, and the file of what is done."""

from __future__ import annotations

import json
import logging
import os
import resource
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from sst_graph.errors import ConfigError, DataError, EstimationError, SstGraphError
from sst_graph.experiments.tasks.code_version import recorded_version
from sst_graph.experiments.tasks.resumable import Work, rows_of

RUNS: list[int] = []


@dataclass(frozen=True)
class Task:
    number: int


@dataclass(frozen=True)
class Row:
    value: float
    name: str = ""


def squared(tasks: Sequence[Task]) -> Iterator[list[Row]]:
    for task in tasks:
        RUNS.append(task.number)
        if task.number < 0:
            raise DataError("a drive", "nothing", "something")
        if task.number == 666:
            os._exit(3)
        yield [Row(float(task.number**2), str(task.number))]


def work(path: Path, jobs: int = 1) -> Work[Task, Row]:
    return Work(squared, Row, jobs, str(path))


def run(path: Path, *numbers: int) -> list[Row]:
    return rows_of(work(path), [[Task(number) for number in numbers]])


def test_only_what_is_not_done_is_run(tmp_path: Path) -> None:
    RUNS.clear()
    path = tmp_path / "records"
    assert run(path, 2, 3) == [Row(4.0, "2"), Row(9.0, "3")]
    assert run(path, 3, 4, 2)[1] == Row(16.0, "4")
    assert RUNS == [2, 3, 4]


def test_what_another_version_of_the_code_did_is_done_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A table names one version; rows of another may have other fields."""
    RUNS.clear()
    path = tmp_path / "records"
    run(path, 2, 3, 4)
    older = path.read_text().replace(json.dumps(recorded_version()), '"commit a"')
    path.write_text(older.replace('"value": 4.0', '"older": 4.0'))
    with caplog.at_level(logging.WARNING):
        assert run(path, 2, 3) == [Row(4.0, "2"), Row(9.0, "3")]
    assert RUNS == [2, 3, 4, 2, 3]
    (record,) = caplog.records
    assert record.getMessage() == f"{path}: 2 runs of another version of the code, made again"
    caplog.clear()
    assert len(run(path, 2, 3)) == 2 and len(RUNS) == 5 and not caplog.records


def test_records_that_name_no_version_do_not_count(tmp_path: Path) -> None:
    RUNS.clear()
    path = tmp_path / "records"
    run(path, 2)
    head, line = path.read_text().splitlines()
    record = json.loads(line)
    del record["version"]
    path.write_text(f"{head}\n{json.dumps(record)}\n")
    assert run(path, 2) == [Row(4.0, "2")] and RUNS == [2, 2]


@pytest.mark.parametrize("left", [1, 20])
def test_a_line_that_a_kill_left_unfinished_is_done_again(tmp_path: Path, left: int) -> None:
    RUNS.clear()
    path = tmp_path / "records"
    run(path, 2, 3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-left])
    assert run(path, 2, 3)[1] == Row(9.0, "3")
    assert RUNS == [2, 3, 3] and path.read_bytes() == whole


def test_a_kill_before_the_first_line(tmp_path: Path) -> None:
    path = tmp_path / "records"
    run(path, 2)
    whole = path.read_bytes()
    path.write_bytes(whole[:20])
    assert run(path, 2) == [Row(4.0, "2")] and path.read_bytes() == whole


def test_one_run_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "records"

    def within(tasks: Sequence[Task]) -> Iterator[list[Row]]:
        with pytest.raises(ConfigError, match="another run is writing it"):
            run(path, 2)
        yield []

    assert rows_of(Work(within, Row, records=str(path)), [[Task(1)]]) == []


def test_what_was_done_before_an_error_is_kept(tmp_path: Path) -> None:
    RUNS.clear()
    with pytest.raises(DataError):
        run(tmp_path / "records", 5, -1)
    run(tmp_path / "records", 5)
    assert RUNS == [5, -1]


@pytest.mark.slow
def test_processes_give_the_same_rows_in_the_order_of_the_tasks(tmp_path: Path) -> None:
    groups = [[Task(0), Task(1)], [Task(2)], [Task(3)]]
    assert rows_of(work(tmp_path / "records", jobs=2), groups) == rows_of(Work(squared, Row), groups)


@pytest.mark.slow
def test_errors_of_processes(tmp_path: Path) -> None:
    path = tmp_path / "records"
    with pytest.raises(DataError, match="a drive: found nothing"):
        rows_of(work(path, jobs=2), [[Task(-1)]])
    died = r"Task\(number=1\): its process ended \(exit code 3\) with 1 of 2 runs left"
    with pytest.raises(EstimationError, match=died):
        rows_of(work(path, jobs=2), [[Task(1), Task(666)], [Task(3)]])
    RUNS.clear()
    assert run(path, 1, 3) == [Row(1.0, "1"), Row(9.0, "3")] and RUNS == []


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    """The system then writes the beginning of a line without an error."""
    RUNS.clear()
    path = tmp_path / "records"
    run(path, 2)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 30, hard))
    try:
        with pytest.raises(OSError) as caught:
            run(path, 2, 3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.filename == str(path)
    assert run(path, 2, 3) == [Row(4.0, "2"), Row(9.0, "3")] and RUNS == [2, 3, 3]


@pytest.mark.parametrize(
    "content",
    [
        "something else\n",
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [{"other": 1}]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [{"value": "x"}]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n{"task": "a", "rows": [3]}\n',
        '{"format": "sst-graph/experiment-records", "version": 1}\n[]\n',
        '{"format": "sst-graph/experiment-records", "version": 2}\n',
        "[]\n",
        "\udcff",
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "records"
    path.write_bytes(content.encode(errors="surrogateescape"))
    before = path.read_bytes()
    with pytest.raises(SstGraphError) as caught:
        run(path, 2)
    assert "records" in str(caught.value) and "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_a_folder_is_refused_and_one_that_is_missing_made(tmp_path: Path) -> None:
    with pytest.raises(SstGraphError):
        run(tmp_path, 2)
    assert not (tmp_path / "none").exists()
    run(tmp_path / "none" / "records", 2)
    with pytest.raises(ConfigError, match="cannot be written"):
        run(tmp_path / "none" / "records" / "records", 2)
