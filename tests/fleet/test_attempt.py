"""What befalls the process of one drive costs that drive alone, and what others do to it costs it nothing."""

from __future__ import annotations

import csv
import errno
import os
import shutil
from pathlib import Path

import pytest

from sst_graph.cli import main
from sst_graph.errors import ConfigError
from sst_graph.files import MANIFEST
from sst_graph.fleet import BatchConfig, run_batch
from sst_graph.fleet.attempt import MOST_KILLS, Job, run_drive
from sst_graph.fleet.drives import ListedDrive
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Record

FAULTS = '''
"""Python runs this before the program: faults of a drive's process, by the drive's name."""
import ctypes, os, pathlib, resource, signal, sys, time
if "calibrate" in sys.orig_argv:
    name = pathlib.Path(sys.orig_argv[sys.orig_argv.index("calibrate") + 1]).name
    log = pathlib.Path(__file__).with_name(name)
    with log.open("a") as stream:
        stream.write("x")
    tries = log.stat().st_size
    kind, _, times = name.partition("-")
    if kind == "killed" and tries <= int(times):
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "terminated" and tries <= int(times):
        os._exit(128 + signal.SIGTERM)
    if kind == "alternating":
        os.kill(os.getpid(), signal.SIGKILL if tries % 2 else signal.SIGSEGV)
    if kind == "segfault":
        ctypes.string_at(0)
    if kind == "endless":
        time.sleep(600)
    if kind == "full" and tries <= int(times):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
    if kind == "defect":
        sys.modules["sst_graph.cli.commands.calibrate"] = None
    if kind == "greedy":
        held = []
        while True:
            held.append(bytearray(1 << 22))
            time.sleep(0.002)
'''


@pytest.fixture
def faults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which every attempt at a drive leaves a letter in a file of the drive's name."""
    folder = tmp_path / "faults"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(FAULTS)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
    return folder


def attempted(name: str, tmp_path: Path, retries: int, options: tuple[str, ...] = ()) -> Record:
    """The record of a drive; where none is there, an attempt that is let run ends as bad input."""
    drive, out = ListedDrive(name, Place(str(tmp_path / name))), Place(str(tmp_path / "out"))
    return run_drive(Job(drive, options, out, "/", retries=retries))


@pytest.mark.parametrize("name", ["killed-3", "terminated-3"])
def test_kills_from_outside_are_no_retries_of_the_drive(name: str, faults: Path, tmp_path: Path) -> None:
    record = attempted(name, tmp_path, retries=0)
    assert (record.status, record.cost.attempts) == ("bad_input", 4)
    assert len((faults / name).read_text()) == 4


def test_a_drive_that_is_always_killed_has_an_end(faults: Path, tmp_path: Path) -> None:
    record = attempted("killed-1000", tmp_path, retries=0)
    assert (record.status, record.cost.attempts) == ("killed", MOST_KILLS)
    assert "ended from outside by SIGKILL" in record.reason
    assert Record.from_json((tmp_path / "out/records/killed-1000.json").read_bytes(), "record") == record


def test_kills_and_crashes_are_counted_apart(faults: Path, tmp_path: Path) -> None:
    """It is killed, crashes, is killed, crashes: two crashes are one retry used up."""
    record = attempted("alternating", tmp_path, retries=1)
    assert (record.status, record.cost.attempts) == ("crash", 4)
    assert "SIGSEGV" in record.reason


@pytest.mark.slow
def test_a_result_that_cannot_be_written_is_no_fault_of_the_data(
    kitti_drive: Path, faults: Path, tmp_path: Path
) -> None:
    """The disk is full at first: the drive is tried again, by the same batch or by the next one."""
    for name in ("full-1", "full-2"):
        shutil.copytree(kitti_drive.parents[1], tmp_path / name)
    given_up = attempted("full-2", tmp_path, retries=0, options=("--no-report",))
    assert (given_up.status, given_up.cost.attempts) == ("storage", 1)
    assert "out/drives/full-2" in given_up.reason and "File too large" in given_up.reason
    assert attempted("full-2", tmp_path, retries=1, options=("--no-report",)).has_result
    again = attempted("full-1", tmp_path, retries=1, options=("--no-report",))
    assert again.has_result and again.cost.attempts == 2


