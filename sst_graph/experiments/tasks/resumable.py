"""Tasks of an experiment, resumable: what is done stands in a file of records.

Each record names the version of the code that made it. What another version did does not count: a table is
made by one version, the one that its last line names.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.experiments.tasks.code_version import recorded_version
from sst_graph.experiments.tasks.processes import Run, run_groups
from sst_graph.files.reading import FileKind, parse_json, read_file
from sst_graph.files.staging import lock_file
from sst_graph.files.strict_json import json_able
from sst_graph.files.typed_values import wrong_fields

RECORDS = FileKind("records of an experiment", 256 * 1024 * 1024)
_HEADER = b'{"format": "sst-graph/experiment-records", "version": 1}\n'
_LOG = logging.getLogger(__name__)

T = TypeVar("T")
R = TypeVar("R")
_Rows = dict[str, list[R]]
"""Rows by the key of their task."""


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
        records: file of what is done, which a further call of the same code goes on from; "": none.
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
    with _records(work) as (done, outdated, keep):
        again = len(outdated.intersection(keys))
        if again:
            _LOG.warning(
                "%s: %s of another version of the code, made again", work.records, count_of(again, "run")
            )
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
def _records(work: Work[T, R]) -> Iterator[tuple[_Rows[R], set[str], Callable[[str, list[R]], None]]]:
    """Rows by key, the keys that only another version of the code has done, and what adds some rows, on the
    disk before it returns. What a kill cut off is removed."""
    done: _Rows[R] = {}
    outdated: set[str] = set()
    if not work.records:
        yield done, outdated, done.__setitem__
        return
    version = recorded_version()
    try:
        Path(work.records).parent.mkdir(parents=True, exist_ok=True)
        file = open(work.records, "ab", buffering=0)  # noqa: SIM115 (closed below)
    except OSError as error:
        raise ConfigError(f"{work.records}: records cannot be written ({error.strerror})") from error

    def keep(key: str, rows: list[R]) -> None:
        done[key] = rows
        record = {"task": key, "version": version, "rows": [json_able(row) for row in rows]}
        write(json.dumps(record).encode() + b"\n")

    def write(line: bytes) -> None:
        try:
            while line:  # what a full disk has no room for is written with the next call, or an error
                line = line[file.write(line) :]
            os.fsync(file.fileno())
        except OSError as error:
            error.filename = work.records
            raise

    with file:
        if not lock_file(file.fileno()):
            raise ConfigError(f"{work.records}: another run is writing it, expected to be the only one")
        content = read_file(work.records, RECORDS)
        whole = content[: content.rfind(b"\n") + 1]
        if not (whole.startswith(_HEADER) or _HEADER.startswith(content)):
            raise ConfigError(f"{work.records}: found another kind of file, expected {RECORDS.name}")
        for number, line in enumerate(whole.decode(errors="replace").splitlines()[1:], start=2):
            key, rows = _record(line, work.row, version, f"{work.records}, line {number}")
            if rows is None:
                outdated.add(key)
            else:
                done[key] = rows
        outdated -= done.keys()
        file.truncate(len(whole))
        if not whole:
            write(_HEADER)
        yield done, outdated, keep


def _record(line: str, row: type[R], version: str, place: str) -> tuple[str, list[R] | None]:
    """Key and rows of a line; None for the rows of another version, or of one that is not known."""
    content = parse_json(line, place)
    if not isinstance(content, Mapping) or not isinstance(content.get("rows"), list):
        raise DataError(place, "no rows", "a task with its rows")
    key = str(content.get("task"))
    if content.get("version", version) != version:  # the rows of another version may have other fields
        return key, None
    rows = [_row(row, values, place) for values in content["rows"]]
    return key, rows if "version" in content else None


def _row(cls: type[R], values: Any, place: str) -> R:
    try:
        row = cls(**values)
    except TypeError:
        raise DataError(place, "other fields", f"the fields of {cls.__name__}") from None
    wrong = wrong_fields(row)
    if wrong:
        raise DataError(place, f"another type of {', '.join(wrong)}", f"the fields of {cls.__name__}")
    return row
