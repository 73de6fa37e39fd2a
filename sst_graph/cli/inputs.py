"""From options to drives, starts and settings."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import gtsam

from sst_graph.cli.labels import ALIGNABLE
from sst_graph.cli.messages import complain
from sst_graph.cli.reading import open_drive
from sst_graph.config import read_config, with_overrides
from sst_graph.data.info.facts import facts_of, spans_of
from sst_graph.data.source import is_result, recognized
from sst_graph.errors import ConfigError, DataError
from sst_graph.imports import ImportOptions, import_calibration
from sst_graph.metrics import root_and_sigmas
from sst_graph.result import CalibrationResult, read_result, result_file
from sst_graph.timestamps import NS_PER_S, apart_s
from sst_graph.types import Source

if TYPE_CHECKING:
    from sst_graph.batch import CalibrationConfig

T = TypeVar("T")

_SAID_BY_THEMSELVES = ("calibration", "kitti", "gtsam")
"""Formats of starts that leave no doubt about what is the camera, the LiDAR, and the direction."""


def open_drives(args: argparse.Namespace) -> list[Source]:
    """All drives of DATA, each once.

    Raises:
        ConfigError: a drive is given twice, or two have the same name.
    """
    paths = [os.path.realpath(path) for path in args.data]
    if len(set(paths)) != len(paths):
        raise ConfigError("the same DATA is given twice: each drive counts once")
    sources = [open_drive(args, path) for path in args.data]
    places: dict[str, Path] = {}
    for source, path in zip(sources, args.data, strict=True):
        if source.name in places:
            raise ConfigError(
                f"{places[source.name]} and {path}: found two drives named {source.name}, expected names "
                "that differ (the name is that of the folder and its sequence)"
            )
        places[source.name] = path
    return sources


def starting_point(choice: str, source: Source, camera: str) -> tuple[gtsam.Pose3 | None, float]:
    """cTl (None: no guess) and time offset [s] that ``--init`` asks for.

    Raises:
        ConfigError: ``dataset``, and the data bring no nominal calibration; or an offset longer than the
            drive.
        DataError: a file that holds none.
    """
    if choice == "none":
        return None, 0.0
    if choice != "dataset":
        start = import_calibration(Path(choice), ImportOptions(camera=camera))
        if start.format not in _SAID_BY_THEMSELVES:
            complain(f"note: --init {choice}: {start.words()}")
        time_offset_s = start.time_offset_s or 0.0
        _refuse_beyond_drive(choice, time_offset_s, source)
        return start.cTl, time_offset_s
    if source.nominal is None:
        facts = facts_of(source)
        why = f" ({facts.nominal})" if facts is not None and facts.nominal else ""
        found = f"{source.name} brings no nominal calibration{why}"
        raise ConfigError(f"{found}: give --init none or --init FILE")
    return source.nominal, 0.0


def _refuse_beyond_drive(choice: str, time_offset_s: float, source: Source) -> None:
    """Refuse an offset in the wrong unit: under it no image is of the time of a scan, without it some are.

    Sensors with clocks of different epochs have longer ones; a drive of one frame has no duration.

    Raises:
        ConfigError: it is one.
    """
    spans = spans_of(source) if time_offset_s else None
    if spans is None:
        return
    scans, images = spans
    drive_s = (max(scans[1], images[1]) - min(scans[0], images[0])) / NS_PER_S
    if drive_s <= 0.0 or abs(time_offset_s) <= drive_s or apart_s(scans, images) > 0.0:
        return
    raise ConfigError(
        f"--init {choice}: the start's time offset, {time_offset_s:.4g} s, is longer than the drive "
        f"({drive_s:.2f} s): is it in milliseconds? Expected seconds"
    )


def given_result(path: Path) -> CalibrationResult:
    """The result at a path (:func:`sst_graph.result.read_result`).

    Raises:
        DataError: there is none that can be read.
    """
    refuse_drive(path)
    return read_result(path)


def result_with_information(path: Path) -> CalibrationResult:
    """The result at a path, whose covariance has an inverse.

    Raises:
        DataError: there is none that can be read, or its covariance is singular.
    """
    result = given_result(path)
    root_and_sigmas(result.covariance, f"{result_file(path)}: covariance")
    return result


def refuse_drive(path: Path) -> None:
    """Refuse a drive where a result is expected.

    Raises:
        DataError: it is one.
    """
    if path.exists() and not is_result(path) and (kind := recognized(path)) is not None:
        raise DataError(path, f"a drive ({kind})", "a result: calibrate it first")


def settings(default: T, args: argparse.Namespace, flags: dict[str, Any]) -> T:
    """``default`` changed by ``--config``, then by flags that were given, then by ``--set``."""
    config = default if args.config is None else read_config(type(default), args.config, default)
    given = [f"{name}={json.dumps(value)}" for name, value in flags.items() if value is not None]
    return with_overrides(config, [*given, *args.settings])


def calibration_settings(args: argparse.Namespace) -> CalibrationConfig:
    """The settings that ``calibrate`` was given."""
    from sst_graph.batch import CalibrationConfig  # not all commands that read inputs calibrate

    flags = {
        "method": args.method,
        "classes": chosen_classes(args.classes),
        "time_offset_per_drive": args.time_offset_per_drive,
        "assumptions.estimate": None if args.estimate is None else args.estimate.split(","),
    }
    config = settings(CalibrationConfig(), args, flags)
    refuse_unused_classes(args.classes, config.method)
    return config


def refuse_unused_classes(classes: str | None, method: str) -> None:
    """Nothing, where classes were not named, or the method that was named aligns some.

    Raises:
        ConfigError: it does not.
    """
    if classes is not None and method in ("edges", "motion"):
        raise ConfigError(f"--classes {classes}: means nothing for method {method}, which reads no labels")


def chosen_classes(text: str | None) -> list[str] | None:
    """Names of the classes that ``--classes`` asks for, or None where it is not given.

    Raises:
        ConfigError: a name that is no class that can be aligned.
    """
    if text is None:
        return None
    alignable = [label.name.lower() for label in ALIGNABLE]
    if text == "all":
        return alignable
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in alignable]
    if unknown or not names:
        raise ConfigError(f"--classes {text!r}: expected all, or some of {', '.join(alignable)}")
    return list(dict.fromkeys(names))
