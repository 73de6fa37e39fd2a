"""``sst-graph track``: calibration frame by frame, one JSON line a frame."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator

from sst_graph.cli.inputs import chosen_classes, open_drive, settings, starting_point
from sst_graph.errors import ConfigError
from sst_graph.estimators.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.estimators.incremental import Tracker
from sst_graph.estimators.resume import Setup, check_setup, frames_to_come
from sst_graph.estimators.track_update import TrackUpdate
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_result import tracker_result
from sst_graph.files import atomic_write_text
from sst_graph.result import CalibrationResult
from sst_graph.types import Frame, Source


def run(args: argparse.Namespace) -> int:
    """Track ``args.data``; 0 if the last estimate may be trusted, else 3."""
    _check(args)
    source = open_drive(args, args.data)
    tracker, frames = _tracker(args, source)
    last = None
    for number, (frame, is_last) in enumerate(_with_last(frames), 1):
        last = tracker.add(frame)
        if args.checkpoint is not None:
            tracker.make_ready()
        if args.checkpoint is not None and (is_last or number % args.checkpoint_every == 0):
            save_checkpoint(tracker, args.checkpoint)
        if is_last:
            # What the last line says is what is written.
            tracker.settle()
            last = tracker.current(last)
        print(json.dumps({"frame": frame.index, **last.to_dict()}, allow_nan=False), flush=True)
    if last is None:
        tracker.settle()
    result = tracker_result(tracker, source.name, args.camera)
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


def _tracker(args: argparse.Namespace, source: Source) -> tuple[Tracker, Iterator[Frame]]:
    """The tracker of the checkpoint where one is resumed and exists, else a new one; and its frames."""
    flags = {"calibration.classes": chosen_classes(args.classes)}
    config = settings(TrackerConfig(), args, flags)
    if args.resume and args.checkpoint.exists():
        tracker = load_checkpoint(args.checkpoint)
        made = tracker.setup
        initial, offset_s = made.initial, made.initial_offset_s
        if args.init is not None:
            initial, offset_s = starting_point(args.init, source, args.camera)
        # What is not asked for is the checkpoint's.
        asked = settings(made.config, args, flags)
        check_setup(tracker, Setup(source.camera, asked, initial, offset_s), args.checkpoint)
        return tracker, frames_to_come(tracker, source, args.checkpoint)
    initial, offset_s = starting_point(args.init or "dataset", source, args.camera)
    return Tracker(source.camera, config, initial, offset_s), iter(source)


def _with_last(frames: Iterator[Frame]) -> Iterator[tuple[Frame, bool]]:
    """Each frame, and whether it is the last."""
    waiting: Frame | None = None
    for frame in frames:
        if waiting is not None:
            yield waiting, False
        waiting = frame
    if waiting is not None:
        yield waiting, True


def _verdict(last: TrackUpdate, result: CalibrationResult) -> int:
    if last.status == "ok":
        return 0
    print(f"sst-graph: {last.status}: {'; '.join(result.reasons)}", file=sys.stderr)
    return 3
