"""Fails when a hot path takes more than 1.2 times the instructions that ``guard.json`` says.

    python -m benchmarks.guard
    python -m benchmarks.guard --renew
    python -m benchmarks.guard --slow "match a drive" 1.25 --repeats 20

Instructions are counted by valgrind (:mod:`benchmarks.instructions`): other work on the machine does not
count. Where there is no valgrind, nothing is measured: that is said on stderr, and is a failure with
``--required``. ``--renew`` writes what is found as expected, after a change that is meant to cost; beside it
stand the versions it was measured with. ``--slow`` makes a path cost more, to see that it is found.
"""

from __future__ import annotations

import argparse
import json
import pickle
import platform
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import cv2

from benchmarks.instructions import count, missing, rerun
from benchmarks.workloads import (
    C_TWIST,
    POSE,
    TIME_OFFSET_S,
    VEHICLE,
    D,
    DriveWork,
    E,
    V,
    class_view,
    frame_matches,
    frame_values,
    street,
)
from sst_graph.association.nearest import match_nearest
from sst_graph.drive.preparation import PrepareConfig, image_features, scan_features
from sst_graph.factors import frame_factor
from sst_graph.types import CameraImage, Scan

EXPECTED = Path(__file__).with_name("guard.json")
GROWTH = 1.2
"""Largest ratio to the expected instructions: below 1.25 by more than a count varies."""
CALLS = 8
PACKAGES = "numpy", "scipy", "opencv-python-headless", "gtsam", "small_gicp"
Work = Callable[[], object]


@dataclass(frozen=True)
class Inputs:
    """What the hot paths work on. It is made outside of valgrind, where that takes a second."""

    drive: DriveWork
    scan: Scan
    image: CameraImage

    @classmethod
    def of(cls) -> Inputs:
        source = street(6, moving_fraction=0.0, azimuth_limit_deg=60.0)
        frame = source[0]
        assert frame.scan is not None and frame.image is not None
        return cls(DriveWork.of(source), frame.scan, frame.image)

    def paths(self) -> dict[str, Work]:
        """By name; each of a millisecond or a few."""
        drive, problem = self.drive, self.drive.problem
        config, values = PrepareConfig(use_visual_odometry=False), frame_values()
        factor = frame_factor([frame_matches(0, 5000), frame_matches(1, 1500)], E, D, V)
        view = class_view(5000, 1500)
        return {
            "linearize a frame": lambda: factor.linearize(values),
            "linearize a drive": lambda: problem.linearized(problem.start),
            "solve a drive": lambda: problem.optimum(20),
            "match a frame": lambda: match_nearest(view, POSE, TIME_OFFSET_S, C_TWIST, 5.0),
            "match a drive": drive.match,
            "boundaries of a scan": lambda: scan_features(0, self.scan, [VEHICLE], config),
            "contours of a mask": lambda: image_features(0, self.image, [VEHICLE]),
        }


def versions() -> dict[str, str]:
    """What the counts depend on beside this package."""
    return {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}


def counted(inputs: Inputs, slowed: Mapping[str, float]) -> dict[str, int]:
    """Instructions of a call of each hot path."""
    with tempfile.NamedTemporaryFile() as file:
        pickle.dump((inputs, slowed), file)
        file.flush()
        found = rerun("benchmarks.guard", ["--count", file.name])
    return {name: round(found[name] / CALLS) for name in sorted(found)}


def count_all(file: Path) -> None:
    """In the process under valgrind."""
    cv2.setNumThreads(1)
    inputs, slowed = pickle.loads(file.read_bytes())
    works = inputs.paths()
    unknown = [name for name in slowed if name not in works]
    if unknown:
        raise SystemExit(f"--slow {unknown[0]!r}: expected one of {', '.join(works)}")
    count(works | {name: _slowed(works[name], factor) for name, factor in slowed.items()}, CALLS)


def grown(found: dict[str, int], expected: dict[str, int]) -> list[str]:
    """Paths that take more than they may."""
    if set(found) != set(expected):
        raise SystemExit(f"{EXPECTED.name}: found {sorted(expected)}, expected {sorted(found)}: use --renew")
    return [name for name in found if found[name] > GROWTH * expected[name]]


def _slowed(work: Work, factor: float) -> Work:
    """A work that costs more by a factor: every so many calls one more."""
    due = 0.0

    def more() -> None:
        nonlocal due
        due += factor
        while due > 1.0 - 1e-9:
            work()
            due -= 1.0

    return more


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--required", action="store_true", help="fail where nothing can be counted")
    parser.add_argument("--renew", action="store_true", help="write what is found as expected")
    parser.add_argument("--repeats", type=int, default=1, help="how often to count everything")
    parser.add_argument("--slow", nargs=2, action="append", default=[], metavar=("NAME", "FACTOR"))
    parser.add_argument("--count", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.count is not None:
        count_all(args.count)
        return
    reason = missing()
    if reason is not None:
        print(f"guard: NOTHING WAS CHECKED: {reason}", file=sys.stderr)
        if args.required:
            sys.exit(1)
        return
    inputs, slowed = Inputs.of(), {name: float(factor) for name, factor in args.slow}
    if args.renew:
        content = {"versions": versions(), "instructions": counted(inputs, {})}
        EXPECTED.write_text(json.dumps(content, indent=2) + "\n")
        print(EXPECTED.read_text(), end="")
        return
    content, alarms = json.loads(EXPECTED.read_text()), 0
    expected, here = content["instructions"], versions()
    for name, known in content["versions"].items():
        if here[name] != known:
            print(f"guard: {name} {here[name]} here, {known} in {EXPECTED.name}: counts differ a little")
    for _ in range(args.repeats):
        found = counted(inputs, slowed)
        above = grown(found, expected)
        alarms += bool(above)
        for name in expected:
            share = found[name] / expected[name]
            print(f"{name:<21} {found[name]:>12,} instructions, {share:.4f} of the expected", end="")
            print("  <-- grown" if name in above else "", flush=True)
    if args.repeats > 1:
        print(f"{alarms} of {args.repeats} with an alarm")
    if alarms:
        sys.exit(
            f"a hot path takes more than {GROWTH:g} times what {EXPECTED.name} says; if it is meant: --renew"
        )


if __name__ == "__main__":
    main()
