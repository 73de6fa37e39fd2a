"""Many jobs on this machine and on Dask: all are done, whatever happens to workers."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sst_graph.errors import ConfigError
from sst_graph.fleet.attempt import Job
from sst_graph.fleet.dask_pool import run_on_dask
from sst_graph.fleet.drives import ListedDrive
from sst_graph.fleet.local_pool import run_locally
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Record


def jobs(count: int, folder: Path | str = "/") -> Iterator[Job]:
    for k in range(count):
        yield Job(ListedDrive(f"drive_{k:04d}", Place("/nowhere")), (), Place("/nowhere"), str(folder))


def instant(job: Job) -> Record:
    return Record(job.drive.name, job.drive.place.url, "ok")


LOSSES = {"drive_0003": 1, "drive_0004": 3, "drive_0005": 1000}


def deadly(job: Job) -> Record:
    """Kills its worker as often as a drive's number in LOSSES says."""
    mark = Path(job.folder) / job.drive.name
    with mark.open("a") as stream:
        stream.write("x")
    if mark.stat().st_size <= LOSSES.get(job.drive.name, 0):
        os.kill(os.getpid(), signal.SIGKILL)
    return instant(job)


@pytest.mark.parametrize("workers", [1, 3])
def test_every_job_is_done_once(workers: int) -> None:
    done = [one.drive for one in run_locally(jobs(500), workers, instant) if one is not None]
    assert sorted(done) == [job.drive.name for job in jobs(500)]


def test_a_fault_of_the_program_is_no_silence() -> None:
    def faulty(job: Job) -> Record:
        raise ZeroDivisionError(job.drive.name)

    with pytest.raises(ZeroDivisionError):
        list(run_locally(jobs(5), 2, faulty))


@pytest.mark.slow
def test_dask_repeats_what_a_lost_worker_had(tmp_path: Path) -> None:
    """By the scheduler, and where that gives a task up, after two losses here, by the batch."""
    pytest.importorskip("distributed")
    import dask

    with dask.config.set({"distributed.scheduler.allowed-failures": 1}):
        found = {one.drive: one for one in run_on_dask(jobs(8, tmp_path), "local", 2, deadly) if one}
    assert sorted(found) == [job.drive.name for job in jobs(8)]
    assert [one.status for name, one in found.items() if name != "drive_0005"] == ["ok"] * 7
    assert found["drive_0005"].status == "killed" and "Dask workers were lost" in found["drive_0005"].reason
    assert len((tmp_path / "drive_0004").read_text()) >= 4
    assert len((tmp_path / "drive_0005").read_text()) <= 6


def dying(job: Job) -> Record:
    """Kills its worker soon after the drive is done, for the first two times with each drive."""
    mark = Path(job.folder) / job.drive.name
    with mark.open("a") as stream:
        stream.write("x")
    if mark.stat().st_size <= 2:
        threading.Timer(0.001, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return instant(job)


@pytest.mark.slow
def test_a_result_that_is_lost_with_its_worker_is_made_again(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    import dask

    with dask.config.set({"distributed.scheduler.allowed-failures": 1}):
        found = [one for one in run_on_dask(jobs(12, tmp_path), "local", 2, dying) if one]
    assert sorted(one.drive for one in found) == [job.drive.name for job in jobs(12)]
    assert {one.status for one in found} <= {"ok", "killed"}
    assert sum(one.status == "ok" for one in found) >= 6


@pytest.mark.slow
def test_workers_that_are_killed_while_they_start_are_replaced() -> None:
    """Dask's nannies give such workers up; with none left the batch would wait for ever."""
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")
    until = time.monotonic() + 15.0
    killed, done = set(), []
    for one in run_on_dask(jobs(20), "local", 2, lingering):
        done += [one] if one else []
        if time.monotonic() < until:
            for process in psutil.Process().children(recursive=True):
                with contextlib.suppress(psutil.NoSuchProcess):
                    if "spawn_main" in " ".join(process.cmdline()):
                        killed.add(process.pid)
                        process.kill()
    assert len(killed) > 4
    assert sorted(one.drive for one in done) == [job.drive.name for job in jobs(20)]
    assert [one.status for one in done] == ["ok"] * 20


def lingering(job: Job) -> Record:
    time.sleep(1.0)
    return instant(job)


def broken(job: Job) -> Record:
    raise ModuleNotFoundError("No module named 'sst_graph'")


@pytest.mark.slow
def test_a_worker_that_cannot_run_a_drive_is_no_lost_worker() -> None:
    pytest.importorskip("distributed")
    found = [one for one in run_on_dask(jobs(2), "local", 1, broken) if one]
    assert [one.status for one in found] == ["crash", "crash"]
    assert "could not be run on its Dask worker: No module named 'sst_graph'" in found[0].reason


def fatal(job: Job) -> Record:
    """Kills the scheduler, whose process id stands in a file."""
    os.kill(int((Path(job.folder) / "pid").read_text()), signal.SIGKILL)
    return instant(job)


@pytest.mark.slow
def test_a_lost_scheduler_is_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = started("scheduler", "--host", address)
    worker = started("worker", address, "--no-nanny")
    (tmp_path / "pid").write_text(str(scheduler.pid))
    try:
        with pytest.raises(ConfigError, match="lost the scheduler"):
            list(run_on_dask(jobs(3, tmp_path), address, 1, fatal))
    finally:
        for one in (worker, scheduler):
            one.kill()
            one.wait()


def started(kind: str, *arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", *arguments]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("sst_graph.fleet.dask_pool._CONNECT_S", 0.5)
    with pytest.raises(ConfigError, match="found no scheduler"):
        list(run_on_dask(jobs(1), "tcp://127.0.0.1:1", 1, instant))
