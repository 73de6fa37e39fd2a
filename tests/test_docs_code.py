"""The code in the documentation runs."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from calibrations import turned
from stored import written
from streets import HALF_SIZE

from sst_graph.cli import main
from sst_graph.export import CalibrationMarginal
from sst_graph.factors import FactorError, check_jacobians
from sst_graph.simulator import SimulationConfig

DOCS = Path(__file__).resolve().parent.parent / "docs"


def code_of(name: str) -> str:
    """The Python blocks of a page."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    return "\n".join(blocks)


@pytest.fixture(autouse=True)
def _a_marginal_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file that extending.md reads: a calibration 1 deg, 5 cm, 5 ms sure."""
    forward = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    pose = gtsam.Pose3(forward, np.array([0.06, -0.08, -0.27]))
    sigmas = np.array([*np.radians([1.0] * 3), 0.05, 0.05, 0.05, 0.005])
    known = CalibrationMarginal(pose, 0.05, np.diag(sigmas**-2), np.zeros(7))
    (tmp_path / "marginal.json").write_text(known.to_json())
    monkeypatch.chdir(tmp_path)


def test_a_factor_of_your_own() -> None:
    found: dict[str, Any] = {}
    exec(compile(code_of("graph/extending.md"), "extending.md", "exec"), found)
    assert found["report"].ok and found["report"].error < 1e-6
    E, values, factor = found["E"], found["values"], found["factor"]
    # by hand: 8 m ahead, 1 m left, 0.5 m down, seen by an unturned camera
    by_hand = gtsam.Values()
    by_hand.insert(E, gtsam.Pose3(found["forward"], np.zeros(3)))
    expected = [600.0 - 700.0 / 8.0 - 520.0, 180.0 + 350.0 / 8.0 - 240.0]
    np.testing.assert_allclose(factor.unwhitenedError(by_hand), expected)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.PriorFactorPose3(E, values.atPose3(E), noise))
    known, sharper = found["known"], found["sharper"]
    gain = np.diag(sharper.covariance()) / np.diag(known.covariance())
    # a spot in the image tells where the camera looks, and nothing of time
    assert gain.min() < 0.2 and gain[6] == pytest.approx(1.0, rel=1e-6)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert np.abs(factor.unwhitenedError(solved)).max() < 0.5 < np.abs(factor.unwhitenedError(values)).max()


def test_the_checker_finds_the_mistake_that_the_page_warns_of() -> None:
    wrong = code_of("graph/extending.md").replace("-gtsam.Rot3.Hat(lP)", "gtsam.Rot3.Hat(lP)")
    with pytest.raises(FactorError, match="by E0"):
        exec(compile(wrong, "extending.md", "exec"), {"check_jacobians": check_jacobians})


def test_results_of_several_drives_are_fused(tmp_path: Path) -> None:
    for name, more_s in (("monday", 0.0), ("tuesday", 1e-6)):
        (tmp_path / name).mkdir()
        result = replace(turned(3), time_offset_s=turned(3).time_offset_s + more_s)
        (tmp_path / name / "calibration.json").write_text(result.to_json())
    found: dict[str, Any] = {}
    exec(compile(code_of("how-to/fusing.md"), "fusing.md", "exec"), found)
    np.testing.assert_allclose(found["fused"].covariance(), turned(3).covariance / 2.0, atol=1e-12)


@pytest.mark.slow
def test_a_simulated_bag_goes_through_the_pages_on_bags(capsys: pytest.CaptureFixture[str]) -> None:
    page = (DOCS / "how-to/ros.md").read_text(encoding="utf-8")
    exec(compile(code_of("how-to/ros.md"), "ros.md", "exec"), {})
    calibrate, export = re.findall(r"^sst-graph ((?:calibrate recorded|export) .*)$", page, re.MULTILINE)
    assert main(["info", "recorded", "--mask-topic", "/camera/mask"]) == 0
    frames = re.search(r"by transforms (\S+) - (\S+)", capsys.readouterr().out)
    assert frames is not None
    assert main(shlex.split(calibrate)) == 0
    assert main(shlex.split(export)) == 0
    launch = Path("camera.launch.py").read_text()
    assert all(f'"{name}"' in launch for name in frames.groups())

    found: dict[str, Any] = {}
    exec(compile(code_of("how-to/ros-node.md"), "ros-node.md", "exec"), found)
    (printed,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("{"))
    line = json.loads(printed)
    assert line["time_offset_s"] == pytest.approx(0.05, abs=0.01)  # the simulator's


@pytest.mark.slow
def test_a_lens_in_python(tmp_path: Path) -> None:
    (tmp_path / "drive").symlink_to(written(SimulationConfig(seed=5, frames=1, width=1242, height=375)))
    found: dict[str, Any] = {}
    exec(compile(code_of("how-to/cameras.md"), "cameras.md", "exec"), found)
    source = found["source"]
    assert source[0].image.pixels.shape[:2] == (source.camera.height, source.camera.width) > (375, 1242)


@pytest.mark.slow
def test_a_calibration_in_your_own_graph(tmp_path: Path) -> None:
    street = replace(HALF_SIZE, seed=5, frames=16, time_offset_s=0.03, motion="no_stop", moving_fraction=0.0)
    (tmp_path / "drive").symlink_to(written(street))
    found: dict[str, Any] = {}
    exec(compile(code_of("graph/slam.md"), "slam.md", "exec"), found)
    solution, truth = found["solution"], found["drive"].truth
    sigmas = np.sqrt(np.diag(solution.covariance))
    apart = truth.cTl.localCoordinates(solution.values.atPose3(found["E"](0)))
    late = solution.values.atVector(found["D"](0))[0] - truth.time_offset_s
    assert (np.abs([*apart, late]) < 4.0 * sigmas).all()
    start = truth.cTl.localCoordinates(found["drive"].nominal)
    assert np.linalg.norm(apart[:3]) < 0.25 * np.linalg.norm(start[:3]) and abs(late) < 0.01
    update = found["update"]  # iSAM2's, of the same drive
    between = solution.values.atPose3(found["E"](0)).localCoordinates(update.values.atPose3(found["E"](0)))
    later = update.values.atVector(found["D"](0))[0] - solution.values.atVector(found["D"](0))[0]
    assert update.converged and (np.abs([*between, later]) < 0.5 * sigmas).all()
    np.testing.assert_allclose(np.sqrt(np.diag(update.covariance)), sigmas, rtol=0.5)
    factor, by_hand = found["factor"], found["matches"]
    assert len(by_hand) > 50 and factor.error(solution.values) < len(by_hand)


NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@pytest.mark.slow
@pytest.mark.parametrize("page", ["start/first.md", "how-to/inspect.md"])
def test_the_commands_of_a_page_print_what_it_shows(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Words are the same, and numbers within a tenth: they are rounded, and vary by machine."""
    blocks = re.findall(r"```\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    for line in lines:
        if line.startswith("sst-graph ") and "--help" not in line:
            assert main(shlex.split(line)[1:]) in (0, 3), line
    printed: dict[str, list[str]] = {}
    for line in capsys.readouterr().out.splitlines():
        printed.setdefault(_words(line), []).append(line)
    shown = [line for line in lines if NUMBER.search(line) and "sst-graph" not in line]
    shown = [line for line in shown if not line.startswith(("python3", ".venv"))]
    assert len(shown) > 4
    for line in shown:
        candidates = printed.get(_words(line), [])
        assert any(_agree(line, other) for other in candidates), f"{page}: {line}\n{candidates}"


def _words(line: str) -> str:
    return " ".join(NUMBER.sub("#", line).split())


def _agree(line: str, other: str) -> bool:
    values = [[float(x) for x in NUMBER.findall(text)] for text in (line, other)]
    return np.allclose(*values, rtol=0.1, atol=0.011)


@pytest.mark.slow
def test_a_graph_of_your_own_without_labels(tmp_path: Path) -> None:
    """The data's own calibration, which the page begins at, is 0.7 deg and 5 cm off."""
    street = SimulationConfig(
        seed=504, frames=12, motion="no_stop", azimuth_limit_deg=50.0, time_offset_s=0.03
    )
    (tmp_path / "drive").symlink_to(written(street))
    code = (
        code_of("graph/edges.md")
        .replace("drive.nominal", "nominal")
        .replace(
            "frames = list(drive)",
            "off = np.array([0.008, -0.006, 0.007, 0.03, -0.03, 0.027])\n"
            "nominal = drive.truth.cTl.retract(off)\nframes = list(drive)",
        )
    )
    found: dict[str, Any] = {}
    exec(compile(code, "edges.md", "exec"), found)
    solution, truth = found["solution"], found["drive"].truth
    assert {c for each in solution.matches for c in each.found.classes} == {found["SemanticClass"].OBJECT}
    apart = truth.cTl.localCoordinates(solution.values.atPose3(found["E"](0)))
    late = solution.values.atVector(found["D"](0))[0] - truth.time_offset_s
    assert solution.converged
    assert (np.abs([*apart, late]) < 4.0 * np.sqrt(np.diag(solution.covariance))).all()
    assert np.degrees(np.linalg.norm(apart[:3])) < 0.35 and abs(late) < 0.01
    # the same images frame by frame, but for the last four
    update = found["update"]
    apart = truth.cTl.localCoordinates(update.values.atPose3(found["E"](0)))
    late = update.values.atVector(found["D"](0))[0] - truth.time_offset_s
    assert update.converged
    assert (np.abs([*apart, late]) < 4.0 * np.sqrt(np.diag(update.covariance))).all()


def test_links_between_pages_lead_somewhere() -> None:
    for page in (*DOCS.rglob("*.md"), DOCS.parent / "README.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_glossary_has_forty_terms_at_most() -> None:
    page = (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?!term|---)(.+)\|$", page, re.MULTILINE)
    assert 30 <= len(rows) <= 40
    assert all(row.rsplit("|", 1)[1].strip() for row in rows)  # each has its source


def test_every_test_that_a_page_names_is_there() -> None:
    """A row of a fault matrix is worth what its test is: ``tests/a.py::test_b``, ``::test_c`` of the same."""
    named, missing = 0, []
    for page in sorted(DOCS.rglob("*.md")):
        path = ""
        for file, name in re.findall(r"`(tests/[\w/]+\.py)?::(\w+)`", page.read_text(encoding="utf-8")):
            path = file or path
            source = DOCS.parent / path
            named += 1
            if not source.is_file() or f"def {name}(" not in source.read_text(encoding="utf-8"):
                missing.append(f"{page.name}: {path}::{name}")
    assert named > 15 and missing == []
