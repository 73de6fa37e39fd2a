"""From options to drives, starts and settings."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, TypeVar

import gtsam

from sst_graph.config import read_config, with_overrides
from sst_graph.data import open_source
from sst_graph.errors import ConfigError
from sst_graph.reference import load_initial
from sst_graph.result import CalibrationResult, read_result
from sst_graph.types import SemanticClass, Source

T = TypeVar("T")


def open_drive(args: argparse.Namespace, path: Path) -> Source:
    """The drive at ``path``, read as the data options say."""
    return open_source(
        path,
        loader=args.loader,
        sequence=args.sequence,
        frames=args.frames,
        image_shift=args.image_shift,
        camera=args.camera,
        cloud=args.cloud,
        sweep=args.sweep,
        sweep_start_deg=args.sweep_start,
        sweep_stamp=args.sweep_stamp,
    )


def open_drives(args: argparse.Namespace) -> list[Source]:
    """All drives of DATA, each once.

    Raises:
        ConfigError: a drive is named twice.
    """
    paths = [path.resolve() for path in args.data]
    if len(set(paths)) != len(paths):
        raise ConfigError("the same DATA is given twice: each drive counts once")
    return [open_drive(args, path) for path in args.data]


def starting_point(choice: str, source: Source, camera: str) -> tuple[gtsam.Pose3 | None, float]:
    """cTl (None: no guess) and time offset [s] that ``--init`` asks for.

    Raises:
        ConfigError: ``dataset``, and the data bring no nominal calibration.
        DataError: a file that holds none.
    """
    if choice == "none":
        return None, 0.0
    if choice != "dataset":
        return load_initial(Path(choice), camera)
    if source.nominal is None:
        raise ConfigError(f"{source.name} brings no nominal calibration: give --init none or --init FILE")
    return source.nominal, 0.0


def settings(default: T, args: argparse.Namespace, flags: dict[str, Any]) -> T:
    """``default`` changed by ``--config``, then by flags that were given, then by ``--set``."""
    config = default if args.config is None else read_config(type(default), args.config)
    given = [f"{name}={json.dumps(value)}" for name, value in flags.items() if value is not None]
    return with_overrides(config, [*given, *args.settings])


def chosen_classes(text: str | None) -> list[str] | None:
    """Names of the classes that ``--classes`` asks for, or None where it is not given.

    Raises:
        ConfigError: a name that is no class that can be aligned.
    """
    if text is None:
        return None
    not_alignable = (SemanticClass.OTHER, SemanticClass.IGNORE)
    alignable = [label.name.lower() for label in SemanticClass if label not in not_alignable]
    if text == "all":
        return alignable
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in alignable]
    if unknown or not names:
        raise ConfigError(f"--classes {text!r}: expected all, or some of {', '.join(alignable)}")
    return list(dict.fromkeys(names))


def result_at(path: Path) -> CalibrationResult:
    """The result in a ``calibration.json`` or in the folder that holds it."""
    return read_result(path / "calibration.json" if path.is_dir() else path)
