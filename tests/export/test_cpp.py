"""A marginal read by a C++ program says what it says in Python; where a compiler and Eigen are there."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.export import EXTRINSIC, TIME_OFFSET, CalibrationMarginal

SOURCE = Path(__file__).resolve().parents[2] / "examples" / "marginal_reader.cpp"
INCLUDES = [Path("/usr/include"), Path("/usr/local/include")]
EIGEN = [folder / "eigen3" for folder in INCLUDES if (folder / "eigen3").is_dir()]
JSON = [folder for folder in INCLUDES if (folder / "nlohmann" / "json.hpp").is_file()]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("g++")
    if compiler is None or not EIGEN or not JSON:
        pytest.skip("needs g++, Eigen and nlohmann/json")
    program = tmp_path_factory.mktemp("cpp") / "marginal_reader"
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{EIGEN[0]}"]
    subprocess.run([compiler, *flags, str(SOURCE), "-o", str(program)], check=True, timeout=300)
    return program


def _marginal() -> CalibrationMarginal:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(7, 12)) / np.array([0.002] * 3 + [0.02] * 3 + [0.004])[:, None]
    forward = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    cTl = gtsam.Pose3(forward, np.array([0.06, -0.08, -0.27]))
    return CalibrationMarginal(cTl, 0.07, A @ A.T / 12.0, rng.normal(size=7), 3.5)


def test_cpp_reads_the_same_cost(reader: Path, tmp_path: Path) -> None:
    """Near the point, a radian away, and at the point itself: gtsam's LinearContainerFactor agrees."""
    marginal, rng = _marginal(), np.random.default_rng(5)
    path = tmp_path / "marginal.json"
    path.write_text(marginal.to_json())
    factor, lines, costs, steps = marginal.factor(), [], [], []
    for size in (0.0, 1e-6, 1e-2, 1.0):
        d = size * rng.uniform(-0.5, 0.5, 7)
        cTl, time_offset_s = there = marginal.at.retract(d)
        values = gtsam.Values()
        values.insert(EXTRINSIC, cTl)
        values.insert(TIME_OFFSET, np.array([time_offset_s]))
        costs.append(factor.error(values))
        steps.append(marginal.at.local_coordinates(there))
        lines.append(" ".join(repr(float(x)) for x in [*cTl.matrix()[:3].ravel(), time_offset_s]))
    done = subprocess.run(
        [reader, path], input="\n".join(lines), capture_output=True, text=True, check=True, timeout=60
    )
    answer = np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])
    np.testing.assert_allclose(answer[:, 1:], steps, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(answer[:, 0], costs, rtol=1e-9)


def test_cpp_refuses_another_file(reader: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text('{"format": "something else", "version": 1}')
    done = subprocess.run([reader, path], input="", capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "not an sst-graph/marginal" in done.stderr
    missing = tmp_path / "missing.json"
    done = subprocess.run([reader, missing], input="", capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "missing.json: cannot be opened" in done.stderr
