"""``sst-graph calibrate``: from drives on disk to a calibration."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence

import gtsam

from sst_graph.cli.inputs import chosen_classes, open_drives, settings, starting_point
from sst_graph.cli.outputs import MARKER, comparison, verdict, write_calibration
from sst_graph.cli.progress import ProgressBar
from sst_graph.estimators import CalibrationConfig, calibrate
from sst_graph.files import atomic_directory, check_writable_target
from sst_graph.report import Comparison, summary
from sst_graph.result import CalibrationResult
from sst_graph.types import Source


def run(args: argparse.Namespace) -> int:
    """Calibrate ``args.data``, write the result, print its summary."""
    flags = {
        "method": args.method,
        "classes": chosen_classes(args.classes),
        "delay_per_drive": args.delay_per_drive,
    }
    config = settings(CalibrationConfig(), args, flags)
    check_writable_target(args.out, args.overwrite, owned_by=MARKER)
    sources = open_drives(args)
    initial, offset_s = starting_point(args.init, sources[0], args.camera)
    result, against = calibrate_drives(sources, initial, offset_s, config, args.camera)
    with atomic_directory(args.out, args.overwrite, owned_by=MARKER) as folder:
        names = write_calibration(folder, result, sources, against)
    print(summary(result, against))
    print(f"{'wrote':<15} {args.out}: {', '.join(names)}")
    return verdict(result)


def calibrate_drives(
    sources: Sequence[Source],
    initial: gtsam.Pose3 | None,
    initial_offset_s: float,
    config: CalibrationConfig,
    camera: str,
) -> tuple[CalibrationResult, Comparison | None]:
    """The calibration of ``sources``, with progress on stderr, and its errors where they can be known."""
    with ProgressBar() as progress:
        result = calibrate(sources, initial, config, initial_offset_s=initial_offset_s, progress=progress)
    result = dataclasses.replace(result, camera_name=camera)
    return result, comparison(result, sources)
