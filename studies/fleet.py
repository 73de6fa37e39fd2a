"""A simulated fleet through ``sst-graph batch``, sequentially and on two workers that are killed at random.

    python studies/fleet.py --vehicles 10 --drives 20 --out out/fleet

makes the drives (kept in OUT/drives, so a second run starts at once), calibrates them one after the other as
``sst-graph calibrate`` does, then by ``sst-graph batch`` on two workers while processes of drives are killed
at random and the batch itself is killed twice and resumed, and compares: every result there, each byte-equal
to the sequential one, the changed vehicles found, no other accused. Prints one Markdown table.

    python studies/fleet.py --vehicles 10 --drives 20 --on-dask 2 7 --out out/fleet

then calibrates the drives of two vehicles again on a local Dask cluster of two workers, which are killed at
random (each with the drive that it runs); the cluster starts another in its place.

    python studies/fleet.py --empty 100000 --out out/empty

runs drives of no work through the scheduler's own code: what it adds to each, its memory, the summary.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from sst_graph.cli import main as main_of_program
from sst_graph.experiments.markdown import table
from sst_graph.files import MANIFEST
from sst_graph.fleet import BatchConfig, ListedDrive, Place, Record, write_summary
from sst_graph.fleet import batch as fleet_batch
from sst_graph.fleet.attempt import Job
from sst_graph.fleet.record import Cost, Numbers
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate, write_drive
from sst_graph.simulator.drive import NOMINAL_CTL, mounting_error
from sst_graph.types import GroundTruth

SMALL = SimulationConfig(
    frames=6,
    width=400,
    height=120,
    frame_rate_hz=3.0,
    motion="mixed",
    speed_mps=6.0,
    azimuth_limit_deg=45.0,
    azimuth_step_deg=0.5,
    vehicle_density=0.35,
    moving_fraction=0.0,
    label_noise=0.5,
    rotation_error_deg=0.7,
    translation_error_m=0.03,
)
"""Six small pictures at 3 Hz: stands, accelerates, turns and brakes."""
PROGRAM = [sys.executable, "-m", "sst_graph"]
SETTINGS = ["--no-report"]
for _setting in (
    "use_motion=never",
    "find_causes=false",
    "decide_sweep=false",
    "check_contradictions=false",
    "assumptions.test=false",
    "search.rotation_deg=5",
    "search.translation_m=0.15",
    "search.time_offset_s=0.2",
):
    SETTINGS += ["--set", _setting]
"""Of both runs, to save time: the street's own tests of its assumptions are of no concern here."""
FIRST_DAY = date(2026, 3, 2)
DRIVE, DASK_WORKER = "sst_graph.cli.one_drive calibrate", "spawn_main"
"""In the command lines of a drive's process, and of a Dask worker's."""


@dataclass(frozen=True)
class Change:
    """What happens to a vehicle between two of its drives.

    Attributes:
        before: number of the first drive after it.
        step: (6,) of the extrinsic, right perturbation [rad, m].
        offset_s: of the time offset [s].
    """

    before: int
    step: tuple[float, ...] = (0.0,) * 6
    offset_s: float = 0.0


CHANGES = {
    "v02": Change(3, (0.0, 0.0, np.radians(1.2), 0.0, 0.0, 0.0)),
    "v05": Change(2, (0.0, np.radians(-1.0), 0.0, 0.0, 0.03, 0.0)),
    "v07": Change(3, offset_s=0.08),
}
"""Two mounts that are knocked and a clock that is set."""


def drive_of(vehicle: int, number: int, change: Change | None) -> SimulatedDrive:
    """A drive of a vehicle through the street of that number, with the vehicle's mount, clock and noise."""
    own = np.random.default_rng([77, vehicle])
    cTl = NOMINAL_CTL * mounting_error(SMALL, own)
    offset_s = float(np.round(own.uniform(-0.03, 0.03), 4))
    if change is not None and number >= change.before:
        cTl, offset_s = cTl.retract(np.array(change.step)), offset_s + change.offset_s
    config = replace(SMALL, seed=1000 * vehicle + number, time_offset_s=offset_s)
    return replace(_through_street(number), config=config, truth=GroundTruth(cTl, offset_s))


