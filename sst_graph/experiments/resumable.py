"""Tasks of an experiment in processes of their own, resumable: what is done stands in a file of records."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TextIO, TypeVar

from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError, DataError, EstimationError
from sst_graph.files.reading import FileKind, parse_json, read_text
from sst_graph.files.staging import lock_file
from sst_graph.files.strict_json import json_able
from sst_graph.files.typed_values import wrong_fields

RECORDS = FileKind("records of an experiment", 256 * 1024 * 1024)
_HEADER = '{"format": "sst-graph/experiment-records", "version": 1}'

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Work(Generic[T, R]):
    """What is done with each task.

    Attributes:
        run: a function of a module, of one task; its results are rows.
        row: dataclass of a row, whose fields are plain values.
        jobs: processes at a time.
        records: file of what is done, which a further call goes on from; "": none.
    """

    run: Callable[[T], list[R]]
    row: type[R]
    jobs: int = 1
    records: str = ""


def rows_of(work: Work[T, R], tasks: Sequence[T], progress: Progress | None = None) -> list[list[R]]:
    """The rows of every task, in the order of the tasks.

    Raises:
        ConfigError: the file of records is of another kind, or cannot be written.
        DataError: what it holds cannot be used, or a task raises it.
        EstimationError: a process died.
    """
    keys = [_key(task) for task in tasks]
    done = _read(work) if work.records else {}
    missing = [number for number, key in enumerate(keys) if key not in done]
    if progress is not None:
        progress("tasks", len(tasks) - len(missing), len(tasks))
    with ExitStack() as stack:
        file = stack.enter_context(_appending(work.records)) if work.records and missing else None
        for finished, (number, rows) in enumerate(_run(work, tasks, missing), start=1):
            done[keys[number]] = rows
            if file is not None:
                line = {"task": keys[number], "rows": [json_able(row) for row in rows]}
                file.write(json.dumps(line) + "\n")
                file.flush()
            if progress is not None:
                progress("tasks", len(tasks) - len(missing) + finished, len(tasks))
    return [done[key] for key in keys]


def _run(work: Work[T, R], tasks: Sequence[T], numbers: Sequence[int]) -> Iterator[tuple[int, list[R]]]:
    """(number, rows) of some tasks, as they are done."""
    if work.jobs == 1 or len(numbers) < 2:
        yield from ((number, work.run(tasks[number])) for number in numbers)
        return
    # Spawned: a forked process would share gtsam's and OpenCV's threads and locks.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(work.jobs, len(numbers)), context) as pool:
        waiting: dict[Future[list[R]], int] = {pool.submit(work.run, tasks[n]): n for n in numbers}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BrokenProcessPool as error:
            raise EstimationError("a process of the experiment died; run it again to go on") from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _key(task: object) -> str:
    """A task by its content: other settings make other keys."""
    return hashlib.sha256(json.dumps(json_able(task), sort_keys=True).encode()).hexdigest()


@contextmanager
def _appending(path: str) -> Iterator[TextIO]:
    try:
        with open(path, "a", encoding="utf-8") as file:
            if not lock_file(file.fileno()):
                raise ConfigError(f"{path}: another run is writing it, expected to be the only one")
            # A killed run may have left its last line unfinished.
            file.write("\n" if file.tell() else _HEADER + "\n")
            yield file
    except OSError as error:
        raise ConfigError(f"{path}: records cannot be written ({error.strerror})") from error


def _read(work: Work[T, R]) -> dict[str, list[R]]:
    """Rows by key; a line that a killed run left unfinished is passed over."""
    if not Path(work.records).exists():
        return {}
    lines = read_text(work.records, RECORDS).splitlines()
    if lines and lines[0] != _HEADER:
        raise ConfigError(f"{work.records}: found another kind of file, expected {RECORDS.name}")
    done = {}
    for number, line in enumerate(lines[1:], start=2):
        place = f"{work.records}, line {number}"
        try:
            content = parse_json(line, place)
        except DataError:
            continue
        if not isinstance(content, Mapping) or not isinstance(content.get("rows"), list):
            raise DataError(place, "no rows", "a task with its rows")
        done[str(content.get("task"))] = [_row(work.row, row, place) for row in content["rows"]]
    return done


def _row(cls: type[R], values: Any, place: str) -> R:
    try:
        row = cls(**values)
    except TypeError:
        raise DataError(place, "other fields", f"the fields of {cls.__name__}") from None
    wrong = wrong_fields(row)
    if wrong:
        raise DataError(place, f"another type of {', '.join(wrong)}", f"the fields of {cls.__name__}")
    return row
