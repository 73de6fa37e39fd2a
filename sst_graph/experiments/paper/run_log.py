"""The state of a table beside its output: a line for each run that is done."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO

from sst_graph.errors import ConfigError, DataError
from sst_graph.experiments.paper.runs import Run
from sst_graph.files.json_table import JsonTable, json_table
from sst_graph.files.reading import FileKind, parse_json, read_file
from sst_graph.files.staging import lock_file

FORMAT = "sst-graph/experiment-runs"
VERSION = 1
RUNS = FileKind("a file of runs of an experiment", 256 * 1024 * 1024)


class RunLog:
    """Runs by key; those of a file are kept there, each as soon as it is done.

    Attributes:
        runs: those that are known.
    """

    def __init__(self, runs: dict[str, Run], stream: BinaryIO | None) -> None:
        self.runs = runs
        self._stream = stream

    def add(self, key: str, run: Run) -> None:
        """Keep a run, on the disk before this returns."""
        self.runs[key] = run
        if self._stream is not None:
            _append(self._stream, {"key": key, **asdict(run)})


@contextmanager
def open_log(path: Path | None) -> Iterator[RunLog]:
    """The runs of a file, new or begun before; None: in memory only.

    A last line that is not whole, as of a kill, is removed.

    Raises:
        ConfigError: another run is at it, or it cannot be made.
        DataError: it is no such file.
    """
    if path is None:
        yield RunLog({}, None)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = open(path, "ab", buffering=0)  # noqa: SIM115 (closed below)
    except OSError as error:
        raise ConfigError(f"{path}: nothing can be written there ({error.strerror})") from error
    with stream:
        if not lock_file(stream.fileno()):
            raise ConfigError(f"{path}: another experiment is writing it, expected to be the only one")
        runs, whole = _read(path)
        stream.truncate(whole)
        if whole == 0:
            _append(stream, {"format": FORMAT, "version": VERSION})
        yield RunLog(runs, stream)


def _append(stream: BinaryIO, document: dict[str, object]) -> None:
    stream.write((json.dumps(document, allow_nan=False) + "\n").encode("utf-8"))
    os.fsync(stream.fileno())


def _read(path: Path) -> tuple[dict[str, Run], int]:
    """The runs, and the bytes that whole lines take."""
    content = read_file(path, RUNS)
    whole = content.rfind(b"\n") + 1
    lines = content[:whole].splitlines()
    if not lines:
        if content and not b'{"format": '.startswith(content[:11]):
            raise DataError(path, "no whole line", RUNS.name)
        return {}, 0
    json_table(_document(lines[0], path, 1), path, FORMAT, VERSION)
    runs = {}
    for number, line in enumerate(lines[1:], 2):
        table = JsonTable(_document(line, path, number), f"{path}, line {number}")
        runs[table.text("key")] = _run(table)
    return runs, whole


def _document(line: bytes, path: Path, number: int) -> dict[str, object]:
    place = f"{path}, line {number}"
    try:
        document = parse_json(line.decode("utf-8"), place, RUNS.name)
    except UnicodeDecodeError:
        raise DataError(place, "bytes that are no UTF-8", RUNS.name) from None
    if not isinstance(document, dict):
        raise DataError(place, f"a JSON {type(document).__name__}", RUNS.name)
    return document


def _run(table: JsonTable) -> Run:
    estimated = table.value("estimated")
    if not isinstance(estimated, bool):
        raise DataError(f"{table.place}: estimated", f"{estimated!r:.60}", "true or false")
    return Run(
        table.text("drive"),
        table.integer("images_late"),
        table.integer("start"),
        table.text("method"),
        table.number("qad_deg"),
        table.number("aead_deg"),
        table.number("atd_m"),
        _optional(table, "time_offset_s"),
        _optional(table, "true_offset_s"),
        table.text("status"),
        estimated,
    )


def _optional(table: JsonTable, key: str) -> float | None:
    return None if table.value(key) is None else table.number(key)