@lru_cache(maxsize=1)
def _through_street(number: int) -> SimulatedDrive:
    """A drive through a street; building one takes as long as the drive's pictures, so vehicles share it."""
    return simulate(replace(SMALL, seed=number))


def make_fleet(folder: Path, vehicles: Sequence[int], drives: int) -> list[Path]:
    """Folders of all drives, named VEHICLE_DATE; those that are there are kept."""
    made = []
    for number in range(drives):
        for vehicle in vehicles:
            name = f"v{vehicle:02d}"
            day = FIRST_DAY + timedelta(days=7 * number + vehicle % 5)
            path = folder / f"{name}_{day.isoformat()}"
            if not path.exists():
                write_drive(drive_of(vehicle, number, CHANGES.get(name)), path)
            made.append(path)
    return sorted(made)


def add_bad_drives(folder: Path) -> list[Path]:
    """Three drives that cannot be read: a calib.txt cut off, a picture that is none, an empty folder."""
    whole = next(path for path in sorted(folder.iterdir()) if (path / "sequences/00/calib.txt").exists())
    day = (FIRST_DAY - timedelta(days=30)).isoformat()
    cut, spoilt, empty = (folder / f"{name}_{day}" for name in ("v01", "v04", "v08"))
    for path in (cut, spoilt):
        if not path.exists():
            shutil.copytree(whole, path)
    (cut / "sequences/00/calib.txt").write_text("P0: 700 0")
    min((spoilt / "sequences/00/image_2").iterdir()).write_bytes(b"no picture")
    empty.mkdir(exist_ok=True)
    return [cut, spoilt, empty]


