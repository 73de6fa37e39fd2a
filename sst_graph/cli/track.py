"""``sst-graph track``: calibration frame by frame, one JSON line a frame."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator
from contextlib import ExitStack

from sst_graph.cli.inputs import chosen_classes, settings, starting_point
from sst_graph.cli.messages import complain, say
from sst_graph.cli.outputs import CHECKPOINT_FILE, RESULT_FILE, check_apart
from sst_graph.cli.reading import open_drive, options_of, warn_of_other_pairs
from sst_graph.errors import ConfigError, DataError
from sst_graph.estimators.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.track_update import TrackUpdate
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_result import tracker_result
from sst_graph.files import output_file
from sst_graph.odometry.sweep import REMEDY, SWEEP_KEY, SweptSource, with_sweep
from sst_graph.result import CalibrationResult, Status
from sst_graph.types import Frame, Source


def run(args: argparse.Namespace) -> int:
    """Track ``args.data``; 0 if the last estimate may be trusted, else 3."""
    _check(args)
    with ExitStack() as outputs:
        out = None
        if args.out is not None:
            out = outputs.enter_context(output_file(args.out, args.overwrite, RESULT_FILE))
        if args.checkpoint is not None:
            # Taken for the whole run: no other tracker may save there.
            replace = args.resume or args.overwrite
            outputs.enter_context(output_file(args.checkpoint, replace, CHECKPOINT_FILE))
        read_as = options_of(args)
        source = open_drive(args, args.data)
        tracker = _tracker(args, source)
        source = with_sweep(source, tracker.config.calibration.sweep)
        tracker = _track(args, source, tracker)
        tracker.settle()
        result = _with_decision(tracker_result(tracker, source.name, args.camera), source)
        result = dataclasses.replace(result, read_as=read_as)
        if out is not None:
            out.write_text(result.to_json())
    return _verdict(tracker.current(), result)


def _track(args: argparse.Namespace, source: Source, tracker: Tracker) -> Tracker:
    """Add the frames that the tracker has not seen, and save it as it goes; the tracker after the last.

    With a checkpoint it is the one that the file holds, its arrays laid out as in the file: the result is the
    same to the last bit whether the run was broken off and resumed or not.
    """
    # A save consolidates the tracker: what is saved already is not saved again.
    unsaved = args.checkpoint is not None and not args.checkpoint.exists()
    for number, frame in enumerate(_after(source, tracker.window.last_stamp_ns), 1):
        say(json.dumps({"frame": frame.index, **tracker.add(frame).to_dict()}, allow_nan=False))
        unsaved = args.checkpoint is not None
        if unsaved and number % args.checkpoint_every == 0:
            save_checkpoint(tracker, args.checkpoint)
            unsaved = False
    if unsaved:
        save_checkpoint(tracker, args.checkpoint)
    if args.checkpoint is None:
        return tracker
    return load_checkpoint(args.checkpoint)


def _check(args: argparse.Namespace) -> None:
    if args.resume and args.checkpoint is None:
        raise ConfigError("--resume needs --checkpoint FILE")
    if args.checkpoint_every < 1:
        raise ConfigError(f"--checkpoint-every {args.checkpoint_every}: expected 1 or more")
    if args.checkpoint is not None and args.checkpoint.exists() and not (args.resume or args.overwrite):
        raise ConfigError(f"{args.checkpoint}: found a file, expected none (or --resume, or --overwrite)")
    check_apart(
        {"DATA": args.data, "--init": args.init, "--config": args.config},
        {"--out": args.out, "--checkpoint": args.checkpoint},
    )


def _tracker(args: argparse.Namespace, source: Source) -> Tracker:
    """The tracker of the checkpoint where one is resumed and exists, else a new one."""
    if args.resume and args.checkpoint.exists():
        tracker = load_checkpoint(args.checkpoint)
        if tracker.camera != source.camera:
            raise DataError(args.checkpoint, "another camera", f"the camera of {source.name}")
        return tracker
    default = TrackerConfig()
    config = settings(default, args, {"calibration.classes": chosen_classes(args.classes)})
    warn_of_other_pairs(args.init, options_of(args))
    initial, offset_s = starting_point(args.init, source, args.camera)
    return Tracker(source.camera, config, initial, offset_s)


def _after(source: Source, stamp_ns: int | None) -> Iterator[Frame]:
    """Frames of a drive later than a scan's stamp; earlier ones are read past."""
    for frame in source:
        newest = frame.scan.stamp_ns if frame.scan is not None else None
        if newest is None and frame.image is not None:
            newest = frame.image.stamp_ns
        if stamp_ns is None or (newest is not None and newest > stamp_ns):
            yield frame


def _with_decision(result: CalibrationResult, source: SweptSource) -> CalibrationResult:
    """The result with what was decided of the sweep; not to be trusted where the scans did not tell it."""
    decision = source.sweep_decision
    diagnostics = {**result.diagnostics, SWEEP_KEY: {source.name: decision.to_dict()}}
    result = dataclasses.replace(result, diagnostics=diagnostics)
    if decision.kind != "undecided" or not decision.others:
        return result
    reason = f"whether the clouds are compensated for the sweep cannot be told from the scans: {REMEDY}"
    status: Status = "not_converged" if result.status == "ok" else result.status
    return dataclasses.replace(result, status=status, reasons=(*result.reasons, reason))


def _verdict(last: TrackUpdate, result: CalibrationResult) -> int:
    if last.status == result.status == "ok":
        return 0
    status = result.status if last.status == "ok" else last.status
    complain(f"{status}: {'; '.join(result.reasons)}")
    return 3
