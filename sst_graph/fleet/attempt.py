"""One drive from its data to its record: fetched, calibrated in a process of its own, retried, published."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from sst_graph.errors import DataError, SstGraphError, printable
from sst_graph.files import MANIFEST
from sst_graph.files.manifest import read_manifest
from sst_graph.files.staging import SUFFIX, claim
from sst_graph.fleet.drive_files import changed_at, fingerprint, size_of
from sst_graph.fleet.drives import ListedDrive
from sst_graph.fleet.isolated import Ending, Limits, has_ended, run_isolated
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Cost, Numbers, Record, Status, reason_of
from sst_graph.fleet.scratch import scratch_folder
from sst_graph.result import read_result

DRIVES, RECORDS = "drives", "records"
RESULT = "calibration.json"

_EXIT_DONE, _EXIT_BAD_INPUT, _EXIT_NOT_TRUSTED, _EXIT_NOT_WRITTEN = 0, 2, 3, 74
_FULL = (errno.ENOSPC, errno.EDQUOT)
MOST_KILLS = 10
"""Attempts that others may end (the machine is taken away, an operator, ...) before a drive is given up.

They say nothing of the drive, so they are no part of its retries; without an end, a machine that kills all it
runs would keep a batch for ever.
"""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_UNFINISHED = re.compile(rf"\.(.+?)(?:\.[0-9a-f]{{16}})?{re.escape(SUFFIX)}$")
"""Name of an unfinished result beside its own."""
_PROGRAM_MODULE, _SAID_BY_IT = "sst_graph.cli.one_drive", "sst-graph: "


@dataclass(frozen=True)
class Job:
    """What has to be done for one drive; it travels to other machines.

    Attributes:
        drive: whose data.
        options: of ``sst-graph calibrate``, but for DATA and --out.
        out: the batch's folder.
        folder: where the program was started: relative paths begin there.
        limits: of one attempt.
        retries: further attempts after a crash, or where something could not be copied or written.
    """

    drive: ListedDrive
    options: tuple[str, ...]
    out: Place
    folder: str
    limits: Limits = field(default_factory=Limits)
    retries: int = 0

    @property
    def place(self) -> str:
        """Where the drive's data stand, in words that mean the same wherever the program is started."""
        return self.drive.place.whole(self.folder)

    @property
    def result(self) -> Place:
        """Folder of the drive's result."""
        return self.out / DRIVES / self.drive.name

    @property
    def record(self) -> Place:
        """File of the drive's record."""
        return self.out / RECORDS / f"{self.drive.name}.json"


def run_drive(job: Job) -> Record:
    """Calibrate one drive, again after a crash or a kill, and write its record. Never raises for the drive.

    A result that stands there whole, as of a task that a scheduler repeats, is taken as it is.
    """
    record = finished_record(job)
    attempts = kills = 0
    while record is None or _is_to_be_repeated(record.status, attempts - kills - 1 < job.retries, kills):
        if has_ended():
            return Record(job.drive.name, job.place, "not_run", "the batch was ended before")
        attempts += 1
        record = _attempt(job)
        kills += record.status == "killed"
        record = replace(record, cost=replace(record.cost, attempts=attempts))
    if attempts and not has_ended():
        _write_record(job, record)
    return record


def _write_record(job: Job, record: Record) -> None:
    """Write what became of a drive; its result counts without it, too."""
    with contextlib.suppress(SstGraphError, OSError):
        job.record.write(record.to_json().encode("utf-8"))


def _is_to_be_repeated(status: Status, has_retries: bool, kills: int) -> bool:
    """Whether a further attempt is made after one that ended so."""
    if status == "killed":
        return kills < MOST_KILLS
    return status in ("crash", "storage") and has_retries


def finished_record(job: Job, stored: bytes | None = None) -> Record | None:
    """The record of a drive whose result stands there whole, or None; whether the drive has changed since is
    another question.

    A record is written after the result. Where it is missing (the batch was killed between the two), it is
    made from the result, and written.

    Args:
        stored: contents of the record's file, where the caller has read it; the result's folder is there.
    """
    try:
        with contextlib.suppress(SstGraphError, OSError):
            record = Record.from_json(job.record.read() if stored is None else stored, job.record.url)
            if (
                record.has_result
                and Place(record.place).whole(job.folder) == job.place
                and _is_whole(job, stored is not None)
            ):
                return record
        if not (job.result / MANIFEST).exists():
            return None
        if job.result.is_local:
            made = _of_result(job, job.result.path)
            if made is not None:
                made = replace(made, files=_unchanged_files(job))
        else:
            with scratch_folder() as scratch:
                made = _of_result(job, job.result.fetch(scratch))
    except SstGraphError:
        return None
    if made is not None:
        _write_record(job, made)
    return made


def has_changed(job: Job, record: Record) -> bool:
    """Whether the drive's files on this machine are others than those that an earlier result is of; not where
    they are gone, or were fetched."""
    now = fingerprint(Path(job.place)) if job.drive.place.is_local and record.files else ""
    return now not in ("", record.files)


def _unchanged_files(job: Job) -> str:
    """Fingerprint of the files that a local result without a record is of; empty where that is not known: the
    drive is not on this machine, or a file has changed since the result was written."""
    data, written = Path(job.place), (job.result.path / MANIFEST).stat().st_mtime
    return fingerprint(data) if job.drive.place.is_local and changed_at(data) <= written else ""


