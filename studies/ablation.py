"""What each heuristic is worth: the method without one of them, against the full method on the same data.

    OMP_NUM_THREADS=1 python -m studies.ablation --records RUNS.jsonl --streets first:2 --drive stop=DIR

``studies/ablation_cases.py`` has the cases. A street is 24 frames of 621 x 188 px of one of three simulators,
``first`` is the package's own; images of drives in folders are shifted by one. By labels, starts are 1 deg,
5 cm and 20 ms from the truth; by edges, and with ``--method search``, within 4 and 12 deg and 10 cm by axis,
without an offset. What is done stands in the file of records; a further call goes on from it and prints the
tables.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch import calibrate_prepared, prepare_drives
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.experiments.markdown import NONE, status_counts, table
from sst_graph.experiments.starts import error_of, start_near
from sst_graph.experiments.tasks.resumable import Work, rows_of
from sst_graph.metrics import nees
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import GroundTruth
from studies.ablation_cases import CASES, EDGES, JOINT, LEAN, NOTHING, SEARCH, Case, base_of
from studies.simulators.second_street import SecondStreet, StreetConfig
from studies.simulators.third_street import ThirdConfig, ThirdStreet

FloatArray = NDArray[np.float64]

FIRST_SEED = 9300
FRAMES = 24
TIME_OFFSET_S = 0.05
SIMULATORS = ("first", "second", "third")
METHODS = (JOINT, EDGES, SEARCH)
_WIDE_DEG = {EDGES: 4.0, SEARCH: 12.0}
"""Half width of the rotations, by axis, of starts that are searched around [deg]."""
ONE_SPEED_MPS = {"parked": 10.9}
"""Drives at one speed: there a time offset cannot be told from a shift along the road."""
_NEGLIGIBLE = (np.radians(0.03), 0.005, 0.0005)
"""Added to errors of rotation, translation and time offset in quadrature: else errors of nearly nothing would
decide [rad, m, s]."""
_SILENT_SIGMAS = 3.0
_LEAST_RATIO, _MOST_RATIO = 0.9, 1.1
"""Ratios of errors between which a heuristic makes no difference."""
_NEES_RATIO = 1.2
"""Ratio of the mean NEES up to which it is the same: that of errors, squared."""
_SURPRISE = 0.05
"""Change of the surprise up to which covariances are as good [nats]."""
_LONGEST_REASON = 120


@dataclass(frozen=True)
class Data:
    """A street or a drive of known calibration.

    Attributes:
        name: ``first-9300``, or that of a drive.
        folder: of a drive; "" for a street.
        frames: of a street.
    """

    name: str
    folder: str = ""
    frames: int = FRAMES

    @property
    def kind(self) -> str:
        """Simulator, or name of the drive."""
        return self.name.partition("-")[0]

    @cached_property
    def kept(self) -> KeptDrive:
        """All frames."""
        if self.folder:
            return KeptDrive.of(open_source(self.folder, image_shift=1))
        return street(self.kind, int(self.name.partition("-")[2]), self.frames)

    @property
    def truth(self) -> GroundTruth:
        """The calibration that is known."""
        assert self.kept.truth is not None
        return self.kept.truth

    def start(self, method: str) -> tuple[gtsam.Pose3, float]:
        """Extrinsic and time offset [s] that a run starts from: the same each time."""
        rng = np.random.default_rng([*self.name.encode(), 99])
        if method in _WIDE_DEG:
            return start_near(self.truth.cTl, _WIDE_DEG[method], 0.1, rng), 0.0
        turn, shift = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        cTl = self.truth.cTl.retract(np.concatenate([np.radians(1.0) * turn, 0.05 * shift]))
        return cTl, (self.truth.time_offset_s or 0.0) + 0.02 * float(rng.choice([-1.0, 1.0]))


def street(simulator: str, seed: int, frames: int) -> KeptDrive:
    """A small street: even seeds brake, stand and go on, odd ones do not; a fifth of the vehicles move."""
    stops = seed % 2 == 0
    common: dict[str, Any] = {"seed": seed, "frames": frames, "time_offset_s": TIME_OFFSET_S}
    common |= {"width": 621, "height": 188, "moving_fraction": 0.2}
    if simulator == "first":
        sparse: dict[str, Any] = {"azimuth_step_deg": 0.3, "azimuth_limit_deg": 60.0, "vehicle_density": 0.25}
        motion: Any = "stop_and_go" if stops else "mixed"
        return KeptDrive.of(simulate(SimulationConfig(motion=motion, **common, **sparse)))
    common |= {"focal_px": 360.75, "motion": "stop" if stops else "vary", "density": 0.2}
    if simulator == "second":
        return KeptDrive.of(SecondStreet(StreetConfig(**common)))
    return KeptDrive.of(ThirdStreet(ThirdConfig(**common)))


def config_of(method: str) -> CalibrationConfig:
    """The full method."""
    words = ["find_causes=false", f"method={EDGES if method == EDGES else JOINT}"]
    words.append(f"search.enabled={'true' if method == SEARCH else 'false'}")
    return replace(with_overrides(CalibrationConfig(), words), for_report=False)


@dataclass(frozen=True)
class Task:
    """A run: what is calibrated, how, and the name of the case."""

    data: Data
    method: str
    case: str


@dataclass(frozen=True)
class Record:
    """A run that is done.

    Attributes:
        method, data, case: names of its task.
        failed: why there is no result; empty where there is.
        error, covariance: of extrinsic and time offset.
        status, reasons: of the result.
        seconds: of the CPU.
    """

    method: str
    data: str
    case: str
    failed: str = ""
    error: Sequence[float] = ()
    covariance: Sequence[Sequence[float]] = ()
    status: str = ""
    reasons: Sequence[str] = ()
    seconds: float = 0.0


def records_of(tasks: Sequence[Task]) -> Iterator[list[Record]]:
    """The runs of one method on one drive."""
    runner = Runner(tasks[0].data, tasks[0].method)
    for task in tasks:
        yield [runner.record(next(case for case in CASES if case.name == task.case))]


class Runner:
    """Runs cases on one drive, which is prepared once for those that leave the preparation as it is."""

    def __init__(self, data: Data, method: str) -> None:
        self._data, self._method = data, method
        self._prepared: tuple[list[Drive], float] | None = None

    def record(self, case: Case) -> Record:
        """One calibration; what fails says why."""
        found = Record(self._method, self._data.name, case.name)
        try:
            return replace(found, **self._calibrated(case))
        except Exception as error:  # a case may well break the method: that is a finding, too
            return replace(found, failed=f"{type(error).__name__}: {error}"[:_LONGEST_REASON])

    def _calibrated(self, case: Case) -> dict[str, Any]:
        data, config = self._data, case.configured(config_of(self._method))
        start, time_offset_s = data.start(self._method)
        drives, prepare_s = self._drives(case, config)
        began = time.process_time()
        with base_of(case, self._method).left_out(), case.left_out():
            result = calibrate_prepared(drives, start, config, initial_time_offset_s=time_offset_s)
        seconds = time.process_time() - began
        return {
            "error": error_of(result.calibration, data.truth).tolist(),
            "covariance": result.covariance.tolist(),
            "status": result.status,
            "reasons": [reason[:_LONGEST_REASON] for reason in result.reasons],
            "seconds": prepare_s + seconds,
        }

    def _drives(self, case: Case, config: CalibrationConfig) -> tuple[list[Drive], float]:
        """The prepared drive, and the CPU seconds that it took."""
        if not case.prepared and self._prepared is not None:
            return self._prepared
        began = time.process_time()
        with case.left_out() if case.prepared else NOTHING.left_out():
            drives = prepare_drives([self._data.kept], config)
        found = drives, time.process_time() - began
        if not case.prepared:
            self._prepared = found
        return found


@dataclass(frozen=True)
class Run:
    """What a run found.

    Attributes:
        kind: of its data.
        error, covariance: (n,), (n, n) of extrinsic and time offset; on a drive at one speed (6,), (6, 6),
            with speed times the offset's error taken off the shift along the road.
        status, seconds: of the result, and the CPU's.
    """

    kind: str
    error: FloatArray
    covariance: FloatArray
    status: str
    seconds: float

    @classmethod
    def of(cls, record: Record) -> Run:
        """From a record."""
        kind = record.data.partition("-")[0]
        error, covariance = np.array(record.error), np.array(record.covariance)
        if kind in ONE_SPEED_MPS:
            seen = np.eye(6, 7)
            seen[3, 6] = -ONE_SPEED_MPS[kind]
            error, covariance = seen @ error, seen @ covariance @ seen.T
        return cls(kind, error, covariance, record.status, record.seconds)

    @property
    def sizes(self) -> list[float]:
        """Error of rotation, translation, and time offset where it is judged [rad, m, s]."""
        parts = self.error[:3], self.error[3:6], self.error[6:]
        return [float(np.linalg.norm(part)) for part in parts if len(part)]

    @property
    def nees(self) -> float:
        """Normalised error squared, over its dimension."""
        return nees(self.error, self.covariance) / len(self.error)

    @property
    def surprise(self) -> float:
        """Negative log density of the truth, a dimension, but for a constant [nats]."""
        return 0.5 * (self.nees + float(np.linalg.slogdet(self.covariance)[1]) / len(self.error))

    @property
    def silent(self) -> bool:
        """Whether a result that is ok is far off."""
        off = np.abs(self.error) > _SILENT_SIGMAS * np.sqrt(np.diag(self.covariance))
        return self.status == "ok" and bool(off.any())

    def log_ratio(self, full: Run) -> float:
        """Logarithm of its errors over those of the full method."""
        least = np.array(_NEGLIGIBLE[: len(self.sizes)])
        return float(np.log(np.hypot(self.sizes, least) / np.hypot(full.sizes, least)).mean())


@dataclass(frozen=True)
class Comparison:
    """A case against the full method, on the data that both have.

    Attributes:
        case: what is left out.
        pairs: (with, without).
        failed: runs that failed without it.
    """

    case: Case
    pairs: Sequence[tuple[Run, Run]]
    failed: int

    def ratios(self, kind: str = "") -> FloatArray:
        """(k,) logarithms of the error ratios on a kind of data, or on all."""
        return np.array([other.log_ratio(full) for full, other in self.pairs if kind in ("", full.kind)])

    def both(self, streets: bool) -> tuple[list[Run], list[Run]]:
        """Runs with and without, on streets or on drives."""
        chosen = [pair for pair in self.pairs if (pair[0].kind in SIMULATORS) is streets]
        return [full for full, _ in chosen], [other for _, other in chosen]

    @property
    def same(self) -> int:
        """Runs with the same answer, covariance and status as the full method's."""
        return sum(
            np.array_equal(full.error, other.error)
            and np.array_equal(full.covariance, other.covariance)
            and full.status == other.status
            for full, other in self.pairs
        )

    @property
    def surprise(self) -> float:
        """Mean change of the surprise on streets [nats]; 0 without any."""
        changes = [other.surprise - full.surprise for full, other in zip(*self.both(True), strict=True)]
        return float(np.mean(changes)) if changes else 0.0

    @property
    def verdict(self) -> str:
        """``goes`` where leaving it out changes nothing that counts, ``better`` where it improves errors and
        worsens nothing, ``idle`` where no run differs; ``open`` where errors change on some data, but not on
        the whole; else ``stays``."""
        if self.failed:
            return "stays"
        if self.same == len(self.pairs):
            return "idle"
        kinds = dict.fromkeys(full.kind for full, _ in self.pairs)
        ratios = [float(np.exp(self.ratios(kind).mean())) for kind in kinds]
        nees = [
            (_mean_nees(full), _mean_nees(other)) for full, other in map(self.both, (True, False)) if full
        ]
        surer = any(other > max(1.0, _NEES_RATIO * full) for full, other in nees)
        silent = [sum(pair[k].silent for pair in self.pairs) for k in (0, 1)]
        fine = [sum(pair[k].status == "ok" for pair in self.pairs) for k in (0, 1)]
        if surer or silent[1] > silent[0] or fine[1] < fine[0]:
            return "stays"
        if min(ratios) < _LEAST_RATIO and max(ratios) <= _MOST_RATIO:
            return "better"
        if self.surprise > _SURPRISE:
            return "stays"
        if max(ratios) <= _MOST_RATIO:
            return "goes"
        return "open" if float(np.exp(self.ratios().mean())) <= _MOST_RATIO else "stays"

    def cells(self, kinds: Sequence[str]) -> list[str]:
        """The row of a table."""
        fulls, others = (list(side) for side in zip(*self.pairs, strict=True))
        street_runs, drive_runs = self.both(True), self.both(False)
        fine = [sum(one.status == "ok" for one in runs) for runs in (fulls, others)]
        silent = [sum(one.silent for one in runs) for runs in (fulls, others)]
        cost = sum(one.seconds for one in others) / sum(one.seconds for one in fulls)
        failed = f", {self.failed} failed" if self.failed else ""
        return [
            f"`{self.case.name}` {self.case.what}",
            str(self.case.size),
            _ratio_cell(self.ratios()),
            *(_ratio_cell(self.ratios(kind)) for kind in kinds),
            _arrow(*map(_mean_nees, street_runs)) if street_runs[0] else NONE,
            f"{self.surprise:+.2f}" if street_runs[0] else NONE,
            _arrow(*map(_mean_nees, drive_runs)) if drive_runs[0] else NONE,
            f"{fine[0]} → {fine[1]}",
            f"{silent[0]} → {silent[1]}",
            f"{self.same} of {len(self.pairs)}{failed}",
            f"{cost:.2f}",
            self.verdict,
        ]


