"""Fails when the cost of a hot path has grown by more than a quarter.

    OMP_NUM_THREADS=1 python -m benchmarks.guard
    OMP_NUM_THREADS=1 python -m benchmarks.guard --renew
    OMP_NUM_THREADS=1 python -m benchmarks.guard --slow "match a drive" 1.3 --repeats 20

Each hot path is measured in units of a fixed work of the same kind (NumPy on arrays of 5,000 numbers, small
calls of NumPy and gtsam, OpenCV on a picture), in the same run and taking turns with it: what slows the
machine slows both. Processor seconds count, and the least of many turns. ``guard.json`` holds the expected
ratios; ``--renew`` writes them after a change that is meant to cost, and on another kind of processor. A path
above its limit is measured again, a few times, before it is reported: noise only adds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
GROWTH = 1.25
"""Largest ratio to the expected one."""
ROUNDS, PASSES = 25, 16
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


@dataclass
class Turns:
    """Works that take turns, each beside the reference, and the least time of a call of each.

    Attributes:
        works: by name.
        calls: in a turn of each.
        least_s: of a call of each [s].
        reference_s: of a call of the reference beside each [s].
    """

    works: Mapping[str, Work]
    reference: Work
    slowed: Mapping[str, float] = field(default_factory=dict)
    calls: dict[str, int] = field(default_factory=dict)
    least_s: dict[str, float] = field(default_factory=dict)
    reference_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, work in (*self.works.items(), ("", self.reference)):
            work()
            self.calls[name] = max(1, round(TURN_S / _seconds(work, 1)))
            if name in self.slowed:  # so that a tenth more can be made of whole calls
                self.calls[name] = max(10, self.calls[name])

    def turn(self, name: str) -> None:
        calls = self.calls[name]
        extra = round(calls * (self.slowed.get(name, 1.0) - 1.0))
        reference_s = _seconds(self.reference, self.calls[""]) / self.calls[""]
        seconds = _seconds(self.works[name], calls + extra) / calls
        self.least_s[name] = min(self.least_s.get(name, np.inf), seconds)
        self.reference_s[name] = min(self.reference_s.get(name, np.inf), reference_s)

    def ratio(self, name: str) -> float:
        return self.least_s[name] / min(self.reference_s.values())


def _seconds(work: Work, calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        work()
    return time.process_time() - began


def above(turns: Turns, expected: Mapping[str, float]) -> list[str]:
    """Paths above their limits after the most passes, measured on until they are below."""
    suspected = list(turns.works)
    for _ in range(PASSES):
        for _ in range(ROUNDS):
            for name in suspected:
                turns.turn(name)
        suspected = [name for name in suspected if turns.ratio(name) > GROWTH * expected.get(name, np.inf)]
        if not suspected:
            break
    return suspected


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--renew", action="store_true", help="write the expected ratios")
    parser.add_argument("--slow", nargs=2, metavar=("NAME", "FACTOR"), help="make a path slower, for a trial")
    parser.add_argument("--repeats", type=int, default=1, help="of the whole, for a trial")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    works, work = hot_paths(), reference()
    slowed = {args.slow[0]: float(args.slow[1])} if args.slow else {}
    if not set(slowed) <= set(works):
        parser.error(f"--slow: found {args.slow[0]}, expected one of {', '.join(works)}")
    if args.renew:
        turns = Turns(works, work)
        above(turns, dict.fromkeys(works, 0.0))  # all passes
        ratios = {name: round(turns.ratio(name), 4) for name in works}
        EXPECTED.write_text(json.dumps(ratios, indent=2) + "\n")
        return 0
    expected = json.loads(EXPECTED.read_text())
    alarms = 0
    for _ in range(args.repeats):
        turns = Turns(works, work, slowed)
        found = above(turns, expected)
        alarms += bool(found)
        for name in works:
            growth = turns.ratio(name) / expected[name]
            print(f"{name:<22} {growth:5.2f} times the expected cost{' ABOVE' if name in found else ''}")
    if args.repeats > 1:
        print(f"{alarms} of {args.repeats} runs above a limit")
    return int(alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
