"""``sst-graph batch``: many drives, each in a process of its own, and one summary of all."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
from pathlib import Path
from typing import Any

from sst_graph.cli import EXIT_NOT_TRUSTED
from sst_graph.cli.commands.batch.ending import children_ended
from sst_graph.cli.commands.batch.progress import ProgressOnStderr, on_terminal
from sst_graph.cli.inputs import calibration_settings
from sst_graph.cli.messages import complain, mention
from sst_graph.cli.options import SOURCE_DEFAULTS
from sst_graph.cli.reading import check_options
from sst_graph.data.ros.source import is_folder_of_bags
from sst_graph.data.source import recognized
from sst_graph.errors import ConfigError, count_of
from sst_graph.fleet import (
    BatchConfig,
    BatchOutcome,
    Limits,
    ListedDrive,
    Place,
    WalkConfig,
    find_drives,
    open_batch,
    run_batch,
    with_vehicles,
    write_summary,
)
from sst_graph.fleet.drives import loose_files
from sst_graph.fleet.summary.page import counts_line, others_line
from sst_graph.reference import load_initial

_MOST_SAID = 10


def run(args: argparse.Namespace) -> int:
    """Calibrate all drives that are not done yet, and write the summary of all."""
    config = _config(args)
    _check_passed_on(args)
    out = Place.of(args.out)
    out = Place(os.path.abspath(out.url)) if out.is_local else out
    drives = _but(out, find_drives(args.drives, _at_least("--name-parts", args.name_parts, 1)))
    _say_if_a_drive(args.drives, drives)
    _say_loose(args.drives)
    if args.vehicle_from is not None:
        drives = with_vehicles(drives, args.vehicle_from)
        _say_without_vehicle(drives)
    _check_apart(drives, out)
    with open_batch(out, config.options) as note, children_ended(out), ProgressOnStderr() as told:
        if note:
            complain(f"note: {note}")
        records = run_batch(drives, out, config, told)
        told.close()
        outcome = write_summary(drives, records, out, config)
    _say(outcome, out)
    return 0 if outcome.all_fine else EXIT_NOT_TRUSTED


def _config(args: argparse.Namespace) -> BatchConfig:
    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if args.workers is not None:
        workers = _at_least("--workers", args.workers, 1)
    memory = _above_zero("--memory-limit", args.memory_limit)
    return BatchConfig(
        options=_passed_on(args),
        workers=workers,
        dask=args.dask,
        limits=Limits(
            _above_zero("--time-limit", args.time_limit), None if memory is None else round(memory * 2**30)
        ),
        retries=_at_least("--retries", args.retries, 0),
        walk=_walk(args),
        observability=calibration_settings(args).observability,
    )


def _walk(args: argparse.Namespace) -> WalkConfig:
    walk = WalkConfig()
    if args.drift is not None:
        try:
            degrees, centimetres, milliseconds = map(float, args.drift.split(","))
        except ValueError:
            raise ConfigError(f"--drift {args.drift}: expected three numbers DEG,CM,MS") from None
        rates = {
            "rotation_deg": degrees,
            "translation_m": 0.01 * centimetres,
            "time_offset_s": 1e-3 * milliseconds,
        }
        walk = _changed(walk, f"--drift {args.drift}", rates)
    if args.false_alarm_rate is not None:
        rate = {"false_alarm_rate": args.false_alarm_rate}
        walk = _changed(walk, f"--false-alarm-rate {args.false_alarm_rate:g}", rate)
    return walk


def _changed(walk: WalkConfig, option: str, values: dict[str, float]) -> WalkConfig:
    """The settings with the values of an option, which an error names."""
    try:
        return dataclasses.replace(walk, **values)
    except ConfigError as error:
        raise ConfigError(f"{option}: {str(error).removeprefix('WalkConfig.')}") from None


def _passed_on(args: argparse.Namespace) -> tuple[str, ...]:
    """The options of ``calibrate`` that were given, as on its command line."""
    words: list[str] = []
    for action in args.passed_on:
        value: Any = getattr(args, action.dest)
        if value is None or value == action.default:
            continue
        name = action.option_strings[-1]
        if value is True:
            words.append(name)
        else:
            for one in value if isinstance(value, list) else [value]:
                words.append(f"{name}={one}")
    return tuple(words)


def _check_passed_on(args: argparse.Namespace) -> None:
    """Refuse at once what every drive would refuse; the settings are checked by now."""
    check_options(args)
    if args.init not in ("dataset", "none"):
        load_initial(Path(args.init), args.camera or str(SOURCE_DEFAULTS["camera"]))


def _but(out: Place, drives: list[ListedDrive]) -> list[ListedDrive]:
    """The drives without the batch's own folder, which may stand among them."""
    if not out.is_local:
        return drives
    own = os.path.realpath(out.url)
    left = [one for one in drives if not one.place.is_local or os.path.realpath(one.place.url) != own]
    if not left:
        raise ConfigError(f"{out}: found no drive beside this folder of the batch, expected at least one")
    return left