def _mean_nees(runs: Sequence[Run]) -> float:
    return float(np.mean([one.nees for one in runs])) if runs else 0.0


def _arrow(before: float, after: float) -> str:
    return f"{before:.2f} → {after:.2f}"


def _ratio_cell(ratios: FloatArray) -> str:
    if len(ratios) == 0:
        return NONE
    ratio = np.exp(ratios.mean())
    if len(ratios) == 1:
        return f"{ratio:.2f}"
    return f"{ratio:.2f} ± {ratio * ratios.std(ddof=1) / np.sqrt(len(ratios)):.2f}"


def comparisons(records: Sequence[Record], method: str) -> list[Comparison]:
    """Every case that was run by a method, against the full method; those with the most lines first."""
    own = {(one.case, one.data): one for one in records}
    found = []
    for case in CASES[1:]:
        base = base_of(case, method).name
        full = {data: Run.of(one) for (name, data), one in own.items() if name == base and not one.failed}
        made = {data: one for (name, data), one in own.items() if name == case.name and data in full}
        pairs = [(full[data], Run.of(one)) for data, one in made.items() if not one.failed]
        if pairs:
            found.append(Comparison(case, pairs, len(made) - len(pairs)))
    return sorted(found, key=lambda one: -one.case.size)


def tables(records: Sequence[Record], method: str) -> str:
    """The full method's table, and a row for each heuristic left out, by the runs of one method."""
    full = [Run.of(one) for one in records if one.case == NOTHING.name and not one.failed]
    present = dict.fromkeys(one.kind for one in full)
    kinds = [kind for kind in SIMULATORS if kind in present]
    kinds += sorted(kind for kind in present if kind not in SIMULATORS)
    head = (
        "| data | runs | rotation [deg] | translation [cm] | time offset [ms] "
        "| NEES / dimension: mean, largest | ok / unobservable / not converged | silent | CPU [s] |"
    )
    whole = table(head, [_full_cells(kind, [one for one in full if one.kind == kind]) for kind in kinds])
    head = "| left out | lines | error | " + "".join(f"error, {kind} | " for kind in kinds)
    head += "NEES, streets | surprise | NEES, drives | ok | silent | same | CPU | verdict |"
    return f"{whole}\n{table(head, [one.cells(kinds) for one in comparisons(records, method)])}"


