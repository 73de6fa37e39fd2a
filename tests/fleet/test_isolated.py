"""Processes of their own: how they end, what they take, and that they do not outlive who started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sst_graph.fleet import isolated
from sst_graph.fleet.isolated import Ending, Limits, run_isolated

MB = 1 << 20
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's parent death signal")


def run(code: str, limits: Limits | None = None) -> Ending:
    return run_isolated([sys.executable, "-c", code], dict(os.environ), limits or Limits(), "/")


@pytest.mark.parametrize(
    ("code", "expected", "words", "from_outside"),
    [
        ("raise SystemExit(3)", 3, "exit code 3", False),
        ("import ctypes; ctypes.string_at(0)", -signal.SIGSEGV, "SIGSEGV", False),
        ("import os; os.abort()", -signal.SIGABRT, "SIGABRT", False),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL, "SIGKILL", True),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", -signal.SIGTERM, "SIGTERM", True),
        ("raise SystemExit(128 + 15)", 143, "SIGTERM", True),
        ("1 / 0", 1, "exit code 1", False),
    ],
)
def test_how_a_process_ended(code: str, expected: int, words: str, from_outside: bool) -> None:
    ending = run(code)
    assert (ending.code, ending.limit, ending.words) == (expected, "", words)
    assert ending.from_outside == from_outside and not ending.short_of_memory


def test_what_it_took_and_what_it_said() -> None:
    ending = run(
        "x = bytearray(80 << 20); s = sum(range(4_000_000)); import sys; sys.stderr.write('a\\nb\\n')"
    )
    assert ending.code == 0 and ending.log == ("a", "b")
    assert 80 * MB < ending.peak_bytes < 200 * MB
    assert 0.02 < ending.cpu_s < 10.0 and ending.wall_s >= 0.02


def test_the_memory_limit_ends_it() -> None:
    code = "import time\nx = []\nwhile True: x.append(bytearray(1 << 20)); time.sleep(0.002)"
    ending = run(code, Limits(memory_bytes=100 * MB))
    assert (ending.limit, ending.code, ending.from_outside) == ("memory", -signal.SIGKILL, False)
    assert 100 * MB < ending.peak_bytes < 400 * MB


def test_the_time_limit_ends_it() -> None:
    ending = run("import time; time.sleep(60)", Limits(wall_s=0.3))
    assert (ending.limit, ending.code) == ("time", -signal.SIGTERM) and ending.wall_s < 10.0


def test_one_that_does_not_heed_the_time_limit_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sst_graph.fleet.isolated._GRACE_S", 0.2)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"
    ending = run(code, Limits(wall_s=0.5))
    assert (ending.limit, ending.code) == ("time", -signal.SIGKILL)


PARENT = """
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("isolated", sys.argv[2])  # the package's start takes seconds
isolated = sys.modules["isolated"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(isolated)
child = "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(60)"
command = [sys.executable, "-c", child, sys.argv[1]]
isolated.run_isolated(command, dict(os.environ), isolated.Limits(), "/")
"""


@LINUX
def test_a_killed_parent_leaves_nothing_running(tmp_path: Path) -> None:
    told = tmp_path / "pid"
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(told), isolated.__file__])
    deadline = time.monotonic() + 30.0
    while not (told.exists() and told.read_text()) and time.monotonic() < deadline:
        time.sleep(0.02)
    pid = int(told.read_text())
    parent.kill()
    parent.wait()
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return  # dead, and nobody has asked for its code
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("it still runs")
