"""Tasks of an experiment, resumable: what is done stands in a file of records."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError, DataError
from sst_graph.experiments.processes import Run, run_groups
from sst_graph.files.reading import FileKind, parse_json, read_file
from sst_graph.files.staging import lock_file
from sst_graph.files.strict_json import json_able
from sst_graph.files.typed_values import wrong_fields

RECORDS = FileKind("records of an experiment", 256 * 1024 * 1024)
_HEADER = b'{"format": "sst-graph/experiment-records", "version": 1}\n'

T = TypeVar("T")
R = TypeVar("R")


def digest(task: object) -> str:
    """A task by its content: other settings make other keys."""
    return hashlib.sha256(json.dumps(json_able(task), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Work(Generic[T, R]):
    """What is done with each task.

    Attributes:
        run: yields the rows of each of the tasks that it is given; a function of a module, or a partial.
        row: dataclass of a row, whose fields are plain values.
        jobs: processes at a time.
        records: file of what is done, which a further call goes on from; "": none.
        key: by which a task is known there.
    """

    run: Run[T, list[R]]
    row: type[R]
    jobs: int = 1
    records: str = ""
    key: Callable[[T], str] = digest


def rows_of(work: Work[T, R], groups: Sequence[Sequence[T]], progress: Progress | None = None) -> list[R]:
    """The rows of every task, in the order of the tasks; those of a group share what ``work.run`` prepares.

    Raises:
        ConfigError: the file of records is of another kind, or cannot be written.
        DataError: what it holds cannot be used, or a task raises it.
        EstimationError: a process died.
    """
    keys = [work.key(task) for group in groups for task in group]
    with _records(work) as (done, keep):
        left = [[task for task in group if work.key(task) not in done] for group in groups]
        finished = len(keys) - sum(map(len, left))
        if progress is not None:
            progress("runs", finished, len(keys))
        for task, rows in run_groups(work.run, [group for group in left if group], work.jobs):
            keep(work.key(task), rows)
            finished += 1
            if progress is not None:
                progress("runs", finished, len(keys))
    return [row for key in keys for row in done[key]]


@contextmanager
def _records(work: Work[T, R]) -> Iterator[tuple[dict[str, list[R]], Callable[[str, list[R]], None]]]:
    """Rows by key, and what adds some, on the disk before it returns. What a kill cut off is removed."""
    done: dict[str, list[R]] = {}
    if not work.records:
        yield done, done.__setitem__
        return
    try:
        file = open(work.records, "ab", buffering=0)  # noqa: SIM115 (closed below)
    except OSError as error:
        raise ConfigError(f"{work.records}: records cannot be written ({error.strerror})") from error

    def keep(key: str, rows: list[R]) -> None:
        done[key] = rows
        write(json.dumps({"task": key, "rows": [json_able(row) for row in rows]}).encode() + b"\n")

    def write(line: bytes) -> None:
        file.write(line)
        os.fsync(file.fileno())

    with file:
        if not lock_file(file.fileno()):
            raise ConfigError(f"{work.records}: another run is writing it, expected to be the only one")
        content = read_file(work.records, RECORDS)
        whole = content[: content.rfind(b"\n") + 1]
        if not (whole.startswith(_HEADER) or _HEADER.startswith(content)):
            raise ConfigError(f"{work.records}: found another kind of file, expected {RECORDS.name}")
        for number, line in enumerate(whole.decode(errors="replace").splitlines()[1:], start=2):
            done.update(_record(line, work.row, f"{work.records}, line {number}"))
        file.truncate(len(whole))
        if not whole:
            write(_HEADER)
        yield done, keep


def _record(line: str, row: type[R], place: str) -> dict[str, list[R]]:
    content = parse_json(line, place)
    if not isinstance(content, Mapping) or not isinstance(content.get("rows"), list):
        raise DataError(place, "no rows", "a task with its rows")
    return {str(content.get("task")): [_row(row, values, place) for values in content["rows"]]}


def _row(cls: type[R], values: Any, place: str) -> R:
    try:
        row = cls(**values)
    except TypeError:
        raise DataError(place, "other fields", f"the fields of {cls.__name__}") from None
    wrong = wrong_fields(row)
    if wrong:
        raise DataError(place, f"another type of {', '.join(wrong)}", f"the fields of {cls.__name__}")
    return row
