"""The ROS 2 node on a ROS 2 installation, made of wheels from a package index.

    python checks/ros_check.py [--distribution kilted] [--python PATH]      (make ros-check)

Makes an environment of the distribution's wheels and this checkout in ``build/``, builds tf2_msgs, of which
there is no wheel, from ``checks/tf2_msgs`` by the generators of ROS, and runs ``tests/ros_node``, whose
``test_over_dds.py`` starts the node as a process and talks to it over DDS. Wheels are there for Linux on
x86_64 and one Python for each distribution.

Needs cmake, a C and a C++ compiler, and the headers of Python.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

from release_smoke import found_pythons

ROOT = Path(__file__).resolve().parent.parent
PYTHONS = {"kilted": "3.11", "jazzy": "3.12"}
"""The Python that the wheels of a distribution are for."""
ONLY = {"kilted": ("ament-cmake-ros-core",), "jazzy": ("fastrtps-cmake-module", "python-cmake-module")}
"""What only the generators of a distribution need."""
RUN = ("rclpy", "rmw-fastrtps-cpp", "sensor-msgs", "diagnostic-msgs", "geometry-msgs", "std-msgs")
BUILD = (
    "rosidl-default-generators",
    "rosidl-core-generators",
    "ament-package",
    *(f"ament-cmake{part}" for part in ("", "-include-directories", "-libraries", "-python", "-version")),
    *(f"ament-cmake{part}" for part in ("-ros", "-gtest", "-gmock", "-pytest")),
)
"""What the generators need; the wheels name but some of it."""
TESTED = ("pytest", "pytest-xdist", "pytest-benchmark", "PyYAML")


def main() -> int:
    """Make the environment where it is not there, and run the tests in it; their exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--distribution", choices=PYTHONS, default="kilted")
    parser.add_argument("--python", type=Path, help="interpreter (default: a fitting one that is found)")
    options = parser.parse_args()
    if (missing := [tool for tool in ("cmake", "cc", "c++") if shutil.which(tool) is None]) != []:
        parser.error(f"{', '.join(missing)}: not found; on Debian: apt-get install cmake g++")
    environment = ROOT / "build" / f"ros-{options.distribution}"
    python = environment / "bin" / "python"
    if not (environment / "complete").exists():
        shutil.rmtree(environment, ignore_errors=True)
        run([options.python or fitting(parser, options.distribution), "-m", "venv", environment])
        install(python, options.distribution)
        build_tf2_msgs(environment)
        (environment / "complete").touch()
    tests = [python, "-m", "pytest", "-p", "no:cacheprovider", "-n", "0", "tests/ros_node"]
    return subprocess.run(tests, cwd=ROOT, check=False).returncode


def fitting(parser: argparse.ArgumentParser, distribution: str) -> Path:
    """An interpreter that the wheels are for."""
    wanted = PYTHONS[distribution]
    for python in found_pythons():
        if run([python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]).strip() == wanted:
            return python
    parser.error(f"no Python {wanted} found: name one with --python")


def install(python: Path, distribution: str) -> None:
    """The wheels of ROS, and the checkout with what its tests of the node need."""
    pip = [python, "-m", "pip", "--disable-pip-version-check", "-q", "install", "-c", "constraints.txt"]
    run([*pip, *(f"ros-{distribution}-{name}" for name in (*RUN, *BUILD, *ONLY[distribution]))])
    run([*pip, "catkin_pkg", *TESTED, "-e", ".[ros]"])


def build_tf2_msgs(environment: Path) -> None:
    """tf2_msgs with TFMessage in C, C++ and Python, installed beside the others."""
    source, build = ROOT / "checks" / "tf2_msgs", environment / "tf2_msgs"
    prefix = [f"-DCMAKE_PREFIX_PATH={environment}", f"-DCMAKE_INSTALL_PREFIX={environment}"]
    python = f"-DPython3_EXECUTABLE={environment / 'bin' / 'python'}"
    run(["cmake", "-S", source, "-B", build, *prefix, python, "-DBUILD_TESTING=OFF"])
    run(["cmake", "--build", build])
    run(["cmake", "--install", build])


def run(command: list[str | Path]) -> str:
    """Output of a command; where it fails, the end of the check with it."""
    path = os.pathsep.join([str(Path(command[0]).parent), os.environ["PATH"]])
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stdout[-3000:]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
