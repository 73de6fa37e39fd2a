"""What a release must stand: sdist and wheel are built, installed into empty environments, and used.

    python checks/release_smoke.py [--python PATH ...]      (make release-check)

For every Python and for the newest and the oldest versions of the dependencies that pyproject.toml
allows: ``sst-graph --version``, the import of every module, ``simulate`` and ``calibrate`` (which must end
with status ok); with the extra ros, ``info`` and ``calibrate`` of a bag of the same drive (status ok, too);
with yaml and onnx added, ``inspect --plots``. The extra hf (PyTorch) is left out for its size.

Needs ``build`` and ``uv`` (the extra ``release``) and a package index.
"""

from __future__ import annotations

import argparse
import email
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
UV = (sys.executable, "-m", "uv")
PYTHONS = ("3.11", "3.12", "3.13")
RESOLUTIONS = ("highest", "lowest-direct")
IMAGE, MASK = "/camera/image_rect", "/camera/mask"  # of write_bag
EXTRAS = ("ros", "yaml", "onnx")
IN_SDIST = (
    "docs/develop/layout.md",
    "notebooks/",
    "tests/test_layers.py",
    "factors/__init__.py",
    "CITATION.cff",
    "LICENSE",
)

IMPORT_ALL = """
import importlib, pkgutil, sys, sst_graph
assert sst_graph.__file__.startswith(sys.prefix), sst_graph.__file__
names = [module.name for module in pkgutil.walk_packages(sst_graph.__path__, "sst_graph.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(len(names), "modules")
"""
WRITE_BAG = """
from sst_graph.simulator import SimulationConfig, simulate, write_bag
write_bag(simulate(SimulationConfig(frames=10, seed=3)), "bag")
"""


def main() -> int:
    """Check all environments; 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", nargs="+", type=Path, help="interpreters (default: all found)")
    pythons = parser.parse_args().python or found_pythons()
    if not pythons:
        parser.error(f"no Python {', '.join(PYTHONS)} found: name one with --python")
    with tempfile.TemporaryDirectory(prefix="sst-graph-release-") as folder:
        wheel = build(Path(folder))
        failed = [
            (python, resolution)
            for python in pythons
            for resolution in RESOLUTIONS
            if not passes(wheel, python, resolution)
        ]
    print(f"{len(pythons) * len(RESOLUTIONS) - len(failed)} passed, {len(failed)} failed")
    return 1 if failed else 0


def found_pythons() -> list[Path]:
    """One interpreter of each version that can be started, on the path or pyenv's."""
    found = []
    for number in PYTHONS:
        known = sorted(
            Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob(f"versions/{number}.*/bin/python")
        )
        on_path = shutil.which(f"python{number}")
        for python in [*([Path(on_path)] if on_path else []), *known]:
            done = subprocess.run([python, "--version"], capture_output=True, check=False)
            if done.returncode == 0:
                found.append(python)
                break
        else:
            print(f"no Python {number} on this machine: not checked")
    return found


def build(folder: Path) -> Path:
    """The wheel, made from the sdist, both looked into."""
    run([sys.executable, "-m", "build", "--installer", "uv", "--outdir", folder, ROOT])
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    compare(sdist, wheel, ROOT)
    for file in (sdist, wheel):
        print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB")
    return wheel


def compare(sdist: Path, wheel: Path, root: Path) -> None:
    """End the process where the sdist lacks something, or the wheel holds another package than ``root``."""
    with tarfile.open(sdist) as archive:
        held = [name.partition("/")[2] for name in archive.getnames()]
    for wanted in IN_SDIST:
        if not any(name.startswith(wanted) for name in held):
            raise SystemExit(f"{sdist.name} lacks {wanted}")
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.startswith("sst_graph/")}
    expected = {
        str(path.relative_to(root))
        # The second is a link, which rglob does not follow.
        for folder in (root / "sst_graph", root / "sst_graph" / "factors")
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    if packed != expected:
        raise SystemExit(f"{wheel.name} differs from the checkout in {sorted(packed ^ expected)}")


def passes(wheel: Path, python: Path, resolution: str) -> bool:
    """Install the wheel into an empty environment and use it there; say how it went."""
    start = time.perf_counter()
    name = f"{python}, {resolution}"
    with tempfile.TemporaryDirectory(prefix="sst-graph-release-") as folder:
        try:
            versions = use(wheel, python, resolution, Path(folder))
        except subprocess.CalledProcessError as error:
            command = " ".join(map(str, error.cmd))
            print(f"FAILED {name}: {command}: exit {error.returncode}\n{error.output[-3000:]}", flush=True)
            return False
    print(f"ok     {name}: {time.perf_counter() - start:.0f} s, {versions}", flush=True)
    return True


def use(wheel: Path, python: Path, resolution: str, folder: Path) -> str:
    """All that is done in one environment; the versions that were installed."""
    run([*UV, "venv", "-q", "--python", python, "env"], folder)
    binaries = folder / "env" / "bin"
    install = [*UV, "pip", "install", "-q", "--python", binaries / "python", "--resolution", resolution]
    # Wheels only: the oldest version that a newer Python has a wheel of is the oldest that its users get.
    install += ["--only-binary", ":all:"]
    command = [binaries / "sst-graph"]

    run([*install, *named(wheel)], folder)
    version = run([*command, "--version"], folder).split()[-1]
    run([binaries / "python", "-c", IMPORT_ALL], folder)
    run([*command, "simulate", "drive", "--frames", "10", "--seed", "3"], folder)
    run([*command, "calibrate", "drive", "--sweep", "compensated", "--out", "result"], folder)
    result = json.loads((folder / "result" / "calibration.json").read_text())
    if result["versions"]["sst-graph"] != version or version not in wheel.name:
        raise SystemExit(f"versions: {result['versions']['sst-graph']}, {version}, {wheel.name}")

    run([*install, *named(wheel, EXTRAS[:1])], folder)
    run([binaries / "python", "-c", WRITE_BAG], folder)
    (bag,) = (folder / "bag").glob("*.mcap")
    topics = ["--image-topic", IMAGE, "--mask-topic", MASK]
    run([*command, "info", bag, *topics], folder)
    run([*command, "calibrate", bag, *topics, "--sweep", "compensated", "--out", "of_bag"], folder)

    run([*install, *named(wheel, EXTRAS)], folder)
    run([*command, "inspect", "result", "--plots", "plots"], folder)
    lines = run([*UV, "pip", "freeze", "-q", "--python", binaries / "python"], folder).split()
    kept = (
        "gtsam",
        "numpy",
        "opencv",
        "scipy",
        "small",
        "tqdm",
        "matplotlib",
        "rosbags",
        "onnxruntime",
        "pyyaml",
    )
    return " ".join(line for line in lines if line.startswith(kept))


def named(wheel: Path, extras: Sequence[str] = ()) -> list[str]:
    """The wheel, and what it requires by name: uv takes the oldest of what is named alone."""
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        required = email.message_from_bytes(archive.read(metadata)).get_all("Requires-Dist", [])
    chosen = []
    for requirement in required:
        dependency, _, marker = requirement.partition(";")
        if not marker or any(f'extra == "{extra}"' in marker for extra in extras):
            chosen.append(dependency.strip())
    return [f"{wheel}[{','.join(extras)}]" if extras else str(wheel), *chosen]


def run(command: Sequence[str | Path], folder: Path = ROOT) -> str:
    """Output of a command; the checkout is not on its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
    )
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
