"""``sst-graph track``: calibration frame by frame, one JSON line a frame."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator

from sst_graph.cli.inputs import chosen_classes, open_drive, settings, starting_point
from sst_graph.errors import ConfigError, DataError
from sst_graph.estimators.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.track_update import TrackUpdate
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_result import tracker_result
from sst_graph.files import atomic_write_text
from sst_graph.odometry.sweep import REMEDY, SWEEP_KEY, SweptSource, with_sweep
from sst_graph.result import CalibrationResult, Status
from sst_graph.types import Frame, Source


def run(args: argparse.Namespace) -> int:
    """Track ``args.data``; 0 if the last estimate may be trusted, else 3."""
    _check(args)
    source = open_drive(args, args.data)
    tracker = _tracker(args, source)
    source = with_sweep(source, tracker.config.calibration.sweep)
    done = tracker.window.last_stamp_ns
    for number, frame in enumerate(_after(source, done), 1):
        print(json.dumps({"frame": frame.index, **tracker.add(frame).to_dict()}, allow_nan=False), flush=True)
        if args.checkpoint is not None and number % args.checkpoint_every == 0:
            save_checkpoint(tracker, args.checkpoint)
    if args.checkpoint is not None:
        save_checkpoint(tracker, args.checkpoint)
    tracker.settle()
    result = _with_decision(tracker_result(tracker, source.name, args.camera), source)
    if args.out is not None:
        atomic_write_text(args.out, result.to_json())
    return _verdict(tracker.current(), result)


def _check(args: argparse.Namespace) -> None:
    if args.resume and args.checkpoint is None:
        raise ConfigError("--resume needs --checkpoint FILE")
    if args.checkpoint_every < 1:
        raise ConfigError(f"--checkpoint-every {args.checkpoint_every}: expected 1 or more")
    if args.checkpoint is not None and args.checkpoint.exists() and not (args.resume or args.overwrite):
        raise ConfigError(f"{args.checkpoint}: found a file, expected none (or --resume, or --overwrite)")
    if args.out is not None and args.out.exists() and not args.overwrite:
        raise ConfigError(f"{args.out}: found a file, expected none (or --overwrite)")


def _tracker(args: argparse.Namespace, source: Source) -> Tracker:
    """The tracker of the checkpoint where one is resumed and exists, else a new one."""
    if args.resume and args.checkpoint.exists():
        tracker = load_checkpoint(args.checkpoint)
        if tracker.camera != source.camera:
            raise DataError(args.checkpoint, "another camera", f"the camera of {source.name}")
        return tracker
    default = TrackerConfig()
    config = settings(default, args, {"calibration.classes": chosen_classes(args.classes)})
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
    print(f"sst-graph: {status}: {'; '.join(result.reasons)}", file=sys.stderr)
    return 3