def _full_cells(kind: str, runs: Sequence[Run]) -> list[str]:
    sizes = zip(*(one.sizes for one in runs), strict=True)
    errors = [
        f"{np.median(size) * unit:.3g}, {np.max(size) * unit:.3g}"
        for size, unit in zip(sizes, (180.0 / np.pi, 100.0, 1e3), strict=False)
    ]
    nees = [one.nees for one in runs]
    return [
        kind,
        str(len(runs)),
        *errors,
        *[NONE] * (3 - len(errors)),
        f"{np.mean(nees):.2f}, {np.max(nees):.2f}",
        status_counts([one.status for one in runs]),
        str(sum(one.silent for one in runs)),
        f"{np.median([one.seconds for one in runs]):.1f}",
    ]


def data_of(streets: str, folders: Sequence[str], frames: int) -> Iterator[Data]:
    """Drives in folders, ``NAME=DIR``; then streets, ``first:2,third:1``, of each simulator in turn."""
    for each in folders:
        name, _, folder = each.partition("=")
        yield Data(name, folder)
    counts = [each.split(":") for each in streets.split(",") if each]
    for number in range(max((int(count) for _, count in counts), default=0)):
        for simulator, count in counts:
            if number < int(count):
                yield Data(f"{simulator}-{FIRST_SEED + number}", frames=frames)