def calibrate_one_by_one(drives: Sequence[Path], out: Path) -> list[tuple[float, float]]:
    """Wall and processor seconds of ``sst-graph calibrate`` for each drive."""
    took = []
    for drive in drives:
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        command = [*PROGRAM, "calibrate", str(drive), "--out", str(out / drive.name), *SETTINGS]
        subprocess.run(command, env=environment(), capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        took.append((time.monotonic() - started, cpu))
    return took


def calibrate_in_this_process(drives: Sequence[Path], out: Path) -> None:
    """The results of ``sst-graph calibrate`` for drives that have none yet, one after the other.

    One process for all of them: the imports, a third of a small drive's time, are paid once.
    """
    out.mkdir(parents=True, exist_ok=True)
    for drive in drives:
        if (out / drive.name).exists():
            continue
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            main_of_program(["calibrate", str(drive), "--out", str(out / drive.name), *SETTINGS])


def batch_command(drives: Path, out: Path, dask: str = "") -> list[str]:
    """The command line of the batch."""
    named = ["--vehicle-from", r"(?P<vehicle>v\d+)_(?P<date>[\d-]+)$"]
    named += ["--dask", dask] if dask else []
    return [*PROGRAM, "batch", str(drives), "--out", str(out), "--workers", "2", *named, *SETTINGS]


def run_batch(command: Sequence[str]) -> tuple[int, float, float]:
    """Exit code, wall and processor seconds of a batch, all of its processes."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    code = subprocess.run(command, env=environment(), check=False).returncode
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return code, time.monotonic() - started, cpu


@dataclass
class Killed:
    """How many processes were killed.

    Attributes:
        drives: processes of drives, or workers of Dask; batches: the batch itself.
    """

    drives: int = 0
    batches: int = 0


def run_with_kills(
    command: Sequence[str], rng: np.random.Generator, every_s: float, batches: int, mark: str = DRIVE
) -> Killed:
    """Run a batch to its end while processes that it started are killed at random (SIGKILL).

    For some times the batch itself is killed, too, and started again.

    Args:
        mark: stands in the command line of those that are killed.
    """
    killed = Killed()
    while True:
        process = subprocess.Popen(command, env=environment())
        end_at = time.monotonic() + (rng.uniform(1.0, 2.5) * every_s if killed.batches < batches else np.inf)
        next_at = time.monotonic() + rng.exponential(every_s)
        while process.poll() is None:
            time.sleep(0.02)
            now = time.monotonic()
            if now > end_at:
                process.kill()
                process.wait()
                killed.batches += 1
                break
            if now > next_at:
                next_at = now + rng.exponential(every_s)
                running = children(process.pid, mark)
                if running:
                    os.kill(int(rng.choice(running)), signal.SIGKILL)
                    killed.drives += 1
        else:
            return killed


def children(pid: int, mark: str) -> list[int]:
    """Processes that another one started and whose command line has a mark (Linux)."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            found += [int(one) for one in task.read_text().split()]
    return [one for one in found if mark in _command_line(one)]


def _command_line(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


def unlike(expected: Path, found: Path) -> list[str]:
    """Files of results that are missing, too many, or not the same byte for byte."""
    both = {
        path.relative_to(root) for root in (expected, found) for path in root.rglob("*") if path.is_file()
    }
    return sorted(
        str(path)
        for path in both
        if not (expected / path).is_file()
        or not (found / path).is_file()
        or (expected / path).read_bytes() != (found / path).read_bytes()
    )


def environment() -> dict[str, str]:
    """One thread a process."""
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def empty_drive(job: Job) -> Record:
    """The scheduler's work for a drive, none of the calibration's: a result, and its record on the disk."""
    number = int(job.drive.name[1:])
    rng = np.random.default_rng(number)
    sigmas = np.array([2e-3] * 3 + [0.02] * 3 + [0.005])
    cTl = NOMINAL_CTL.retract(rng.normal(size=6) * sigmas[:6])
    numbers = Numbers(
        cTl.matrix().tolist(), float(rng.normal() * 0.005), np.diag(sigmas**2).tolist(), {}, 8, "c"
    )
    record = Record(job.drive.name, job.drive.place.url, "ok", "", Cost(1, 1.0, 1.0, 10**8, 10**6), numbers)
    folder = job.result.path
    folder.mkdir(parents=True)
    (folder / MANIFEST).write_text("{}")
    job.record.write(record.to_json().encode())
    return record


def measure_scheduler(count: int, folder: Path, workers: int, dask: str) -> None:
    """Drives that take no time, through the batch's own code; prints what it adds to each."""
    drives = [
        ListedDrive(
            f"d{k:06d}", Place(f"/data/d{k:06d}"), f"v{k % (count // 100):05d}", f"2026-01-{1 + k % 28:02d}"
        )
        for k in range(count)
    ]
    out, config = Place(str(folder)), BatchConfig(workers=workers, dask=dask)
    rows: list[list[str]] = []

    def timed(name: str, work: Callable[[], object]) -> object:
        started = time.monotonic()
        found = work()
        seconds = time.monotonic() - started
        rows.append([name, f"{seconds:.1f}", f"{1e3 * seconds / count:.2f} ms"])
        return found

    def run() -> dict[str, Record]:
        return fleet_batch.run_batch(drives, out, config, lambda progress: None, empty_drive)

    timed(f"{count} empty drives on {workers} {'Dask ' if dask else ''}workers, records written", run)
    records = run()
    timed("the same again: all found done", run)
    timed("vehicles fused, summary written", lambda: write_summary(drives, records, out, config))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size = (folder / "summary.html").stat().st_size / 1e6
    rows += [["largest memory of the batch", f"{peak:.0f} MB", ""], ["summary.html", f"{size:.1f} MB", ""]]
    print(table("| step | seconds | a drive |", rows))


def main() -> None:
    """Make the fleet, run it both ways, print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=10)
    parser.add_argument("--drives", type=int, default=20, help="of each vehicle")
    parser.add_argument("--kill-every", type=float, default=15.0, help="mean seconds between kills")
    parser.add_argument("--kill-batch", type=int, default=2, help="how often the batch itself is killed")
    parser.add_argument("--timed", type=int, default=20, help="drives whose batch is timed without kills")
    parser.add_argument("--on-dask", type=int, nargs="+", default=[], metavar="VEHICLE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/fleet"))
    parser.add_argument("--empty", type=int, metavar="N", help="only the scheduler, with N drives of no work")
    parser.add_argument("--dask", default="", help="with --empty: on Dask")
    given = parser.parse_args()
    if given.empty:
        measure_scheduler(given.empty, given.out, 2, given.dask)
        return
    drives = make_fleet(given.out / "drives", range(given.vehicles), given.drives)
    bad = add_bad_drives(given.out / "drives")
    alone = given.out / "one_by_one"
    calibrate_in_this_process(drives, alone)
    kill_at_random = partial(run_with_kills, rng=np.random.default_rng(given.seed), every_s=given.kill_every)

    what = "drives, vehicles, drives that cannot be read"
    rows = [[what, f"{len(drives)}, {given.vehicles}, {len(bad)}"]]
    batch = given.out / "batch"
    killed = kill_at_random(batch_command(given.out / "drives", batch), batches=given.kill_batch)
    rows.append(["processes of drives killed, batches killed", f"{killed.drives}, {killed.batches}"])
    rows += outcome(batch, drives, alone)
    if given.timed:
        rows += efficiency(drives[:: max(1, len(drives) // given.timed)][: given.timed], given.out)
    if given.on_dask:
        some = [drive for drive in drives if int(drive.name[1:3]) in given.on_dask]
        command = batch_command(linked(some, given.out / "some"), given.out / "dask", dask="local")
        killed = kill_at_random(command, batches=0, mark=DASK_WORKER)
        rows.append(["on Dask: drives, workers killed", f"{len(some)}, {killed.drives}"])
        rows += outcome(given.out / "dask", some, alone)
    print(table("| what | found |", rows))


def outcome(batch: Path, drives: Sequence[Path], alone: Path) -> list[list[str]]:
    """Rows of a table: what a batch left, beside what ``calibrate`` made of each drive."""
    with open(batch / "vehicles.csv", newline="") as stream:
        vehicles = list(csv.DictReader(stream))
    with open(batch / "summary.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    counts = Counter(row["status"] for row in rows).most_common()
    there = sum((batch / "drives" / drive.name).is_dir() for drive in drives)
    differ = sum(len(unlike(alone / drive.name, batch / "drives" / drive.name)) for drive in drives)
    return [
        ["status", ", ".join(f"{count} {status}" for status, count in counts)],
        ["results there", f"{there} of {len(drives)}"],
        ["most attempts at a drive", str(max(int(row["attempts"]) for row in rows))],
        ["files unlike those of the sequential run", str(differ)],
        *([row["vehicle"], row["reason"]] for row in vehicles if row["status"] != "ok"),
        ["vehicles not accused", str(sum(row["status"] == "ok" for row in vehicles))],
    ]


def efficiency(drives: Sequence[Path], out: Path) -> list[list[str]]:
    """Rows of a table: what drives take one by one, and by a batch without kills."""
    for name in ("timed", "timed_one"):
        shutil.rmtree(out / name, ignore_errors=True)
    one_by_one = calibrate_one_by_one(drives, out / "timed_one")
    _, wall_s, cpu_s = run_batch(batch_command(linked(drives, out / "some"), out / "timed"))
    alone_s, alone_cpu_s = np.sum(one_by_one, axis=0)
    return [
        [f"{len(drives)} drives one by one: wall, processor", f"{alone_s:.0f} s, {alone_cpu_s:.0f} s"],
        ["the same by batch on 2 workers: wall, processor", f"{wall_s:.0f} s, {cpu_s:.0f} s"],
        ["efficiency: wall, processor", f"{alone_s / (2.0 * wall_s):.2f}, {alone_cpu_s / cpu_s:.2f}"],
    ]


def linked(drives: Sequence[Path], folder: Path) -> Path:
    """A folder of links to drives."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for drive in drives:
        (folder / drive.name).symlink_to(drive.resolve())
    return folder


if __name__ == "__main__":
    main()