def test_no_room_for_copies_and_notes_is_a_failure_of_the_storage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/tmp/x")

    monkeypatch.setattr("sst_graph.fleet.isolated.tempfile.TemporaryFile", full)
    assert attempted("a", tmp_path, retries=0).status == "storage"
    monkeypatch.setattr(Path, "mkdir", full)
    assert attempted("a", tmp_path, retries=0).status == "storage"


def test_a_defect_of_the_program_is_a_crash(faults: Path, tmp_path: Path) -> None:
    record = attempted("defect", tmp_path, retries=1)
    assert (record.status, record.cost.attempts) == ("crash", 2)
    assert "exit code 70" in record.reason and "please report it" in record.reason


def test_the_kernel_short_of_memory_is_a_crash(
    faults: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a drive may be what took the memory: it has its retries and no more."""
    counts = tmp_path / "vmstat"
    counts.write_text("nr_free_pages 12\noom_kill 4\n")
    monkeypatch.setattr("sst_graph.fleet.isolated._KERNEL_COUNTS", str(counts))
    changed = (
        (faults / "sitecustomize.py")
        .read_text()
        .replace(
            "os.kill(os.getpid(), signal.SIGKILL)",
            f"pathlib.Path({str(counts)!r}).write_text(f'oom_kill {{4 + tries}}'); os.kill(os.getpid(), 9)",
        )
    )
    (faults / "sitecustomize.py").write_text(changed)
    record = attempted("killed-1000", tmp_path, retries=1)
    assert (record.status, record.cost.attempts) == ("crash", 2)
    assert "want of it: fewer --workers" in record.reason


@pytest.mark.slow
def test_each_fault_costs_its_drive_alone(kitti_drive: Path, faults: Path, tmp_path: Path) -> None:
    drives, out = tmp_path / "drives", tmp_path / "out"
    for name in ("segfault", "greedy", "endless", "killed-2", "fine", "bad"):
        shutil.copytree(kitti_drive.parents[1], drives / name)
    (drives / "bad/sequences/00/times.txt").write_text("noon")
    command = ["batch", str(drives), "--out", str(out), "--workers", "2", "--retries", "1", "--no-report"]
    assert main([*command, "--memory-limit", "0.8", "--time-limit", "40"]) == 3
    with (out / "summary.csv").open(newline="") as stream:
        rows = {row["drive"]: row for row in csv.DictReader(stream)}
    assert {name: (row["status"], row["attempts"]) for name, row in rows.items()} == {
        "segfault": ("crash", "2"),
        "greedy": ("memory_limit", "1"),
        "endless": ("time_limit", "1"),
        "killed-2": ("unobservable", "3"),
        "fine": ("unobservable", "1"),
        "bad": ("bad_input", "1"),
    }
    assert sorted(one.name for one in (out / "drives").iterdir()) == ["fine", "killed-2"]
    assert main(["calibrate", str(drives / "fine"), "--out", str(tmp_path / "alone"), "--no-report"]) == 3
    for one in (tmp_path / "alone").iterdir():
        assert one.read_bytes() == (out / "drives/fine" / one.name).read_bytes()


def finished(job: Job) -> Record:
    """A drive that is done, without a calibration: its folder and its record."""
    job.result.path.mkdir(parents=True)
    (job.result.path / MANIFEST).write_text("{}")
    record = Record(job.drive.name, job.place, "ok")
    job.record.write(record.to_json().encode())
    return record


def refused(job: Job) -> Record:
    raise AssertionError(f"{job.drive.name} was run again")


def test_a_relative_path_means_the_same_data_from_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """drives/d1 of another folder is not taken for the one that is done, and the same one is known again."""
    out, done = Place(str(tmp_path / "out")), {}
    for week in ("week1", "week2"):
        (tmp_path / week / "drives/d1").mkdir(parents=True)
    for folder, drive, run in (
        ("week1", "drives/d1", finished),
        ("week1/drives", "d1", refused),
        (".", "week1/drives/d1", refused),
    ):
        monkeypatch.chdir(tmp_path / folder)
        done = run_batch([ListedDrive("d1", Place(drive))], out, BatchConfig(), lambda progress: None, run)
    assert done["d1"].place == str(tmp_path / "week1/drives/d1")
    monkeypatch.chdir(tmp_path / "week2")
    with pytest.raises(ConfigError, match=r"week2/drives/d1: found a result of .*week1/drives/d1"):
        run_batch([ListedDrive("d1", Place("drives/d1"))], out, BatchConfig(), lambda progress: None, refused)
