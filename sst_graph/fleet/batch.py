"""A batch: its folder, which drives are left to do, their records as they come, and the summary.

``OUT/`` holds ``batch.json`` (what was asked for), ``drives/NAME/`` (what ``sst-graph calibrate`` writes:
whole or not at all), ``records/NAME.json`` (what became of each drive), and the summary. A result that stands
there whole is the record that its drive is done, whatever stopped an earlier batch.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import sst_graph
from sst_graph.config import Settings, expect_settings, setting
from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import checked_type
from sst_graph.files.json_table import json_table
from sst_graph.files.reading import FileKind, digest_of_file
from sst_graph.files.staging import lock_file, sweep_folder
from sst_graph.files.strict_json import strict_json
from sst_graph.fleet.attempt import (
    DRIVES,
    RECORDS,
    Job,
    finished_record,
    has_changed,
    remove_unfinished,
    run_drive,
)
from sst_graph.fleet.dask_pool import run_on_dask
from sst_graph.fleet.drives import ListedDrive, checked_drives, vehicle_files
from sst_graph.fleet.isolated import Limits
from sst_graph.fleet.local_pool import run_locally
from sst_graph.fleet.places import Place, read_many
from sst_graph.fleet.record import Record, json_of
from sst_graph.fleet.scratch import sweep_scratch
from sst_graph.fleet.summary.page import summary_html
from sst_graph.fleet.summary.tables import Row, csv_bytes, drive_rows, parquet_bytes, vehicle_rows
from sst_graph.fleet.vehicles.fused import Vehicle, vehicle_json, vehicles_of
from sst_graph.fleet.vehicles.walk import WalkConfig
from sst_graph.result import result_file
from sst_graph.segmentation.model_files import model_files

BATCH = "batch.json"
FORMAT = "sst-graph/batch"
VERSION = 1
LOCK = ".sst-graph-batch.lock"
VEHICLES = "vehicles"

_NAME_FILES = ("--config", "--init", "--camera-file")
_NAME_NETWORKS = ("--image-model", "--lidar-model")
_OPTION_FILE = FileKind("a file that an option names", 2**36)


@dataclass(frozen=True)
class BatchConfig(Settings):
    """How drives are run.

    Attributes:
        options: of ``sst-graph calibrate``, but for DATA and --out.
        workers: drives at a time on this machine, or of a local Dask cluster.
        dask: address of a Dask scheduler, ``local``, or empty.
        limits: of one attempt at a drive.
        retries: further attempts at a drive after a crash, or where its data could not be copied.
        walk: how calibrations of vehicles may drift, and the false-alarm rate.
        observability: limits of the standard deviations of a vehicle's calibration that is ok.
    """

    options: tuple[str, ...] = ()
    workers: int = setting(1, at_least=1, at_most=10_000)
    dask: str = ""
    limits: Limits = field(default_factory=Limits)
    retries: int = setting(2, at_least=0, at_most=1000)
    walk: WalkConfig = field(default_factory=WalkConfig)
    observability: ObservabilityConfig = field(default_factory=ObservabilityConfig)


@dataclass(frozen=True)
class Progress:
    """Where a batch stands.

    Attributes:
        done, total: drives, those that an earlier run had finished among them.
        earlier: how many of them an earlier run had finished.
        without_result: how many failed so far.
        seconds: since this run began.
        last: the drive that was done last, or None.
        changed: how many drives are run again, because their files have changed since an earlier run.
    """

    done: int
    total: int
    earlier: int
    without_result: int
    seconds: float
    last: Record | None = None
    changed: int = 0

    @property
    def per_hour(self) -> float:
        """Drives an hour, of this run."""
        return 3600.0 * (self.done - self.earlier) / max(self.seconds, 1e-9)

    @property
    def left_s(self) -> float | None:
        """Time to the end at this rate [s]; None before the first drive."""
        return 3600.0 * (self.total - self.done) / self.per_hour if self.done > self.earlier else None


@dataclass(frozen=True)
class BatchOutcome:
    """What a batch leaves.

    Attributes:
        rows: of the drives, what needs attention first.
        vehicles: of those that are known.
        names: of the summary's files.
        others: how many drives of earlier runs, which were not given this time, have results there.
    """

    rows: list[Row]
    vehicles: list[Vehicle]
    names: list[str]
    others: int = 0

    @property
    def all_fine(self) -> bool:
        """Whether every drive and every vehicle is ok, and no drive is contradicted."""
        drives = all(row["status"] == "ok" and not row["contradicts"] for row in self.rows)
        return drives and all(one.status == "ok" for one in self.vehicles)


@contextmanager
def open_batch(out: Place, options: Sequence[str]) -> Iterator[str]:
    """Take the folder of a batch, new or begun before with the same options.

    What a killed run left unfinished there is removed. The context is a sentence where another version of
    sst-graph began it, else empty.

    Raises:
        ConfigError: it holds something else, or a batch with other options, or another run is at it.
        DataError: it cannot be read or written.
    """
    if out.is_local and out.exists() and not out.is_folder():
        raise ConfigError(f"{out}: found a file, expected a folder or nothing")
    begun_with = sst_graph.__version__
    if (out / BATCH).exists():
        place = (out / BATCH).url
        table = json_table(json_of((out / BATCH).read(), place, BATCH), place, FORMAT, VERSION)
        before = [str(one) for one in table.sequence("options")]
        begun_with = table.text("sst_graph", begun_with)
        _check_files(out, table.mapping("files"), options)
        if before != list(options):
            raise ConfigError(
                f"{out}: was begun with the options {' '.join(before) or '(none)'}, found "
                f"{' '.join(options) or '(none)'}, expected the same: results of both would be "
                "mixed (or another --out)"
            )
    elif out.is_folder() and out.below():
        raise ConfigError(
            f"{out}: found a folder without {BATCH}, expected a batch's folder, an empty one or none"
        )
    with _locked(out):
        if not (out / BATCH).exists():
            document = {
                "format": FORMAT,
                "version": VERSION,
                "sst_graph": begun_with,
                "options": list(options),
                "files": _digests(options),
            }
            (out / BATCH).write((strict_json(document) + "\n").encode("utf-8"))
        sweep_scratch()
        for folder in (out, out / RECORDS, out / VEHICLES):
            if folder.is_local and folder.is_folder():
                sweep_folder(folder.path)
        remove_unfinished(out)
        yield _of_versions(out, begun_with)


def _of_versions(out: Place, begun_with: str) -> str:
    now = sst_graph.__version__
    if begun_with == now:
        return ""
    return f"{out}: was begun by sst-graph {begun_with}, is gone on with by {now}: earlier results stay"


def _digests(options: Sequence[str]) -> dict[str, str]:
    """SHA-256 of the files that options name, by option; of a network also of its own files."""
    found = {}
    for option in options:
        name, _, value = option.partition("=")
        if name in _NAME_NETWORKS:
            files: Sequence[Path] = model_files(value)
        else:
            path = result_file(Path(value))
            files = [path] if name in _NAME_FILES and path.is_file() else []
        if files:
            digests = [digest_of_file(path, _OPTION_FILE) for path in files]
            found[option] = (digests[0] if len(files) == 1 else sha256(b"".join(digests)).digest()).hex()
    return found


def _check_files(out: Place, before: Mapping[str, object], options: Sequence[str]) -> None:
    """Refuse a file that is another one than when the batch was begun: results of both would be mixed."""
    for option, digest in _digests(options).items():
        if before.get(option, digest) != digest:
            raise ConfigError(
                f"{out}: was begun with other contents of {option}, expected the same (or another --out)"
            )


def run_batch(
    drives: Sequence[ListedDrive],
    out: Place,
    config: BatchConfig,
    progress: Callable[[Progress], None],
    run: Callable[[Job], Record] = run_drive,
) -> dict[str, Record]:
    """Run all drives that have no result yet; the records of all, by name.

    Args:
        progress: is called after every drive, and now and then between.
        run: what is done for a drive; it does not raise, and Dask can send it to its workers.

    Raises:
        ConfigError: an earlier run calibrated other data under the name of a drive.
        DataError: the folder cannot be read.
        FactorError: no drives, no place, or no such function.
    """
    checked_drives(drives)
    checked_type("out", out, Place, "a Place (Place.of)")
    config = expect_settings(config, BatchConfig)
    checked_type("progress", progress, Callable, "a function of the Progress")  # type: ignore[arg-type]
    checked_type("run", run, Callable, "a function of a Job")  # type: ignore[arg-type]
    jobs = [Job(drive, config.options, out, os.getcwd(), config.limits, config.retries) for drive in drives]
    records, changed = _finished(jobs, out)
    for job in changed:  # Where the new attempt fails, nothing is left of the old result.
        job.result.remove()
    left = [job for job in jobs if job.drive.name not in records]
    earlier, started = len(records), time.monotonic()
    failed = 0
    progress(Progress(earlier, len(jobs), earlier, failed, 0.0, changed=len(changed)))
    if config.dask and left:
        coming = run_on_dask(left, config.dask, config.workers, run)
    else:
        coming = run_locally(left, config.workers, run)
    for record in coming:
        if record is not None:
            records[record.drive] = record
            failed += not record.has_result
        progress(Progress(len(records), len(jobs), earlier, failed, time.monotonic() - started, record))
    return records


def write_summary(
    drives: Sequence[ListedDrive], records: dict[str, Record], out: Place, config: BatchConfig
) -> BatchOutcome:
    """Fuse the vehicles and write the summary: tables and page.

    Files of an earlier summary that this one has not, such as those of vehicles, are removed.

    Raises:
        OSError, DataError: it cannot be written.
        ConfigError: there is no drive.
        FactorError: no drives, no records, or no place.
    """
    checked_drives(drives)
    if not drives:
        raise ConfigError("drives: found none, expected one or more")
    checked_type("records", records, Mapping, "a dict of records by the drive's name (run_batch)")
    checked_type("out", out, Place, "a Place (Place.of)")
    config = expect_settings(config, BatchConfig)
    vehicles = vehicles_of(drives, records, config.walk, config.observability)
    others = _others(drives, out)
    report = "report.md" if "--no-report" in config.options else "report.html"
    rows, of_vehicles = drive_rows(drives, records, vehicles, report), vehicle_rows(vehicles)
    contents: dict[str, bytes | None] = {
        "summary.csv": csv_bytes(rows),
        "summary.parquet": parquet_bytes(rows),
        "vehicles.csv": csv_bytes(of_vehicles) or None,
        "vehicles.parquet": parquet_bytes(of_vehicles),
        "summary.html": summary_html(rows, of_vehicles, vehicles, others).encode("utf-8"),
    }
    written = [name for name, data in contents.items() if data is not None]
    for name, data in contents.items():
        if data is None:
            (out / name).remove()
        else:
            (out / name).write(data)
    names, folder = vehicle_files(vehicle.name for vehicle in vehicles), out / VEHICLES
    for vehicle in vehicles:
        (folder / names[vehicle.name]).write(vehicle_json(vehicle, records, config.walk).encode("utf-8"))
    for earlier in folder.below() if folder.is_folder() else []:
        if earlier.name.endswith(".json") and earlier.name not in names.values():
            earlier.remove()
    return BatchOutcome(rows, vehicles, written, others)


def _others(drives: Sequence[ListedDrive], out: Place) -> int:
    """How many results of drives that are not given stand in the folder."""
    folder, given = out / DRIVES, {drive.name for drive in drives}
    there = folder.below() if folder.is_folder() else []
    return sum(place.name not in given for place in there)


def _finished(jobs: Sequence[Job], out: Place) -> tuple[dict[str, Record], list[Job]]:
    """The records of drives whose results stand there whole, and the jobs of drives that have changed."""
    folder = out / DRIVES
    if not folder.exists():
        return {}, []
    there = {place.name for place in folder.below()}
    begun = [job for job in jobs if job.drive.name in there]
    stored = read_many(out / RECORDS / f"{job.drive.name}.json" for job in begun)
    found, changed = {}, []
    for job in begun:
        data = stored.get(job.record)
        if (before := _before(job, data)) is not None and has_changed(job, before):
            changed.append(job)
        elif (record := finished_record(job, data)) is not None:
            found[job.drive.name] = record
    return found, changed


def _before(job: Job, data: bytes | None) -> Record | None:
    """What an earlier run made of a drive; None where that is not known, and is written anew.

    Raises:
        ConfigError: it is of other data.
    """
    if data is None:
        return None
    try:
        before = Record.from_json(data, job.record.url)
    except DataError:
        return None
    if before.has_result and Place(before.place).whole(job.folder) != job.place:
        raise ConfigError(
            f"{job.place}: found a result of {before.place} under the name {job.drive.name}, "
            "expected one of the same data (names differ with --name-parts 2, or another --out)"
        )
    return before


@contextmanager
def _locked(out: Place) -> Iterator[None]:
    """No second run on a local folder at the same time."""
    if not out.is_local:
        yield
        return
    try:
        out.path.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(out.path / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise ConfigError(f"{out}: nothing can be made there ({error.strerror})") from error
    try:
        if not lock_file(descriptor):
            raise ConfigError(f"{out}: another run of sst-graph batch is at it, expected to be the only one")
        yield
    finally:
        os.close(descriptor)
