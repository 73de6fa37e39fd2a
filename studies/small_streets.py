"""False alarms and covariance on small streets of three simulators: clean, and with all parameters drawn.

    OMP_NUM_THREADS=1 python studies/small_streets.py --streets 300 --records small_streets.jsonl

A street of the first or third simulator follows four and three of the second, which is the fastest: 10
frames of 621 x 188 px that start 0.5 deg and 3 cm off, without the global start, the motion and the parts. In
every fifth street the parameters of all assumptions are drawn from their prior deviations as well. What is
done stands in the file of records; a further call goes on from it and prints the tables.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent / "simulators"))

from second_street import SecondStreet, StreetConfig
from third_street import ThirdConfig, ThirdStreet

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments import markdown
from sst_graph.experiments.starts import error_of
from sst_graph.experiments.tasks.resumable import Work, rows_of
from sst_graph.experiments.wrong_drives import WRONG
from sst_graph.metrics import nees
from sst_graph.simulator import SimulationConfig, simulate

FIRST_SEED = 20_000
SIMULATORS = ("second",) * 4 + ("first",) + ("second",) * 3 + ("third",)
"""In turn, by seed."""
CONFIG = with_overrides(
    CalibrationConfig(), ["search.enabled=false", "use_motion=never", "check_contradictions=false"]
)
_FRAMES, _TIME_OFFSET_S = 10, 0.03
_START_DEG, _START_M = 0.5, 0.03
_DRAWN_EVERY = 5


_HEAD = (
    "| case | simulator | runs | contradicted | ok, unobservable, not converged "
    "| `ok` and over 3 σ on an axis | NEES / dimension: mean, median |"
)


@dataclass(frozen=True)
class Task:
    """A street by its seed."""

    seed: int


@dataclass(frozen=True)
class Row:
    """One calibration.

    Attributes:
        case: ``clean`` or ``drawn``.
        contradicted: names of assumptions, parted by commas.
        worst_sigmas: error over its sigma on the worst of seven axes.
        nees: of seven, over its dimension.
    """

    seed: int
    simulator: str
    case: str
    status: str
    contradicted: str
    worst_sigmas: float
    nees: float


def street(seed: int) -> tuple[str, KeptDrive]:
    """The simulator and the drive of a seed."""
    place = seed - FIRST_SEED
    name = SIMULATORS[place % len(SIMULATORS)]
    common = {"seed": seed, "frames": _FRAMES, "width": 621, "height": 188, "time_offset_s": _TIME_OFFSET_S}
    if name == "first":
        config = SimulationConfig(
            **common,  # type: ignore[arg-type]
            azimuth_step_deg=0.3,
            azimuth_limit_deg=50.0,
            vehicle_density=0.3,
            rotation_error_deg=_START_DEG,
            translation_error_m=_START_M,
            motion="mixed" if (place // 6) % 2 else "stop_and_go",
        )
        return name, KeptDrive.of(simulate(config))
    options = {**common, "focal_px": 360.75, "motion": ("stop", "vary")[(place // 2) % 2]}
    made = (
        SecondStreet(StreetConfig(**options, density=0.2))  # type: ignore[arg-type]
        if name == "second"
        else ThirdStreet(ThirdConfig(**options, density=0.3))  # type: ignore[arg-type]
    )
    drive = KeptDrive.of(made, sweep="known")
    assert drive.truth is not None
    ways = np.random.default_rng([seed, 99]).standard_normal((2, 3))
    turn, shift = ways / np.linalg.norm(ways, axis=1)[:, None]
    away = np.concatenate([np.radians(_START_DEG) * turn, _START_M * shift])
    return name, replace(drive, nominal=drive.truth.cTl.retract(away))


def drawn(seed: int, drive: KeptDrive) -> KeptDrive:
    """A drive with the parameters of all assumptions drawn from their prior deviations."""
    rng = np.random.default_rng([seed, 71])
    for name, wrong in WRONG.items():
        drive = wrong(drive, ASSUMPTIONS[name].sigma * float(rng.standard_normal()))
    return drive


def row(seed: int, simulator: str, case: str, drive: KeptDrive) -> Row:
    """The calibration of a drive."""
    result = calibrate_prepared(prepare_drives([drive], CONFIG), drive.nominal, CONFIG)
    assert drive.truth is not None
    error = error_of(result.calibration, drive.truth)
    tested = {n: e for n, e in result.diagnostics.get("assumptions", {}).items() if "estimate" in e}
    return Row(
        seed,
        simulator,
        case,
        result.status,
        ",".join(name for name, entry in tested.items() if entry["contradicted"]),
        float((np.abs(error) / np.sqrt(np.diag(result.covariance))).max()),
        nees(error, result.covariance) / len(error),
    )


def rows(tasks: Sequence[Task]) -> Iterator[list[Row]]:
    """All calibrations of each street."""
    yield from map(rows_of_street, tasks)


def rows_of_street(task: Task) -> list[Row]:
    """All calibrations of a street."""
    simulator, drive = street(task.seed)
    found = [row(task.seed, simulator, "clean", drive)]
    if (task.seed - FIRST_SEED) % _DRAWN_EVERY == 0:
        found.append(row(task.seed, simulator, "drawn", drawn(task.seed, drive)))
    return found


def table(found: Sequence[Row]) -> str:
    """By case and simulator; NEES without results that are ``not_converged``, which claim nothing."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for one in found:
        for name in (one.simulator, "all"):
            groups.setdefault((one.case, name), []).append(one)
    rows = []
    for (case, name), some in sorted(groups.items()):
        counts = [sum(r.status == s for r in some) for s in ("ok", "unobservable", "not_converged")]
        shares = [r.nees for r in some if r.status != "not_converged"]
        cells = [case, name, str(len(some)), str(sum(bool(r.contradicted) for r in some))]
        cells.append(", ".join(map(str, counts)))
        cells.append(str(sum(r.status == "ok" and r.worst_sigmas > 3.0 for r in some)))
        cells.append(f"{np.mean(shares):.2f}, {np.median(shares):.2f}" if shares else "–")
        rows.append(cells)
    return markdown.table(_HEAD, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--streets", type=int, default=300)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    parser.add_argument("--records", default="")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    work = Work(rows, Row, records=args.records)
    print(table(rows_of(work, [[Task(args.seed + number)] for number in range(args.streets)])))


if __name__ == "__main__":
    main()
