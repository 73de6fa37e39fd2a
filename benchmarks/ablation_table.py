"""The tables of ablation.py: each case against the full method on the same data."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ablation_cases import CASES, Case
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_FLOORS = np.array([0.03, 0.5, 0.5])
"""Added to errors, root of the sum of squares [deg, cm, ms]: else ratios of nothing would decide."""
_ONE_SPEED_MPS = {"parked": 10.9}
"""Drives at one speed v, which tell the shift along the road minus v times the offset only [m/s]."""


@dataclass(frozen=True)
class Outcome:
    """One run."""

    row: Mapping[str, Any]

    @cached_property
    def errors(self) -> FloatArray:
        """(3,) rotation [deg], translation [cm], time offset [ms]; that of a drive at one speed is 0."""
        error, shift = np.array(self.row["error"]), np.array(self.row["c_shift"])
        late_s, speed = -error[6], _ONE_SPEED_MPS.get(self.row["data"].partition("@")[0], 0.0)
        if speed:
            shift = shift - np.array([0.0, 0.0, speed * late_s])
            late_s = 0.0
        turn = np.degrees(np.linalg.norm(error[:3]))
        return np.array([turn, 100.0 * np.linalg.norm(shift), 1e3 * abs(late_s)])

    @cached_property
    def nees(self) -> float:
        """Over the seven dimensions; NaN without a covariance."""
        if self.row.get("covariance") is None:
            return float("nan")
        error, covariance = np.array(self.row["error"]), np.array(self.row["covariance"])
        return float(error @ np.linalg.solve(covariance, error)) / len(error)

    @cached_property
    def surprise(self) -> float:
        """Negative logarithm of the density that the answer gives to the truth, a dimension [nats]."""
        if self.row.get("covariance") is None:
            return float("nan")
        logs = float(np.linalg.slogdet(np.array(self.row["covariance"]))[1]) / 7.0
        return 0.5 * (self.nees + logs + float(np.log(2.0 * np.pi)))

    @property
    def silent(self) -> bool:
        """``ok``, and more than three sigmas off on some axis."""
        if self.row["status"] != "ok" or self.row.get("covariance") is None:
            return False
        sigmas = np.sqrt(np.diag(np.array(self.row["covariance"])))
        return bool((np.abs(np.array(self.row["error"])) > 3.0 * sigmas).any())

    @property
    def seconds(self) -> float:
        return float(self.row["prepare_s"] + self.row["estimate_s"])


@dataclass(frozen=True)
class Pairs:
    """Runs of one group of data with the full method, and without the heuristic."""

    full: Sequence[Outcome]
    without: Sequence[Outcome]

    @classmethod
    def of(cls, runs: Mapping[str, Mapping[str, Outcome]], case: str, group: Callable[[str], bool]) -> Pairs:
        full, without = runs.get("none", {}), runs.get(case, {})
        names = [name for name in full if name in without and group(name)]
        return cls([full[name] for name in names], [without[name] for name in names])

    def __len__(self) -> int:
        return len(self.full)

    @cached_property
    def logs(self) -> FloatArray:
        """(n,) mean logarithm of the ratios of the three errors."""
        floored = [np.hypot([o.errors for o in side], _FLOORS) for side in (self.without, self.full)]
        return np.asarray(np.log(floored[0] / floored[1]).mean(axis=1))

    @property
    def paired(self) -> str:
        """Ratio of the errors, its standard error."""
        if not len(self):
            return "–"
        mean = float(self.logs.mean())
        if len(self) < 2:
            return f"{np.exp(mean):.2f}"
        spread = float(self.logs.std(ddof=1)) / np.sqrt(len(self))
        return f"{np.exp(mean):.2f} ± {np.exp(mean) * spread:.2f}"

    @property
    def nees(self) -> str:
        if not len(self):
            return "–"
        return " → ".join(f"{np.mean([o.nees for o in side]):.2f}" for side in (self.full, self.without))

    @property
    def surprise(self) -> str:
        if not len(self):
            return "–"
        steps = [b.surprise - a.surprise for a, b in zip(self.full, self.without, strict=True)]
        return f"{np.mean(steps):+.2f}"

    @property
    def time(self) -> float:
        return sum(o.seconds for o in self.without) / sum(o.seconds for o in self.full)

    def ratios(self) -> str:
        """Ratio of the medians, and of the worst, of each error."""
        if not len(self):
            return "–"
        with_, without = (np.array([o.errors for o in side]) for side in (self.full, self.without))
        medians = np.median(without, axis=0) / np.maximum(np.median(with_, axis=0), 1e-9)
        worst = without.max(axis=0) / np.maximum(with_.max(axis=0), 1e-9)
        return " ".join(f"{m:.2f}" for m in medians) + " (" + " ".join(f"{w:.2f}" for w in worst) + ")"


def read(paths: Sequence[Path], kind: str) -> dict[str, dict[str, Outcome]]:
    """Outcomes by case and data."""
    found: dict[str, dict[str, Outcome]] = {}
    for path in paths:
        for line in path.read_text().splitlines():
            row = json.loads(line)
            if row["kind"] == kind and "failed" not in row:
                found.setdefault(row["case"], {})[row["data"]] = Outcome(row)
    return found


def _group(name: str) -> Callable[[str], bool]:
    return lambda data: data.startswith(f"{name}/")


def _streets(runs: Mapping[str, Mapping[str, Outcome]]) -> list[str]:
    """Kinds of streets."""
    return sorted({data.split("/")[0] for data in runs.get("none", {}) if not _real(data)})


def _real(data: str) -> bool:
    return "/" not in data


def _drives(runs: Mapping[str, Mapping[str, Outcome]]) -> list[str]:
    return sorted(data for data in runs.get("none", {}) if _real(data))


def full_table(runs: Mapping[str, Mapping[str, Outcome]]) -> str:
    """The full method by itself: errors, NEES, statuses, seconds."""
    rows = [
        "| data | runs | rotation [deg] | translation [cm] | time offset [ms] "
        "| NEES / dimension: mean, largest | ok / unobservable / not converged | silent | CPU [s] |",
        "|---" * 9 + "|",
    ]
    full = runs.get("none", {})
    for group in (*_streets(runs), *_drives(runs)):
        own = [o for name, o in full.items() if name == group or name.startswith(f"{group}/")]
        if not own:
            continue
        errors = np.array([o.errors for o in own])
        cells = [group, str(len(own))]
        cells += [f"{np.median(column):.3g}, {column.max():.3g}" for column in errors.T]
        nees, statuses = [o.nees for o in own], [o.row["status"] for o in own]
        cells.append(f"{np.mean(nees):.2f}, {np.max(nees):.2f}")
        cells.append(" / ".join(str(statuses.count(s)) for s in ("ok", "unobservable", "not_converged")))
        cells += [str(sum(o.silent for o in own)), f"{np.median([o.seconds for o in own]):.1f}"]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _ordered(runs: Mapping[str, Mapping[str, Outcome]]) -> list[Case]:
    cases = [case for case in CASES if case.name in runs and case.name != "none"]
    return sorted(cases, key=lambda case: -case.size)


def cost_table(runs: Mapping[str, Mapping[str, Outcome]]) -> str:
    """A row for each case, the longest code first: errors without it over those with it, paired."""
    drives, groups = _drives(runs), _streets(runs)
    head = ["left out", "lines", *(f"error, {name}" for name in groups), *(f"error, {n}" for n in drives)]
    head += ["NEES / dimension, streets", "surprise, streets", "NEES, drives", "ok", "silent", "CPU"]
    rows = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for case in _ordered(runs):
        every = Pairs.of(runs, case.name, lambda data: True)
        streets = Pairs.of(runs, case.name, lambda data: not _real(data))
        reals = Pairs.of(runs, case.name, _real)
        cells = [f"`{case.name}` {case.what}", str(case.size)]
        cells += [Pairs.of(runs, case.name, _group(name)).paired for name in groups]
        for drive in drives:
            one = Pairs.of(runs, case.name, drive.__eq__)
            cells.append(one.paired)
        silent = [sum(o.silent for o in side) for side in (every.full, every.without)]
        ok = [sum(o.row["status"] == "ok" for o in side) for side in (every.full, every.without)]
        cells += [
            streets.nees,
            streets.surprise,
            reals.nees,
            f"{ok[0]} → {ok[1]}",
            f"{silent[0]} → {silent[1]} of {len(every)}",
        ]
        cells.append(f"{every.time:.2f}" if len(every) else "–")
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def detail_table(runs: Mapping[str, Mapping[str, Outcome]]) -> str:
    """Medians and worst of the errors, relative to the full method."""
    drives, groups = _drives(runs), _streets(runs)
    head = ["left out", *groups, *(f"{name}: deg, cm, ms" for name in drives)]
    rows = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    nothing = [
        " ".join(f"{e:.3g}" for e in runs["none"][drive].errors) if drive in runs.get("none", {}) else "–"
        for drive in drives
    ]
    rows.append("| " + " | ".join(["nothing", *["1"] * len(groups), *nothing]) + " |")
    for case in _ordered(runs):
        cells = [f"`{case.name}`", *(Pairs.of(runs, case.name, _group(n)).ratios() for n in groups)]
        for drive in drives:
            one = runs[case.name].get(drive)
            cells.append("–" if one is None else " ".join(f"{error:.3g}" for error in one.errors))
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def write_table(paths: Sequence[Path], kind: str, full_only: bool = False) -> str:
    """All tables of one kind of run."""
    runs = read(paths, kind)
    if full_only:
        return full_table(runs)
    return "\n\n".join((full_table(runs), cost_table(runs), detail_table(runs)))
