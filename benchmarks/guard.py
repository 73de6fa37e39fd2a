"""Fails when the cost of a hot path has grown by more than a quarter.

    OMP_NUM_THREADS=1 python -m benchmarks.guard
    OMP_NUM_THREADS=1 python -m benchmarks.guard --renew
    OMP_NUM_THREADS=1 python -m benchmarks.guard --slow "match a drive" 1.3 --repeats 20

Each hot path is measured in units of a fixed work of the same kind (NumPy on arrays of 5,000 numbers, small
calls of NumPy and gtsam, OpenCV on a picture), which has a turn beside every turn of the path: what slows the
machine slows both. Processor seconds count, and the median of the turns' ratios. ``guard.json`` holds the
expected ones; ``--renew`` writes them after a change that is meant to cost, and on other processors. A
path above its limit is measured on, a few times, before it is reported. ``--slow`` makes a path cost more, to
see that it is found.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import cv2
import gtsam
import numpy as np

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

EXPECTED = Path(__file__).with_name("guard.json")
GROWTH = 1.2
"""Largest ratio to the expected one: a quarter less the noise, so that a quarter is found."""
ROUNDS, PASSES = 40, 4
"""Turns of a pass; most passes over what is above its limit."""
TURN_S = 3e-3
"""Least length of a turn: as many calls as it takes."""
Work = Callable[[], object]


def reference() -> Work:
    """Fixed work like that of the hot paths, none of it of this package."""
    rng = np.random.default_rng(0)
    rows, index = rng.uniform(1.0, 2.0, (8, 5000)), rng.integers(0, 5000, 5000)
    small, picture = rng.uniform(size=(6, 6)), rng.integers(0, 255, (188, 621), np.uint8)
    u, v = (rng.uniform(0.0, 180.0, (5, 2000)).astype(np.float32) for _ in range(2))
    pose = gtsam.Pose3.Expmap(np.full(6, 0.1))

    def work() -> None:
        for _ in range(2):  # long arrays
            scaled = rows * rows[0] + rows[1] / rows[2]
            scaled @ scaled.T
            np.where(scaled[3] > 3.0, np.sqrt(scaled[4]), 0.0)[index].sum()
        for _ in range(40):  # short calls
            moved = pose * pose
            np.zeros((6, 6))[:3] = (small @ small)[:3] + moved.matrix()[0, 0]
        blurred = cv2.GaussianBlur(picture, (0, 0), 1.0)  # a picture
        cv2.remap(blurred, u, v, cv2.INTER_LINEAR)

    return work


def hot_paths() -> dict[str, Work]:
    """By name; each of a millisecond or a few."""
    source = street(6, moving_fraction=0.0, azimuth_limit_deg=60.0)
    work, config = DriveWork.of(source), PrepareConfig(use_visual_odometry=False)
    frame = source[0]
    assert frame.scan is not None and frame.image is not None
    scan, image, problem = frame.scan, frame.image, work.problem
    factor, values = frame_factor([frame_matches(0, 5000), frame_matches(1, 1500)], E, D, V), frame_values()
    view = class_view(5000, 1500)
    return {
        "linearize a frame": lambda: factor.linearize(values),
        "linearize a drive": lambda: problem.linearized(problem.start),
        "match a frame": lambda: match_nearest(view, POSE, TIME_OFFSET_S, C_TWIST, 5.0),
        "match a drive": work.match,
        "boundaries of a scan": lambda: scan_features(0, scan, [VEHICLE], config),
        "contours of a mask": lambda: image_features(0, image, [VEHICLE]),
    }


class Ratios:
    """Cost of works in units of the reference, each turn of a work with one of the reference beside it."""

    def __init__(self, works: Mapping[str, Work]) -> None:
        self._works, self._reference = works, reference()
        self._found: dict[str, list[float]] = {name: [] for name in works}
        self._calls = {name: self._enough(work) for name, work in works.items()}
        self._reference_calls = self._enough(self._reference)

    @staticmethod
    def _enough(work: Work) -> int:
        work()
        return max(1, round(TURN_S / min(_seconds(work, 1) for _ in range(3))))

    def measure(self, names: Collection[str], rounds: int) -> None:
        """Some more turns of some works."""
        for _ in range(rounds):
            for name in names:
                unit = _seconds(self._reference, self._reference_calls) / self._reference_calls
                seconds = _seconds(self._works[name], self._calls[name]) / self._calls[name]
                self._found[name].append(seconds / unit)

    def median(self, name: str) -> float:
        """Of all turns of a work."""
        return statistics.median(self._found[name])


def _seconds(work: Work, calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        work()
    return time.process_time() - began


def grown(works: Mapping[str, Work], expected: Mapping[str, float]) -> tuple[dict[str, float], set[str]]:
    """Ratio of each work to the expected one, and the works above the limit after all passes."""
    ratios, above = Ratios(works), set(works)
    for _ in range(PASSES):
        ratios.measure([name for name in works if name in above], ROUNDS)
        above = {name for name in above if ratios.median(name) > GROWTH * expected[name]}
        if not above:
            break
    return {name: ratios.median(name) / expected[name] for name in works}, above


def _expected(works: Mapping[str, Work]) -> dict[str, float]:
    content = json.loads(EXPECTED.read_text())
    if set(content) != set(works):
        raise SystemExit(f"{EXPECTED.name}: found {sorted(content)}, expected {sorted(works)}: use --renew")
    return {name: float(ratio) for name, ratio in content.items()}


def _slowed(work: Work, factor: float) -> Work:
    """A work that costs more by a factor: every so many calls one more."""
    done = 0.0

    def more() -> None:
        nonlocal done
        done += factor
        while done >= 1.0:
            work()
            done -= 1.0

    return more


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--renew", action="store_true", help="write what is found as expected")
    parser.add_argument("--repeats", type=int, default=1, help="how often to measure everything")
    parser.add_argument("--slow", nargs=2, action="append", default=[], metavar=("NAME", "FACTOR"))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    works = hot_paths()
    if args.renew:
        ratios = Ratios(works)
        ratios.measure(list(works), PASSES * ROUNDS)
        found = {name: round(ratios.median(name), 3) for name in works}
        EXPECTED.write_text(json.dumps(found, indent=2) + "\n")
        print(json.dumps(found, indent=2))
        return
    for name, factor in args.slow:
        if name not in works:
            parser.error(f"--slow {name!r}: expected one of {', '.join(works)}")
        works[name] = _slowed(works[name], float(factor))
    expected, alarms = _expected(works), 0
    for _ in range(args.repeats):
        began = time.process_time()
        shares, above = grown(works, expected)
        alarms += bool(above)
        for name, share in shares.items():
            print(f"{name}: {share:.2f} of the expected cost{'  <-- grown' if name in above else ''}")
        print(f"{time.process_time() - began:.1f} s", flush=True)
    if args.repeats > 1:
        print(f"{alarms} of {args.repeats} with an alarm")
    if alarms:
        sys.exit(f"a hot path costs {GROWTH:g} times what {EXPECTED.name} says or more; is it meant: --renew")


if __name__ == "__main__":
    main()
