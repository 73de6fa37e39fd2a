"""Every setting of ``calibrate`` and ``track`` at its lowest and its highest value, on a tiny street.

    OMP_NUM_THREADS=1 python -m checks.settings_walk [--only noise.] [--seconds 60] [--memory-gb 4]
    OMP_NUM_THREADS=1 python -m checks.settings_walk --part 3/4

Each case must end in a result or in a typed error (:class:`sst_graph.errors.SstGraphError`) within the time
and the memory; the others are printed, and the exit code is 1 if there are any. Cases run in a process of
their own, for a setting may abort it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from typing import Any, Literal, get_args

import gtsam
import numpy as np

from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import Range, walk_settings, with_overrides
from sst_graph.drive.preparation import Drive
from sst_graph.errors import ConfigError, SstGraphError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker import Tracker
from sst_graph.tracker.config import TrackerConfig
from sst_graph.types import Frame, GroundTruth

FRAMES = 6
METHODS = {"paper": "paper"}
"""Method that a table of settings belongs to; ``joint`` for the others."""
QUICK = {"joint": ("search.enabled=false",)}
"""What makes a method quick, for settings that have nothing to do with it."""
TRACKING = (
    "window=8",
    "start_scans=3",
    "calibration.search.enabled=false",
)
"""Settings under which a few frames are enough for the tracker to start and go on."""


@dataclass(frozen=True)
class Case:
    """One setting at one value.

    Attributes:
        command: that has the setting.
        settings: as for ``--set``; the last one is the setting that is looked at.
    """

    command: Literal["calibrate", "track"]
    settings: tuple[str, ...]


class Street:
    """A simulated drive of a few small frames, held in memory (satisfies :class:`sst_graph.types.Source`)."""

    name = "street"

    def __init__(self) -> None:
        config = SimulationConfig(
            seed=3,
            frames=FRAMES,
            width=414,
            height=125,
            motion="no_stop",
            azimuth_limit_deg=45.0,
            azimuth_step_deg=0.35,
            vehicle_density=0.25,
        )
        self._source = simulate(config)
        self._frames = list(self._source)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: int) -> Frame:
        return self._frames[position]

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    @property
    def camera(self) -> PinholeCamera:
        return self._source.camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        return self._source.nominal

    @property
    def truth(self) -> GroundTruth:
        return self._source.truth

    @cached_property
    def _drives(self) -> dict[str, list[Drive]]:
        return {}

    def prepared(self, config: CalibrationConfig) -> list[Drive]:
        """The drive under a configuration; made once for each method where it is prepared as usual."""
        if config.prepare != CalibrationConfig().prepare:
            return prepare_drives([self], config)
        if config.method not in self._drives:
            self._drives[config.method] = prepare_drives([self], config)
        return self._drives[config.method]


def cases() -> list[Case]:
    """Every numeric setting at its lowest value, then every one at its highest."""
    found: list[list[Case]] = []
    for name, field, hint in walk_settings(CalibrationConfig):
        method = METHODS.get(name.split(".")[0], "motion" if "visual_odometry" in name else "joint")
        quick = () if name.startswith("start.") else QUICK.get(method, ())
        settings = (f"method={method}", *quick)
        found.append([Case("calibrate", (*settings, f"{name}={value}")) for value in bounds(field, hint)])
    for name, field, hint in walk_settings(TrackerConfig):
        if not name.startswith("calibration."):
            extra = ("drift.enabled=true",) if name.startswith("drift.") else ()
            settings = (*TRACKING, *extra)
            found.append([Case("track", (*settings, f"{name}={value}")) for value in bounds(field, hint)])
    return [both[end] for end in (0, 1) for both in found if both]


def bounds(field: Any, hint: Any) -> list[Any]:
    """The lowest and the highest value of a setting, for all elements of a tuple; none without numbers."""
    limits, kinds = Range.of(field), [kind for kind in (int, float) if kind in (hint, *get_args(hint))]
    if not kinds or limits.low is None or limits.high is None:
        return []
    ends = [kinds[0](limits.low), kinds[0](limits.high)]
    return [[end] * len(field.default) if isinstance(field.default, tuple) else end for end in ends]


def outcome(case: Case, street: Street) -> str:
    """How a case ends: a status, or the kind of a typed error. Anything else raises."""
    try:
        if case.command == "calibrate":
            config = with_overrides(CalibrationConfig(), case.settings)
            return calibrate_prepared(street.prepared(config), street.nominal, config).status
        tracker = Tracker(street.camera, with_overrides(TrackerConfig(), case.settings), street.nominal)
        for frame in street:
            tracker.add(frame)
        last = tracker.optimize(max_iterations=3)
        tracker.estimate.history()
        return last.status
    except ConfigError:
        return "refused"
    except SstGraphError as error:
        return type(error).__name__


def _work(pipe: Connection, memory_gb: float) -> None:
    """Run the cases that come through a pipe."""
    size = int(memory_gb * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    np.seterr(all="ignore")
    street = Street()
    while True:
        case = pipe.recv()
        try:
            pipe.send((True, outcome(case, street)))
        except Exception:
            pipe.send((False, traceback.format_exc()))


class Worker:
    """A process that runs cases, begun again after one that killed it."""

    def __init__(self, seconds: float, memory_gb: float) -> None:
        self._seconds, self._memory_gb = seconds, memory_gb
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None
        self._pipe: Any = None

    def run(self, case: Case) -> tuple[bool, str]:
        """Whether a case ended as it must, and how."""
        if self._process is None:
            self._pipe, other = self._context.Pipe()
            self._process = self._context.Process(target=_work, args=(other, self._memory_gb), daemon=True)
            self._process.start()
            other.close()
            self._pipe.send(Case("calibrate", ("method=joint",)))
            self._pipe.recv()
        self._pipe.send(case)
        if not self._pipe.poll(self._seconds):
            self.stop()
            return False, f"not done after {self._seconds:g} s"
        try:
            answer: tuple[bool, str] = self._pipe.recv()
        except EOFError:
            self._process.join()
            code, self._process = self._process.exitcode, None
            return False, f"the process ended with code {code}"
        return answer

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def main(argv: Sequence[str] | None = None) -> int:
    """Run the walk; 1 if a case did not end as it must."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="settings whose name holds this text")
    parser.add_argument("--seconds", type=float, default=60.0, help="most time of a case")
    parser.add_argument("--memory-gb", type=float, default=4.0, help="most address space of a case")
    parser.add_argument("--part", default="1/1", metavar="K/N", help="the K-th of N parts (default: all)")
    parser.add_argument("--verbose", action="store_true", help="print every case")
    args = parser.parse_args(argv)
    worker, ends, failures = Worker(args.seconds, args.memory_gb), Counter[str](), 0
    chosen = [case for case in cases() if args.only in case.settings[-1].split("=")[0]]
    part, parts = map(int, args.part.split("/"))
    chosen = chosen[len(chosen) * (part - 1) // parts : len(chosen) * part // parts]
    for number, case in enumerate(chosen, 1):
        began = time.perf_counter()
        well, end = worker.run(case)
        took = time.perf_counter() - began
        ends[end if well else "FAILED"] += 1
        if not well or args.verbose:
            print(
                f"[{number}/{len(chosen)}] {case.command} {case.settings[-1]}: {took:.1f} s, {end}",
                flush=True,
            )
        failures += not well
    worker.stop()
    print(", ".join(f"{end}: {count}" for end, count in sorted(ends.items())))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
