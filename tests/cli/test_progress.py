"""Progress, quiet runs, JSON and completion, as a user meets them."""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from stored import written

from sst_graph.batch import CalibrationConfig, calibrate
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.causes import fit_labels
from sst_graph.cli import main
from sst_graph.cli.messages import Loudness, loudness
from sst_graph.cli.progress import EVERY_S, FIRST_S, ProgressBar, counted
from sst_graph.drive.stages import begin, run_stage, stage, under
from sst_graph.errors import EstimationError
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.stepwise import Stepwise
from sst_graph.types import Guess

SMALL = ["--frames", "2", "--set", "width=160", "--set", "height=64", "--set", "azimuth_step_deg=2"]
STREET = SimulationConfig(seed=4, frames=4, width=276, height=84, azimuth_step_deg=0.5, vehicle_density=0.3)


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plain lines, as in a process of the command's own."""
    monkeypatch.setattr(loudness, "lines", True)
    monkeypatch.setattr(loudness, "quiet", False)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the progress sees [s], in a list of one."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.usefixtures("lines")
def test_work_over_two_seconds_has_lines(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar() as progress:
        solve = progress.stage("solve")
        for done, seconds in enumerate((0.5, 2.1, 3.0, 12.0, 13.1), 1):
            clock[0] = 100.0 + seconds
            solve(done, 8)
    assert (FIRST_S, EVERY_S) == (2.0, 10.0)
    said = capsys.readouterr().err.splitlines()
    assert said == ["sst-graph: progress: solve: 2 of 8 (25 %)", "sst-graph: progress: solve: 5 of 8 (62 %)"]


@pytest.mark.usefixtures("lines")
@pytest.mark.parametrize(("stages", "seconds", "told"), [(20, 1.0, (1, 11)), (3, 0.6, ())])
def test_short_stages_count_together(
    stages: int, seconds: float, told: tuple[int, ...], clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with ProgressBar() as progress:
        for k in range(stages):
            clock[0] += seconds
            progress(f"stage {k}", 1, 1)
    said = capsys.readouterr().err.splitlines()
    assert said == [f"sst-graph: progress: stage {k}: 1 of 1 (100 %)" for k in told]


@pytest.mark.usefixtures("lines")
def test_a_stage_of_one_step_has_lines_while_it_goes_on(
    clock: list[float], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the time of loading counts: where that was long, the first stage is said at once."""
    monkeypatch.setattr(loudness, "began_s", 97.0)
    with ProgressBar() as progress:
        for _ in range(25):
            begin(progress, "search")
            clock[0] += 1.0
        progress("search", 1, 1)
    said = capsys.readouterr().err.splitlines()
    assert said == ["sst-graph: progress: search"] * 3


@pytest.mark.slow
def test_the_stages_of_a_calibration_have_names() -> None:
    told: list[tuple[str, int, int]] = []
    calibrate(simulate(STREET), config=CalibrationConfig(), progress=lambda *step: told.append(step))
    assert {"search of the start", "solve"} <= {stage for stage, _, _ in told}
    assert told[-1] == ("likely causes", 1, 1)
    assert all(0 <= done <= total and total > 0 for _, done, total in told)
    ends = {name: (done, total) for name, done, total in told}
    assert all(total == ends[name][1] for name, _, total in told), "one total for each stage"
    assert all(done == total for done, total in ends.values()), ends


@pytest.mark.slow
def test_a_search_for_causes_is_one_stage() -> None:
    source, config = simulate(STREET), CalibrationConfig()
    (drive,) = prepare_drives([source], config)
    told: list[tuple[str, int, int]] = []
    fit = fit_labels(config, lambda *step: told.append(step))
    assert fit(drive, Guess(source.truth.cTl, 0.0)) is not None
    assert len(told) > 10 and {*told} == {("likely causes", 0, 1)}


def test_a_stage_of_steps_ends_once() -> None:
    def steps() -> Stepwise[str]:
        yield 1
        yield 1
        return "found"

    told: list[tuple[str, int, int]] = []

    def progress(name: str, done: int, total: int) -> None:
        told.append((name, done, total))

    assert run_stage(steps(), progress, "search") == "found" == run_stage(steps(), None, "search")
    assert told == [("search", 0, 1)] * 3 + [("search", 1, 1)]
    told.clear()
    with stage(progress, "causes"):
        inside = under(progress, "causes")
        assert inside is not None and under(None, "causes") is None
        for done in range(1, 4):
            inside("solve", done, 3)
    assert told == [("causes", 0, 1)] * 4 + [("causes", 1, 1)]
    told.clear()
    with pytest.raises(EstimationError), stage(progress, "failed"):
        raise EstimationError("no match")
    assert told == [("failed", 0, 1)]


def test_nothing_is_said_in_a_process_of_others(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    assert loudness == Loudness(loudness.quiet, lines=False)
    with ProgressBar() as progress:
        for item in counted("abc", "abc", progress.stage("letters")):
            clock[0] += 60.0
            assert item in "abc"
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_terminal_has_a_bar_and_quiet_has_none(tmp_path: Path) -> None:
    for options, has_bar in (([], True), (["-q"], False)):
        main_end, process_end = pty.openpty()
        termios.tcsetwinsize(process_end, (24, 80))
        arguments = ["simulate", str(tmp_path / f"street{has_bar}"), *SMALL, *options]
        done = subprocess.run(
            [sys.executable, "-m", "sst_graph", *arguments],
            stdout=subprocess.PIPE,
            stderr=process_end,
            text=True,
        )
        os.set_blocking(main_end, False)
        try:
            shown = os.read(main_end, 1 << 16)
        except BlockingIOError:
            shown = b""
        os.close(main_end)
        os.close(process_end)
        assert done.returncode == 0
        assert (b"simulate" in shown) == has_bar
        assert ("wrote" in done.stdout) == has_bar


def test_quiet_leaves_results_and_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", str(tmp_path / "a"), *SMALL, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main(["info", str(tmp_path / "a"), "-q"]) == 0
    assert "a/00" in capsys.readouterr().out
    assert main(["simulate", str(tmp_path / "a"), *SMALL, "--quiet"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "a"), "-q", "-v"]) == 2
    assert "not allowed with" in capsys.readouterr().err


@pytest.mark.slow
def test_a_calibration_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    street = SimulationConfig(
        seed=4, frames=2, width=276, height=84, azimuth_step_deg=0.5, vehicle_density=0.3, motion="standing"
    )
    out = tmp_path / "out"
    options = ["--no-report", "--json", "--set", "search.enabled=false"]
    code = main(["calibrate", str(written(street)), "--out", str(out), *options])
    found = json.loads(capsys.readouterr().out)
    result = read_result(out / "calibration.json")
    assert code == (0 if result.status == "ok" else 3) and found["status"] == result.status
    np.testing.assert_allclose(found["T_camera_lidar"], result.T_camera_lidar.matrix())
    assert found["time_offset_s"] == result.time_offset_s
    assert found["files"][0] == "calibration.json" and found["out"] == str(out)
    assert found["errors"]["qad_deg"] < 5.0 and found["errors_against"] == "the truth"


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh", "fish"])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in ("calibrate", "overlay", "view", "image-shift"))


def test_bash_accepts_the_script_and_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion"
    script.write_text(capsys.readouterr().out)
    ask = (
        f"source {script}; COMP_WORDS=(sst-graph calib); COMP_CWORD=1; COMP_LINE='sst-graph calib'; "
        "f=$(complete -p sst-graph | sed 's/.*-F \\([^ ]*\\).*/\\1/'); $f sst-graph calib sst-graph; "
        "echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True)
    assert done.stdout.split() == ["calibrate"], done.stderr


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_accepts_the_script_and_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "fish"]) == 0
    script = tmp_path / "sst-graph.fish"
    script.write_text(capsys.readouterr().out)
    found = {}
    for line in ("sst-graph calib", "sst-graph calibrate --image-sh", "sst-graph calibrate --method stat"):
        ask = ["fish", "--no-config", "-c", f"source {script}; complete -C {line!r}"]
        done = subprocess.run(ask, capture_output=True, text=True)
        assert not done.stderr
        found[line.split()[-1]] = [answer.split("\t")[0] for answer in done.stdout.splitlines()]
    assert found == {"calib": ["calibrate"], "--image-sh": ["--image-shift"], "stat": ["static"]}


def test_without_shtab_the_message_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "pip install 'sst-graph[completion]'" in captured.err
