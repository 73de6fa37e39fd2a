"""``sst-graph view``: a result and its drive in the viewer rerun, or in a file for it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np

from sst_graph.batch import CalibrationConfig
from sst_graph.cli.inputs import chosen_classes, given_result
from sst_graph.cli.messages import mention
from sst_graph.cli.output_places import RERUN_FILE, check_apart
from sst_graph.cli.progress import ProgressBar, counted
from sst_graph.cli.reading import open_drive_of
from sst_graph.errors import ConfigError, count_of, in_file
from sst_graph.files import output_file
from sst_graph.inspect.frame_information import FrameInformation, frames_of
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.result import CalibrationResult, result_file
from sst_graph.types import SemanticClass, Source
from sst_graph.viewer import Recording, rerun
from sst_graph.viewer.fixed_calibration import views_under


def run(args: argparse.Namespace) -> int:
    """Log the frames of ``args.data`` under ``args.result``."""
    rerun()
    inputs = {"RESULT": result_file(args.result), "DATA": args.data}
    check_apart(inputs, {"--save": args.save})
    with ExitStack() as outputs:
        out = None
        if args.save is not None:
            out = outputs.enter_context(output_file(args.save, args.overwrite, RERUN_FILE))
        result = given_result(args.result)
        with in_file(result_file(args.result)):
            information = frames_of(result)
        source = with_sweep_of(open_drive_of(args, args.data, result, args.result), result.diagnostics)
        place = None if out is None else out.partial
        with Recording(source.camera, live=out is None, save=place, tracked=False) as recording:
            count = _log(recording, result, source, information)
        if out is not None:
            out.publish()
            mention(
                f"wrote {args.save}: {count_of(count, 'frame')} of {source.name} (open it with: rerun "
                f"{args.save})"
            )
    return 0


def _log(
    recording: Recording, result: CalibrationResult, source: Source, information: Sequence[FrameInformation]
) -> int:
    """Log all frames, and the sigmas as frames accumulate; the number of frames shown."""
    time_offset_s, count = result.time_offset_of(source.name), 0
    frames = result.T_camera_lidar, time_offset_s, _classes(result)
    with ProgressBar() as progress:
        shown = counted(source, source, progress.stage("view"))
        for view in views_under(shown, source.camera, *frames):
            recording.frame(view)
            count += 1
    if not count:
        raise ConfigError(f"{source.name}: found no scan that can be shown, expected one or more")
    final = np.sqrt(np.diag(result.covariance))
    for one in information:
        if one.frame.drive == source.name:
            recording.sigmas_at(one.frame.frame, final * one.so_far)
    return count


def _classes(result: CalibrationResult) -> tuple[SemanticClass, ...]:
    """The classes that the result aligned; vehicles where it does not say."""
    config = result.config.get("calibration", result.config)
    names = config.get("classes") if isinstance(config, dict) else None
    try:
        chosen = chosen_classes(",".join(names)) if isinstance(names, list) else None
    except (ConfigError, TypeError):
        chosen = None
    return tuple(SemanticClass[name.upper()] for name in chosen) if chosen else CalibrationConfig().classes
