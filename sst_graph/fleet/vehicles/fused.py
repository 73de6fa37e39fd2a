"""The drives of one vehicle fused: its calibration, its drift, its changes, drives that contradict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

from sst_graph.config import expect_settings
from sst_graph.covariance.observability import ObservabilityConfig, weak_directions
from sst_graph.errors import EstimationError, count_of
from sst_graph.factors.arguments import checked_type
from sst_graph.factors.errors import FactorError
from sst_graph.files.strict_json import strict_json
from sst_graph.fleet.drives import ListedDrive, checked_drives
from sst_graph.fleet.record import Numbers, Record
from sst_graph.fleet.vehicles.changes import Findings, VehicleChange, find_changes
from sst_graph.fleet.vehicles.walk import DriveEstimate, Smoothed, WalkConfig, smoothed
from sst_graph.imports.records import VEHICLE_FORMAT
from sst_graph.result import WeakDirection

VehicleStatus = Literal["ok", "unobservable", "changed", "contradicted", "no_result"]

COUNTED = ("ok", "unobservable")
"""Status of the drives that are fused: what a drive does not determine has a large sigma."""
_LIMITS = ObservabilityConfig()
VERSION = 1


@dataclass(frozen=True)
class Change:
    """A step of a vehicle's calibration.

    Attributes:
        after, before: names of the last drive before it and of the first drive after it.
        since, until: dates of the two, or empty where not all drives of the vehicle have one.
        finding: the test.
        drives: how many drives of the stretches on either side; a side of one drive cannot tell a change from
            a bad drive.
    """

    after: str
    before: str
    since: str
    until: str
    finding: VehicleChange
    drives: tuple[int, int]

    @property
    def words(self) -> str:
        """One sentence for people."""
        dates = f" ({self.since[:10]} to {self.until[:10]})" if self.since and self.until else ""
        caveat = "" if min(self.drives) > 1 else "; only one drive on a side, which may be wrong itself"
        return f"between {self.after} and {self.before}{dates}: {self.finding.words}{caveat}"


@dataclass(frozen=True)
class Vehicle:
    """What the drives of one vehicle say together.

    Attributes:
        name: of the vehicle.
        status: ``changed`` where a step was found, ``contradicted`` where only a drive contradicts the
            others, ``unobservable`` where all of them leave a direction open, ``no_result`` where no drive of
            it has a result that counts.
        drives: names of those that count, in order.
        calibration: at the last of them, with what the drives have in common in its covariance; None without.
        days: of each of them, from the first.
        drift: at each of them; their covariances are of the differences, without what they have in common.
        changes: steps.
        contradicting: drives that were left out, by name.
        without: drives that do not count, and why.
        weak: what the calibration does not determine to within the limits, the weakest first.
        dated: whether all have a date; else their order counts, a day from each to the next.
        cameras: names of the cameras of those that count.
        undated: names of those without a date, where the order of the list is not that of the dates of the
            others.
    """

    name: str
    status: VehicleStatus
    drives: tuple[str, ...]
    days: tuple[float, ...]
    calibration: Smoothed | None
    drift: tuple[Smoothed, ...]
    changes: tuple[Change, ...]
    contradicting: Mapping[str, VehicleChange]
    without: Mapping[str, str]
    dated: bool
    weak: tuple[WeakDirection, ...] = ()
    cameras: tuple[str, ...] = ()
    undated: tuple[str, ...] = ()

    @property
    def reason(self) -> str:
        """One line, empty where nothing is wrong."""
        parts = [f"changed {change.words}" for change in self.changes]
        parts += [f"{name} contradicts the others: {one.words}" for name, one in self.contradicting.items()]
        parts += [f"by all drives, {one.sentence}" for one in self.weak[:1]]
        if len(self.cameras) > 1:
            parts.append(
                f"its drives name {count_of(len(self.cameras), 'camera')} ({', '.join(self.cameras)}), which "
                "are fused as one: make a vehicle of each, unless all of them are names of one"
            )
        if self.undated:
            parts.append(
                f"no date of {', '.join(self.undated)}: its drives count in the order of the list, which is "
                "not that of the dates of the others"
            )
        if self.calibration is None:
            parts.append("no drive of it has a result that counts")
        return "; ".join(parts)


def vehicle_of(
    name: str,
    drives: Sequence[ListedDrive],
    records: Mapping[str, Record],
    config: WalkConfig,
    limits: ObservabilityConfig = _LIMITS,
) -> Vehicle:
    """Fuse the drives of one vehicle.

    A drive counts if its result is ``ok`` or ``unobservable`` (what it does not determine has a large sigma).

    Args:
        drives: in the order of the list.
        records: by the name of the drive.
        limits: of the standard deviations of a calibration that is ok.
    """
    counted, without = _counted(drives, records)
    dated = all(drive.day is not None for drive in counted)
    if dated:
        counted.sort(key=lambda drive: (drive.day or 0.0, drive.name))
    estimates = [
        DriveEstimate(
            drive.name, (drive.day or 0.0) if dated else float(k), _numbers(records, drive.name).marginal()
        )
        for k, drive in enumerate(counted)
    ]
    if not estimates:
        return _without_result(name, without)
    found = find_changes(estimates, config)
    drift = smoothed(found.left, found.steps, config)
    by_name = {drive.name: drive for drive in counted}
    changes = _changes(found, by_name, dated)
    last = drift[-1]
    calibration = Smoothed(*last, covariance=last.covariance + last.common)
    weak = weak_directions(calibration.covariance, calibration.cTl, limits)
    status: VehicleStatus = "unobservable" if weak else "ok"
    if changes or found.contradicting:
        status = "changed" if changes else "contradicted"
    return Vehicle(
        name,
        status,
        tuple(one.name for one in found.left),
        tuple(one.day - found.left[0].day for one in found.left),
        calibration,
        tuple(drift),
        changes,
        found.contradicting,
        without,
        dated,
        weak,
        tuple(sorted({_numbers(records, drive.name).camera for drive in counted})),
        _undated(counted),
    )


def _without_result(name: str, without: Mapping[str, str]) -> Vehicle:
    return Vehicle(name, "no_result", (), (), None, (), (), {}, without, False)


def vehicles_of(
    drives: Sequence[ListedDrive],
    records: Mapping[str, Record],
    config: WalkConfig,
    limits: ObservabilityConfig = _LIMITS,
) -> list[Vehicle]:
    """All vehicles, by name; drives of no known vehicle are left out; arguments as of :func:`vehicle_of`.

    Raises:
        FactorError: no drives, or no records.
    """
    checked_drives(drives)
    checked_type("records", records, Mapping, "a dict of records by the drive's name (run_batch)")
    config = expect_settings(config, WalkConfig)
    limits = expect_settings(limits, ObservabilityConfig)
    by_vehicle: dict[str, list[ListedDrive]] = {}
    for drive in drives:
        if drive.vehicle:
            by_vehicle.setdefault(drive.vehicle, []).append(drive)
    found = []
    for name, own in sorted(by_vehicle.items()):
        try:
            found.append(vehicle_of(name, own, records, config, limits))
        except EstimationError as error:
            without = {drive.name: str(error) for drive in own}
            found.append(_without_result(name, without))
    return found


def vehicle_json(vehicle: Vehicle, records: Mapping[str, Record], config: WalkConfig) -> str:
    """The text of ``vehicles/NAME.json``."""
    now = vehicle.calibration
    document = {
        "format": VEHICLE_FORMAT,
        "version": VERSION,
        "vehicle": vehicle.name,
        "status": vehicle.status,
        "reason": vehicle.reason,
        "calibration": None if now is None else {"drive": vehicle.drives[-1], **_plain(now)},
        "camera": records[vehicle.drives[-1]].numbers.camera if now is not None else None,  # type: ignore[union-attr]
        "dated": vehicle.dated,
        "walk_per_sqrt_day": config,
        "changes": [
            {
                "after": change.after,
                "before": change.before,
                "since": change.since,
                "until": change.until,
                "words": change.words,
                "drives_on_each_side": change.drives,
                **_tested(change.finding),
            }
            for change in vehicle.changes
        ],
        "contradicting": [{"drive": name, **_tested(one)} for name, one in vehicle.contradicting.items()],
        "without": vehicle.without,
        "drift": [
            {"drive": name, "day": day, **_plain(one)}
            for name, day, one in zip(vehicle.drives, vehicle.days, vehicle.drift, strict=True)
        ],
    }
    return strict_json(document) + "\n"


def _plain(one: Smoothed) -> dict[str, Any]:
    return {
        "T_camera_lidar": one.cTl.matrix(),
        "time_offset_s": one.time_offset_s,
        "covariance": one.covariance,
    }


def _tested(finding: VehicleChange) -> dict[str, Any]:
    return {
        "kinds": finding.kinds,
        "step": finding.difference.step,
        "step_covariance": finding.difference.covariance,
        "chi2": finding.difference.chi2,
        "p_value": finding.p_value,
    }


def _counted(
    drives: Sequence[ListedDrive], records: Mapping[str, Record]
) -> tuple[list[ListedDrive], dict[str, str]]:
    """Drives with a result that can be fused, and why the others cannot."""
    counted, without = [], {}
    owners: dict[str, str] = {}
    for drive in drives:
        record = records.get(drive.name)
        if record is None:
            without[drive.name] = "not run"
        elif record.status not in COUNTED or record.numbers is None:
            without[drive.name] = f"{record.status}: {record.reason}" if record.reason else record.status
        else:
            hashes = record.numbers.scan_hashes
            try:
                record.numbers.marginal()
            except (EstimationError, FactorError) as error:
                without[drive.name] = str(error)
                continue
            if twin := next((owners[one] for one in hashes if one in owners), None):
                without[drive.name] = f"it holds scans of {twin}, which count once"
                continue
            owners.update(dict.fromkeys(hashes, drive.name))
            counted.append(drive)
    return counted, without


def _numbers(records: Mapping[str, Record], name: str) -> Numbers:
    numbers = records[name].numbers
    assert numbers is not None, name
    return numbers


def _undated(drives: Sequence[ListedDrive]) -> tuple[str, ...]:
    """Names of the drives without a date, where the days of the others do not rise in their order."""
    days = [drive.day for drive in drives if drive.day is not None]
    return () if days == sorted(days) else tuple(drive.name for drive in drives if drive.day is None)


def _changes(found: Findings, drives: Mapping[str, ListedDrive], dated: bool) -> tuple[Change, ...]:
    names = [one.name for one in found.left]
    borders = [0, *sorted(found.steps), len(names)]
    sizes = {
        at: (at - start, end - at) for start, (at, end) in zip(borders, pairwise(borders[1:]), strict=False)
    }
    dates = [drives[name].date if dated else "" for name in names]
    return tuple(
        Change(names[k - 1], names[k], dates[k - 1], dates[k], found.steps[k], sizes[k])
        for k in sorted(found.steps)
    )
