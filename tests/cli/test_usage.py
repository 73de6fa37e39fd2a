"""The command itself: usage, help, version, exit codes."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import sst_graph
from sst_graph.cli import main
from sst_graph.cli.options import build_parser

COMMANDS = ("demo", "simulate", "calibrate", "evaluate", "overlay")


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sst_graph", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_version() -> None:
    done = _run("--version")
    assert (done.returncode, done.stdout) == (0, f"sst-graph {version('sst-graph')}\n")
    assert sst_graph.__version__ == version("sst-graph")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from sst_graph.cli.options import build_parser\n"
        "build_parser().format_help()\n"
        "print([m for m in ('gtsam', 'cv2', 'scipy', 'numpy', 'small_gicp') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    assert len(capsys.readouterr().out) > 200


def test_help_states_sign_and_direction() -> None:
    text = " ".join(_run("calibrate", "--help").stdout.split())
    assert "p_camera = T_camera_lidar . p_lidar" in text
    assert "t_lidar = t_camera_stamp + offset" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["calibrate"], "the following arguments are required: DATA"),
        (["calibrate", "x", "--metod", "paper"], "unrecognized arguments: --metod"),
        (["calibrate", "x", "--method", "magic"], "invalid choice: 'magic'"),
        (["evaluate", "x"], "the following arguments are required: --truth"),
        (["simulate", "x", "--frames", "many"], "argument --frames: invalid int value: 'many'"),
        (["simulate", "x", "--time-offset", "1,5"], "argument --time-offset: invalid float value: '1,5'"),
        (["evaluate", "x", "--truth=--"], "argument --truth: found --, expected a value"),
        (["info", "x", "--camera=--"], "argument --camera: found --, expected a value"),
        (["calibrate", "x", "--camera=--"], "argument --camera: found --, expected a value"),
    ],
)
def test_usage_errors_are_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("sst-graph: error: ") and message in captured.err
    assert "--help" in captured.err


def test_a_nul_in_an_argument_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["calibrate", "a\0", "--out", "b"], ["export", "a", "--to", "kitti", "--out", "b\0"]):
        assert main(arguments) == 2
        assert "found a NUL character" in capsys.readouterr().err


def test_bad_input_from_the_shell(tmp_path: Path) -> None:
    done = _run("evaluate", str(tmp_path / "none.json"), "--truth", str(tmp_path / "truth.json"))
    assert done.returncode == 2 and done.stdout == ""
    assert (
        done.stderr
        == f"sst-graph: error: {tmp_path}/none.json: found no such file, expected a calibration.json\n"
    )


def test_a_package_of_others_that_does_not_load(tmp_path: Path) -> None:
    (tmp_path / "scipy.py").write_text("raise OSError('libx.so: cannot open shared object file')\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    command = [sys.executable, "-m", "sst_graph", "inspect", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "libx.so: cannot open shared object file" in done.stderr and "defect" not in done.stderr
    (tmp_path / "scipy.py").write_text("int('abc')\n")
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "error: scipy does not load: ValueError: invalid literal" in done.stderr


def test_a_closed_pipe_is_no_crash(tmp_path: Path) -> None:
    command = f"{sys.executable} -m sst_graph calibrate --help | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""


def test_every_command_has_its_module() -> None:
    folder = Path(__file__).resolve().parents[2] / "sst_graph" / "cli" / "commands"
    assert [name for name in COMMANDS if not (folder / f"{name}.py").is_file()] == []
    assert build_parser().parse_args(["demo"]).command == "demo"


def test_the_package_offers_its_names_on_demand() -> None:
    code = (
        "import sys, sst_graph\n"
        "heavy = [m for m in ('cv2', 'scipy', 'small_gicp') if m in sys.modules]\n"
        "print(heavy, all(callable(getattr(sst_graph, name)) for name in sst_graph.__all__))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[] True\n"
