"""Small versions of the rows of docs/reference/faults.md: what a fault leaves, and what the exit code is."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from checks.fault_commands import COMMANDS, each_in
from checks.fault_matrix import (
    Bench,
    Row,
    ended_by,
    full_disk,
    kill,
    kill_overwriting,
    read_only,
    resume,
    streams,
    two_writers,
)
from sst_graph.cli.progress import PREFIX

ALSO_WRITING = (
    *("calibrate", "calibrate, two cameras", "calibrate --video", "demo", "track", "track --view-save"),
    *("export --to gtsam", "overlay --video", "import", "segment", "view", "batch"),
    *("experiment fit", "experiment basin", "experiment table1"),
)
SIGNAL_AT_IMPORT = """
import os, signal, sys
number, module, sys.argv = int(sys.argv[1]), sys.argv[2], ["sst-graph", *sys.argv[3:]]
def hook(event, arguments):
    if event == "import" and arguments[0] == module:
        os.kill(os.getpid(), number)
from sst_graph.cli import main
sys.addaudithook(hook)
sys.exit(main())
"""
SIGNAL_AT_EXIT = """
import atexit, os, signal, sys
atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))
from sst_graph.cli import main
sys.exit(main())
"""


LITTLE_MEMORY = """
import resource, sys
from sst_graph.cli import main
import sst_graph.cli.command, sst_graph.cli.commands.info, sst_graph.data.kitti.odometry, cv2, numpy
numpy.ones((200, 200)) @ numpy.ones((200, 200))  # OpenBLAS takes its buffer, or ends the process
sys.argv = ["sst-graph", "info", sys.argv[1]]
with open("/proc/self/statm", encoding="ascii") as stream:
    present = int(stream.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (present + (32 << 20), present + (32 << 20)))
sys.exit(main())
"""
"""``info`` of a drive with 32 MB left."""
FOREIGN_LOADER = """
import sys
from sst_graph.cli import main
from sst_graph.data import Loader, register_loader
def opened(path, options):
    return {}[chr(27) + "[31m" + chr(10) + "x"]