def _is_whole(job: Job, is_there: bool) -> bool:
    """Whether the result stands there: a local folder with its manifest, a remote one with its record."""
    if not job.result.is_local:
        return is_there or (job.result / MANIFEST).exists()
    return (job.result.path / MANIFEST).exists()


def _attempt(job: Job) -> Record:
    """One attempt; what cannot be copied, and a disk without room for it, are failures of the storage."""
    try:
        with scratch_folder() as scratch:
            return _attempt_in(scratch, job)
    except OSError as error:
        return _failed(job, "storage", str(error))


def _attempt_in(scratch: Path, job: Job) -> Record:
    """One attempt with a folder of its own."""
    try:
        data = _data(job, scratch)
    except (SstGraphError, OSError) as error:
        return _failed(job, "storage", str(error))
    local = job.result.path if job.result.is_local else scratch / "result"
    files = fingerprint(data) if job.drive.place.is_local else ""
    try:
        ending = _calibrated(job, data, local)
    except OSError as error:
        status: Status = "storage" if error.errno in _FULL else "crash"
        return _failed(job, status, f"no process could be started: {error}")
    cost = Cost(1, ending.wall_s, ending.cpu_s, ending.peak_bytes, size_of(data))
    if ending.limit or ending.code not in (_EXIT_DONE, _EXIT_NOT_TRUSTED):
        if not has_ended():  # who ends a batch cleans up after all of its drives
            _clean(local)
        return replace(_of_ending(job, ending), cost=cost)
    record = _of_result(job, local)
    if record is None:
        return replace(_failed(job, "crash", "left no whole result"), cost=cost, log=ending.log)
    if not job.result.is_local:
        try:
            job.result.upload(local)
        except (SstGraphError, OSError) as error:
            return replace(_failed(job, "storage", str(error)), cost=cost)
    return replace(record, cost=cost, files=files)


def _data(job: Job, scratch: Path) -> Path:
    """The drive's data on this machine."""
    if job.drive.place.is_local:
        return Path(job.place)
    (scratch / "data").mkdir()
    return job.drive.place.fetch(scratch / "data")


def _calibrated(job: Job, data: Path, out: Path) -> Ending:
    # -P: nothing is imported from the folder where the program was started.
    program = [sys.executable, "-P", "-m", _PROGRAM_MODULE, "calibrate"]
    command = [*program, os.fspath(data), "--out", os.fspath(out), "--overwrite", *job.options]
    folder = job.folder if os.path.isdir(job.folder) else os.getcwd()
    return run_isolated(command, _environment(os.environ), job.limits, folder)


def _environment(own: Mapping[str, str]) -> dict[str, str]:
    """One thread a process, for there are as many processes as are wanted; the program as it is here."""
    found = dict(own)
    for name in _THREADS:
        found[name] = "1"
    paths = [path for path in (*sys.path, own.get("PYTHONPATH", "")) if path]
    found["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    return found


def _of_ending(job: Job, ending: Ending) -> Record:
    """The record of a process that left no result."""
    said = next((line for line in reversed(ending.log) if line.startswith(_SAID_BY_IT)), "")
    said = said.removeprefix(_SAID_BY_IT).removeprefix("error: ")
    gigabytes, limit_gb = ending.peak_bytes / 2**30, (job.limits.memory_bytes or 0) / 2**30
    status: Status = "crash"
    if ending.limit == "memory":
        status, reason = "memory_limit", f"took {gigabytes:.2f} GB of memory, more than {limit_gb:g} GB"
    elif ending.limit == "time":
        status, reason = "time_limit", f"took more than {job.limits.wall_s:g} s"
    elif ending.code == _EXIT_BAD_INPUT and said:
        status, reason = "bad_input", said
    elif ending.code == _EXIT_NOT_WRITTEN:
        status, reason = "storage", said or "the result could not be written"
    elif ending.from_outside and not ending.short_of_memory:
        status, reason = "killed", f"ended from outside by {ending.words} after {ending.wall_s:.1f} s"
    elif ending.from_outside:
        reason = (
            f"ended by {ending.words} at {gigabytes:.2f} GB of memory, while the kernel ended processes for "
            "want of it: fewer --workers, or a --memory-limit"
        )
    else:
        last = said or next((line.strip() for line in reversed(ending.log) if line.strip()), "")
        reason = f"ended by {ending.words} after {ending.wall_s:.1f} s" + (f": {last}" if last else "")
    return replace(_failed(job, status, reason), log=ending.log)


def _of_result(job: Job, folder: Path) -> Record | None:
    """The record of a result's folder, or None where it is not whole."""
    manifest = read_manifest(folder)
    if manifest is None or RESULT not in manifest.files:
        return None
    try:
        result = read_result(folder / RESULT)
    except DataError:
        return None
    record = Record(job.drive.name, job.place, result.status, reason_of(result))
    return replace(record, numbers=Numbers.of(result))


def _failed(job: Job, status: Status, reason: str) -> Record:
    return Record(job.drive.name, job.place, status, printable(reason, 1000))


def _clean(target: Path) -> None:
    """Remove what a killed process left beside its output."""
    with contextlib.suppress(OSError, SstGraphError):
        claim(Path(os.path.realpath(target))).release()


def remove_unfinished(out: Place) -> None:
    """Remove what killed processes of drives left in a batch's folder; what a living one writes stays.

    On this machine only: a result elsewhere is written under its own name.
    """
    folder = out / DRIVES
    if out.is_local and folder.is_folder():
        found = (_UNFINISHED.match(name) for name in os.listdir(folder.url))
        for name in {one[1] for one in found if one is not None}:
            _clean(folder.path / name)
