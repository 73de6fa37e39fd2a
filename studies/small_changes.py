"""How small a change of a vehicle's calibration is found among the drives of a fleet.

    python studies/fleet.py --vehicles 10 --drives 20 --out out/fleet
    python studies/small_changes.py out/fleet/batch

Takes the results of a batch (``sst-graph batch --vehicle-from``), of vehicles that were not changed, moves
those of the later drives of a vehicle by a known step along one axis, and looks for changes. The step moves
the estimate of a drive as a mount that was knocked would, without new pictures. In ``apart`` each drive's
assumptions are taken for errors of its own. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.experiments.markdown import lines
from sst_graph.fleet import Record
from sst_graph.fleet.vehicles.changes import Findings, find_changes
from sst_graph.fleet.vehicles.walk import DriveEstimate, WalkConfig
from sst_graph.marginal import CalibrationMarginal, Common

FloatArray = NDArray[np.float64]

UNCHANGED = ("v00", "v01", "v03", "v04", "v06", "v08", "v09")
"""Of ``studies/fleet.py``, whose drives are named VEHICLE_DATE."""
STEPS = (
    *((f"{size:g}°", slice(0, 3), np.radians(size)) for size in (0.1, 0.15, 0.2, 0.3, 0.5)),
    *((f"{size:g} cm", slice(3, 6), 0.01 * size) for size in (1, 2, 3, 5)),
    *((f"{size:g} ms", slice(6, 7), 0.001 * size) for size in (4, 8, 16, 32)),
)
SHUFFLED = 10
"""Orders of each vehicle's drives in which nothing has changed."""
_EDGE = 3
"""Fewest drives before a step, and after it."""


def estimates_in(folder: Path) -> dict[str, list[DriveEstimate]]:
    """By vehicle, in order of the days."""
    found: dict[str, list[DriveEstimate]] = defaultdict(list)
    for path in sorted((folder / "records").iterdir()):
        record = Record.from_json(path.read_bytes(), path)
        vehicle, _, day = record.drive.partition("_")
        if vehicle in UNCHANGED and record.status in ("ok", "unobservable") and record.numbers:
            days = float(date.fromisoformat(day).toordinal())
            found[vehicle].append(DriveEstimate(record.drive, days, record.numbers.marginal()))
    return dict(found)


def stepped(drives: Sequence[DriveEstimate], at: int, step: FloatArray) -> list[DriveEstimate]:
    """The drives from ``at`` on moved by a step (7,)."""

    def moved(marginal: CalibrationMarginal) -> CalibrationMarginal:
        return replace(
            marginal,
            cTl=marginal.cTl.retract(step[:6]),
            time_offset_s=marginal.time_offset_s + float(step[6]),
        )

    return [
        replace(drive, marginal=moved(drive.marginal)) if k >= at else drive for k, drive in enumerate(drives)
    ]


def apart(drives: Sequence[DriveEstimate]) -> list[DriveEstimate]:
    """The drives as if nothing were common to them."""
    return [replace(drive, marginal=replace(drive.marginal, common=Common())) for drive in drives]


def shuffled(drives: Sequence[DriveEstimate], rng: np.random.Generator) -> list[DriveEstimate]:
    """Estimates in another order on the same days."""
    order = rng.permutation(len(drives))
    return [replace(drives[k], day=drive.day) for k, drive in zip(order, drives, strict=True)]


def is_found(found: Findings, at: int, drives: Sequence[DriveEstimate]) -> bool:
    """Whether a change is named within a drive of where it is."""
    return any(
        abs([d.name for d in drives].index(found.left[k].name) - at) <= 1 for k in found.steps if k < at + 2
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("batch", type=Path, help="--out of sst-graph batch")
    vehicles, config = estimates_in(parser.parse_args().batch), WalkConfig()
    drives = sum(map(len, vehicles.values()))
    print(f"{len(vehicles)} vehicles, {drives} drives\n")
    for line in lines("| step | found | found, apart |", rows(vehicles, config)):
        print(line, flush=True)


def rows(vehicles: Mapping[str, Sequence[DriveEstimate]], config: WalkConfig) -> Iterator[list[str]]:
    """How often a step of each size is found, with what drives have in common and without."""
    rng = np.random.default_rng(0)
    orders = [shuffled(own, rng) for own in vehicles.values() for _ in range(SHUFFLED)]
    alarms = [
        sum(
            bool(found.steps or found.contradicting) for found in map(lambda o: find_changes(o, config), some)
        )
        for some in (orders, [apart(order) for order in orders])
    ]
    yield ["none", *(f"{count} of {len(orders)}" for count in alarms)]
    for name, axes, size in STEPS:
        cases = []
        for own in vehicles.values():
            for axis in range(axes.start, axes.stop):
                step = np.zeros(7)
                step[axis] = size * rng.choice([-1.0, 1.0])
                at = int(rng.integers(_EDGE, len(own) - _EDGE + 1))
                cases.append((at, stepped(own, at, step)))
        hits = [
            sum(is_found(find_changes(change(drives), config), at, drives) for at, drives in cases)
            for change in (list, apart)
        ]
        yield [name, *(f"{count} of {len(cases)}" for count in hits)]


if __name__ == "__main__":
    main()