def cases_of(names: str, method: str) -> list[Case]:
    """Cases by their names and commas, or all of a method; the full method first.

    Raises:
        SystemExit: a name that is none of them.
    """
    own = [case for case in CASES if method in case.methods]
    chosen = {NOTHING.name, *(names.split(",") if names else (case.name for case in own))}
    chosen |= {LEAN.name} if method == JOINT else set()
    if unknown := chosen - {case.name for case in own}:
        raise SystemExit(f"found cases {sorted(unknown)}, expected some of {[case.name for case in own]}")
    return [case for case in own if case.name in chosen]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--records", required=True, help="file of the runs")
    parser.add_argument("--method", choices=METHODS, default=JOINT)
    parser.add_argument("--streets", default="", help="how many of each simulator: first:2,second:2,third:2")
    parser.add_argument("--drive", action="append", default=[], metavar="NAME=DIR")
    parser.add_argument("--cases", default="", help="names, with commas between them; all without")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of a street")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    cases = cases_of(args.cases, args.method)
    groups = [
        [Task(data, args.method, case.name) for case in cases]
        for data in data_of(args.streets, args.drive, args.frames)
    ]

    def progress(what: str, done: int, count: int) -> None:
        print(f"{what}: {done} of {count}", file=sys.stderr)

    print(tables(rows_of(Work(records_of, Record, records=args.records), groups, progress), args.method))


if __name__ == "__main__":
    main()
