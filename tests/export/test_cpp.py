"""A marginal read by a C++ program says what it says in Python; where a compiler and Eigen are there."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.export import EXTRINSIC, TIME_OFFSET, CalibrationMarginal
from sst_graph.types import FloatArray

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
INCLUDES = [Path("/usr/include"), Path("/usr/local/include")]
EIGEN = [folder / "eigen3" for folder in INCLUDES if (folder / "eigen3").is_dir()]
JSON = [folder for folder in INCLUDES if (folder / "nlohmann" / "json.hpp").is_file()]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _compiled("marginal_reader", tmp_path_factory)


@pytest.fixture(scope="module")
def with_gtsam(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where GTSAM is installed elsewhere, CPLUS_INCLUDE_PATH, LIBRARY_PATH, LD_LIBRARY_PATH say it."""
    include = "#include <gtsam/nonlinear/LinearContainerFactor.h>"
    probe = ["g++", "-std=c++17", *(f"-isystem{folder}" for folder in EIGEN), "-fsyntax-only", "-xc++", "-"]
    if shutil.which("g++") is None:
        pytest.skip("needs g++")
    if subprocess.run(probe, input=include, text=True, capture_output=True).returncode:
        pytest.skip("needs GTSAM's headers")
    return _compiled("marginal_factor", tmp_path_factory, "-lgtsam")


def _compiled(name: str, folders: pytest.TempPathFactory, *libraries: str) -> Path:
    compiler = shutil.which("g++")
    if compiler is None or not EIGEN or not JSON:
        pytest.skip("needs g++, Eigen and nlohmann/json")
    program = folders.mktemp("cpp") / name
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-isystem{EIGEN[0]}"]
    source = str(EXAMPLES / f"{name}.cpp")
    subprocess.run([compiler, *flags, source, *libraries, "-o", str(program)], check=True, timeout=300)
    return program


def _marginal() -> CalibrationMarginal:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(7, 12)) / np.array([0.002] * 3 + [0.02] * 3 + [0.004])[:, None]
    forward = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    cTl = gtsam.Pose3(forward, np.array([0.06, -0.08, -0.27]))
    return CalibrationMarginal(cTl, 0.07, A @ A.T / 12.0, rng.normal(size=7), 3.5)


def test_cpp_reads_the_same_cost(reader: Path, tmp_path: Path) -> None:
    """Near the point, a radian away, and at the point itself: gtsam's LinearContainerFactor agrees."""
    marginal = _marginal()
    costs, steps, answer = _answers(reader, marginal, tmp_path / "marginal.json")
    np.testing.assert_allclose(answer[:, 1:], steps, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(answer[:, 0], costs, rtol=1e-9)


def test_cpp_has_the_same_factor(with_gtsam: Path, tmp_path: Path) -> None:
    """The factor that GTSAM builds from the file in C++: the same error, and the marginal's optimum."""
    marginal = _marginal()
    costs, _, answer = _answers(with_gtsam, marginal, tmp_path / "marginal.json")
    np.testing.assert_allclose(answer[:, 0], costs, rtol=1e-9)
    optimum = np.linalg.solve(marginal.information, marginal.vector)
    np.testing.assert_allclose(answer[:, 1:], np.tile(optimum, (len(answer), 1)), atol=1e-7)


def _answers(
    program: Path, marginal: CalibrationMarginal, path: Path
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """gtsam's errors in Python (n,), steps from the linearization point (n, 7), the program's lines."""
    path.write_text(marginal.to_json())
    rng, factor, lines, costs, steps = np.random.default_rng(5), marginal.factor(), [], [], []
    for size in (0.0, 1e-6, 1e-2, 1.0):
        cTl, time_offset_s = there = marginal.at.retract(size * rng.uniform(-0.5, 0.5, 7))
        values = gtsam.Values()
        values.insert(EXTRINSIC, cTl)
        values.insert(TIME_OFFSET, np.array([time_offset_s]))
        costs.append(factor.error(values))
        steps.append(marginal.at.local_coordinates(there))
        lines.append(" ".join(repr(float(x)) for x in [*cTl.matrix()[:3].ravel(), time_offset_s]))
    done = subprocess.run(
        [program, path], input="\n".join(lines), capture_output=True, text=True, check=True, timeout=60
    )
    answer = np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])
    return np.array(costs), np.array(steps), answer


def test_cpp_refuses_another_file(reader: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text('{"format": "something else", "version": 1}')
    done = subprocess.run([reader, path], input="", capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "not an sst-graph/marginal" in done.stderr
    missing = tmp_path / "missing.json"
    done = subprocess.run([reader, missing], input="", capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "missing.json: cannot be opened" in done.stderr