register_loader("foreign", Loader(lambda path: False, opened, "another layout"))
sys.argv = ["sst-graph", "info", ".", "--loader", "foreign"]
sys.exit(main())
"""
"""A reader of someone else's that fails in a way of its own."""
OWN_DEFECT = """
import sys
from sst_graph.cli import main
from sst_graph.cli.commands import info
def run(args):
    return {}[chr(27) + "[31m" + chr(10) + "x"]
info.run = run
sys.argv = ["sst-graph", "info", "."]
sys.exit(main())
"""
"""A command of our own that fails so."""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A street and a result of it, for all commands."""
    return Bench(tmp_path_factory.mktemp("faults"))


def _holds(row: Row) -> None:
    assert row.runs and row.failures == []


def test_each_output_of_several_is_whole_or_absent() -> None:
    whole = {"out/a": b"1", "out/b": b"2", "out.gif": b"3"}
    assert each_in({}, {}, whole) and each_in(whole, {}, whole)
    assert each_in({"out/a": b"1", "out/b": b"2"}, {}, whole)  # the video takes its name later
    assert not each_in({"out/a": b"1"}, {}, whole)
    assert not each_in({"out.gif": b"half"}, {}, whole)
    assert not each_in({**whole, "left": b""}, {}, whole)
    assert not each_in({"out/a": b"1", "out/b": b"2"}, {"out.gif": b"0"}, whole)  # the older one is lost


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "calibrate --video"])
def test_a_kill_leaves_nothing_or_all(bench: Bench, command: str) -> None:
    _holds(kill(bench, COMMANDS[command], [0.6, 0.9, 1.0]))


@pytest.mark.slow
@pytest.mark.parametrize("command", ["segment", "batch", "experiment basin"])
def test_a_killed_run_that_goes_on_makes_the_same(bench: Bench, command: str) -> None:
    _holds(kill(bench, COMMANDS[command], [0.6, 0.9]))


@pytest.mark.slow
def test_a_kill_leaves_the_old_or_the_new(bench: Bench) -> None:
    _holds(kill_overwriting(bench, COMMANDS["export"], [0.8, 0.95, 1.0]))


@pytest.mark.slow
def test_a_killed_tracker_resumes_to_the_same_bytes(bench: Bench) -> None:
    row = resume(bench, COMMANDS["track"], [0.8, 3.0])  # near the end; the second has finished
    _holds(row)
    assert row.finished >= 1


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, signal.SIGTERM, signal.SIGHUP],
)
@pytest.mark.slow
def test_a_signal_leaves_no_unfinished_output(bench: Bench, number: int) -> None:
    _holds(ended_by(bench, COMMANDS["simulate"], number, [0.85]))


@pytest.mark.parametrize("module", ["argparse", "numpy", "gtsam", "cv2", "sst_graph.batch"])
def test_a_signal_among_the_imports(tmp_path: Path, module: str) -> None:
    arguments = ["calibrate", str(tmp_path / "none"), "--out", str(tmp_path / "deep" / "out")]
    done = subprocess.run(
        [sys.executable, "-c", SIGNAL_AT_IMPORT, str(int(signal.SIGINT)), module, *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "sst-graph: error: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_a_signal_after_the_work_changes_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SIGNAL_AT_EXIT, "inspect", "x", "--next", "0"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("command", ["export", "calibrate"])
def test_a_full_disk_is_named_and_leaves_nothing(bench: Bench, command: str) -> None:
    row = full_disk(bench, COMMANDS[command], [200])
    _holds(row)
    assert row.finished < row.runs  # a small export fits on the small file system


@pytest.mark.parametrize("command", ["simulate", "export", *ALSO_WRITING])
@pytest.mark.slow
def test_a_place_that_cannot_be_written_is_refused_before_the_work(bench: Bench, command: str) -> None:
    _holds(read_only(bench, COMMANDS[command]))


@pytest.mark.slow
def test_broken_streams(bench: Bench) -> None:
    _holds(streams(bench, COMMANDS["evaluate"]))


@pytest.mark.slow
def test_a_full_stdout_does_not_change_what_a_calibration_is_worth(bench: Bench) -> None:
    for unbuffered in ("", "1"):
        desk = bench.desk()
        ended = subprocess.run(
            [sys.executable, "-m", "sst_graph", *bench.arguments(COMMANDS["calibrate"], desk)],
            stdout=os.open("/dev/full", os.O_WRONLY),
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )
        assert ended.returncode == 3, ended.stderr
        said = [line for line in ended.stderr.splitlines() if PREFIX not in line]
        warning, reason = said
        assert "stdout: No space left on device" in warning and "unobservable" in reason
        assert (desk / "out" / "calibration.json").is_file()


@pytest.mark.slow
def test_closed_streams_do_not_become_files(bench: Bench) -> None:
    desk = bench.desk()
    command = [sys.executable, "-m", "sst_graph", *bench.arguments(COMMANDS["export"], desk)]
    shell = 'exec "$@" <&- >&- 2>&-'
    done = subprocess.run(["bash", "-c", shell, "bash", *command], timeout=60, check=False)
    assert done.returncode == 0
    assert (desk / "out.yaml").read_bytes() == bench.whole(COMMANDS["export"])[0]["out.yaml"]


@pytest.mark.slow
def test_of_two_writers_one_is_refused(bench: Bench) -> None:
    _holds(two_writers(bench, COMMANDS["simulate"], 1))


@pytest.mark.slow
def test_same_input_same_bytes_with_one_thread_and_two(bench: Bench) -> None:
    digests = []
    for threads, seed in (("1", "1"), ("2", "2")):
        desk = bench.desk()
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONHASHSEED": seed}

        def run(*arguments: str, env: dict[str, str] = environment) -> bytes:
            command = [sys.executable, "-m", "sst_graph", *arguments]
            done = subprocess.run(command, capture_output=True, timeout=300, check=False, env=env)
            assert done.returncode == (0 if "export" in arguments else 3), done.stderr.decode()
            return done.stdout

        run("calibrate", str(bench.data / "street"), "--out", str(desk / "out"))
        outputs = [
            (desk / "out" / "calibration.json").read_bytes(),
            run("export", str(desk / "out"), "--force", "--to", "gtsam"),
            run(*bench.arguments(COMMANDS["track"], desk)),
            (desk / "out.json").read_bytes(),
        ]
        digests.append([hashlib.sha256(output).hexdigest() for output in outputs])
    assert digests[0] == digests[1]


def test_too_little_memory_is_one_line(tmp_path: Path) -> None:
    drive = tmp_path / "sequences" / "00"
    for name in ("velodyne", "image_2"):
        (drive / name).mkdir(parents=True)
    cv2.imwrite(str(drive / "image_2/000000.png"), np.zeros((6, 8, 3), np.uint8))
    (drive / "calib.txt").write_text("P2: 700 0 4 0 0 700 3 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (drive / "times.txt").write_text("0\n")
    (drive / "velodyne/000000.bin").write_bytes(bytes(64_000_000))
    done = subprocess.run(
        [sys.executable, "-c", LITTLE_MEMORY, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("sst-graph: error: not enough memory")


@pytest.mark.parametrize(
    ("program", "begin", "end"),
    [
        (OWN_DEFECT, "unexpected KeyError: ", "at <string>:6 (a defect, please report it with what"),
        (FOREIGN_LOADER, "in the loader foreign: KeyError: ", "(<string>:6; --verbose shows all)"),
    ],
)
def test_what_nobody_foresaw_is_one_line(program: str, begin: str, end: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2 and done.stdout == ""
    line = done.stderr.removesuffix("\n")
    assert line.isprintable() and line.startswith(f"sst-graph: error: {begin}")
    assert end in line


def test_a_name_that_the_system_refuses_is_shortened() -> None:
    command = [sys.executable, "-m", "sst_graph", "inspect", "a/" * 3000]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2 and len(done.stderr) < 500
    assert done.stderr.startswith("sst-graph: error: a/a/") and "File name too long" in done.stderr


def test_the_working_directory_was_removed(tmp_path: Path) -> None:
    program = "import os, sys; os.rmdir(os.getcwd()); from sst_graph.cli import main; sys.exit(main())"
    (tmp_path / "gone").mkdir()
    command = [sys.executable, "-c", program, "simulate", "out", "--frames", "1"]
    done = subprocess.run(command, cwd=tmp_path / "gone", capture_output=True, text=True)
    assert done.returncode == 2 and "the working directory (was it removed?)" in done.stderr