def _check_apart(drives: list[ListedDrive], out: Place) -> None:
    """No drive stands in the batch's folder, nor the folder in a drive."""
    if not out.is_local:
        return
    real = Path(os.path.realpath(out.url))
    for drive in drives:
        if not drive.place.is_local:
            continue
        data = Path(os.path.realpath(drive.place.url))
        if data == real or real in data.parents or data in real.parents:
            raise ConfigError(
                f"--out {out}: found the drive {drive.place} in it or around it, expected two places"
            )


def _say_if_a_drive(what: str, drives: list[ListedDrive]) -> None:
    """Tell who gives one drive in the place of a folder of drives."""
    place = Place.of(what)
    if not (place.is_local and place.is_folder()) or is_folder_of_bags(place.path):
        return
    if (kind := recognized(place.path)) is not None:
        parts = ", ".join(drive.place.name for drive in drives[:3]) + (", ..." if len(drives) > 3 else "")
        complain(
            f"note: {what} looks like one drive ({kind}); what stands in it ({parts}) is taken for the "
            "drives: name the folder above, or a pattern such as 'drives/*'"
        )


def _say_loose(what: str) -> None:
    """Name the files beside the drives that are taken for none."""
    names = loose_files(what)
    if names:
        complain(
            f"note: {what}: {count_of(len(names), 'file')} left out: {_some(names)} (a folder or a bag is a "
            "drive; a pattern or a list may name others)"
        )


def _say_without_vehicle(drives: list[ListedDrive]) -> None:
    without = [drive.name for drive in drives if not drive.vehicle]
    if without:
        complain(f"note: no vehicle is known of {count_of(len(without), 'drive')}: {_some(without)}")


def _some(names: list[str]) -> str:
    return ", ".join(names[:_MOST_SAID]) + (", ..." if len(names) > _MOST_SAID else "")


def _say(outcome: BatchOutcome, out: Place) -> None:
    mention(f"{'drives':<15} {len(outcome.rows)}: {counts_line(outcome.rows)}")
    wrong = [row for row in outcome.rows if not row["report"]]
    for row in wrong[:_MOST_SAID]:
        mention(f"{row['status']!s:<15} {row['drive']}: {on_terminal(str(row['drive']), str(row['reason']))}")
    if len(wrong) > _MOST_SAID:
        mention(f"{'':<15} and {len(wrong) - _MOST_SAID} more without result")
    for vehicle in [one for one in outcome.vehicles if one.reason][:_MOST_SAID]:
        mention(f"{'vehicle':<15} {vehicle.name}: {vehicle.reason}")
    dates = {str(row["drive"]): str(row["date"]) for row in outcome.rows}
    mixed = [
        one.name for one in outcome.vehicles if not one.dated and any(dates[name] for name in one.drives)
    ]
    if mixed:
        complain(f"note: some drives have no date, so their order counts, of the vehicles {_some(mixed)}")
    if outcome.others:
        complain(f"note: {others_line(outcome.others)}")
    if "summary.parquet" not in outcome.names:
        complain("note: no Parquet without pyarrow: pip install 'sst-graph[fleet]'")
    mention(f"{'wrote':<15} {out}: {', '.join(outcome.names)}")


def _at_least(option: str, value: int, least: int) -> int:
    if value < least:
        raise ConfigError(f"{option} {value}: expected at least {least}")
    return value


def _above_zero(option: str, value: float | None) -> float | None:
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"{option} {value:g}: expected a number above 0")
    return value
