"""``sst-graph track``: calibration frame by frame, one JSON line a frame."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_graph.batch.by_edges.choice import with_method_for
from sst_graph.batch.config import CalibrationConfig
from sst_graph.cli import EXIT_NOT_TRUSTED
from sst_graph.cli.inputs import chosen_classes, refuse_unused_classes, settings, starting_point
from sst_graph.cli.labels import check_classes
from sst_graph.cli.messages import complain, say
from sst_graph.cli.output_places import CHECKPOINT_FILE, RERUN_FILE, RESULT_FILE, check_apart
from sst_graph.cli.progress import ProgressBar, counted
from sst_graph.cli.reading import open_drive, options_of, warn_of_other_pairs, with_images_read
from sst_graph.errors import ConfigError
from sst_graph.files import output_file
from sst_graph.odometry.sweep import SWEEP_KEY, SweptSource, with_sweep
from sst_graph.result import CalibrationResult
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.storage.checkpoint import Saver, checkpoint_setup
from sst_graph.tracker.storage.resume import Setup, frames_to_come
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.tracker.tracker import Tracker
from sst_graph.types import Frame, Source

_FRAMES_BETWEEN_SAVES = 50

if TYPE_CHECKING:
    from sst_graph.viewer import TrackerView


def run(args: argparse.Namespace) -> int:
    """Track ``args.data``; 0 if the last estimate may be trusted, else 3."""
    _check(args)
    with ExitStack() as outputs:
        out = None
        if args.out is not None:
            out = outputs.enter_context(output_file(args.out, args.overwrite, RESULT_FILE))
        if args.checkpoint is not None:
            # Locked for the whole run: no other tracker may save there.
            replace = args.resume or args.overwrite
            outputs.enter_context(output_file(args.checkpoint, replace, CHECKPOINT_FILE))
        recorded = None
        if args.view_save is not None:
            recorded = outputs.enter_context(output_file(args.view_save, args.overwrite, RERUN_FILE))
        read_as = options_of(args)
        tracker, source, frames = _begun(args, open_drive(args, args.data))
        progress = outputs.enter_context(ProgressBar())
        if not sys.stdout.isatty():  # else each line shows how far it is
            frames = counted(frames, source, progress.stage("track"))
        with _viewed(args, tracker, None if recorded is None else recorded.partial) as view:
            tracker, last = _track(args, tracker, frames, view)
            if view is not None:
                view.finish(last)
        if recorded is not None:
            recorded.publish()
        result = _with_decision(tracker.result(source.name, args.camera), source)
        result = dataclasses.replace(result, read_as=with_images_read(read_as, [source]))
        if out is not None:
            out.write_text(result.to_json())
    return _verdict(last, result)


def _track(
    args: argparse.Namespace,
    tracker: Tracker,
    frames: Iterator[Frame],
    view: TrackerView | None,
) -> tuple[Tracker, TrackUpdate]:
    """Add the frames, and save the tracker as it goes; solve the window as a whole after the last.

    The last line and the result hold the same estimate. With a checkpoint it is that of the tracker in the
    file, whose arrays have the file's memory layout: the result is the same to the last bit whether the run
    was interrupted and resumed or not. The last line is said after that: resumed where no frame is to come,
    the tracker says it again.

    Returns:
        The tracker, and its last update.
    """
    update = None
    with ExitStack() as outputs:
        saver = None if args.checkpoint is None else outputs.enter_context(Saver(args.checkpoint))
        for number, (frame, is_last) in enumerate(_with_last(frames), 1):
            if saver is not None:
                saver.follow(tracker)
            update = tracker.add(frame) if view is None else view.add(frame)
            if saver is not None and (is_last or number % args.checkpoint_every == 0):
                saver.save(tracker)
            if is_last:
                tracker, update = _optimized(args, tracker, saver)
            _say_line(update)
        if update is not None:
            return tracker, update
        # A save consolidates the tracker: what is saved already is not saved again.
        if saver is not None and not args.checkpoint.exists():
            saver.save(tracker)
        tracker, update = _optimized(args, tracker, saver)
        if update.frame is not None:
            _say_line(update)
        return tracker, update


@contextmanager
def _viewed(args: argparse.Namespace, tracker: Tracker, save: Path | None) -> Iterator[TrackerView | None]:
    """What logs the tracker for a viewer; None where neither ``--view`` nor ``--view-save`` asks for it."""
    if not args.view and save is None:
        yield None
        return
    from sst_graph.viewer import Recording, TrackerView

    with Recording(tracker.setup.camera, live=args.view, save=save, tracked=True) as recording:
        yield TrackerView(tracker, recording)


def _say_line(update: TrackUpdate) -> None:
    say(json.dumps(update.to_dict(), allow_nan=False))


def _optimized(
    args: argparse.Namespace, tracker: Tracker, saver: Saver | None
) -> tuple[Tracker, TrackUpdate]:
    """The tracker that is saved, or the one given where none is, its whole window solved; and its update."""
    if saver is not None:
        saver.finish()
        tracker = Tracker.load(args.checkpoint)
    return tracker, tracker.optimize()


def _check(args: argparse.Namespace) -> None:
    if args.view or args.view_save is not None:
        from sst_graph.viewer import rerun

        rerun()
    if args.resume and args.checkpoint is None:
        raise ConfigError("--resume needs --checkpoint FILE")
    if args.checkpoint_every is not None and args.checkpoint is None:
        raise ConfigError("--checkpoint-every needs --checkpoint FILE")
    if args.checkpoint_every is None:
        args.checkpoint_every = _FRAMES_BETWEEN_SAVES
    if args.checkpoint_every < 1:
        raise ConfigError(f"--checkpoint-every {args.checkpoint_every}: expected 1 or more")
    if args.checkpoint is not None and args.checkpoint.exists() and not (args.resume or args.overwrite):
        raise ConfigError(f"{args.checkpoint}: found a file, expected none (or --resume, or --overwrite)")
    check_apart(
        {"DATA": args.data, "--init": args.init, "--config": args.config},
        {"--out": args.out, "--checkpoint": args.checkpoint, "--view-save": args.view_save},
    )


def _begun(args: argparse.Namespace, source: Source) -> tuple[Tracker, SweptSource, Iterator[Frame]]:
    """The tracker of the checkpoint where one is resumed and exists, else a new one; its drive and frames.

    Raises:
        DataError: the checkpoint is of another drive, other sensors, settings or another guess.
    """
    flags: dict[str, Any] = {
        "calibration.method": args.method,
        "calibration.classes": chosen_classes(args.classes),
        "calibration.assumptions.estimate": None if args.estimate is None else args.estimate.split(","),
    }
    config = settings(TrackerConfig(), args, flags)
    refuse_unused_classes(args.classes, config.calibration.method)
    check_classes([source], config.calibration.classes, args.classes)
    if args.init is not None:
        warn_of_other_pairs(args.init, options_of(args))
    if not (args.resume and args.checkpoint.exists()):
        initial, time_offset_s = starting_point(args.init or "dataset", source, args.camera)
        config = dataclasses.replace(config, calibration=_with_method(config.calibration, source))
        swept = with_sweep(source, config.calibration.decide_sweep)
        tracker = Tracker(source.camera, config, initial, time_offset_s, swept.sweep_decision)
        tracker.setup = dataclasses.replace(tracker.setup, image_shift=args.image_shift)
        return tracker, swept, iter(swept)
    made = checkpoint_setup(args.checkpoint)
    initial, time_offset_s = made.initial, made.initial_time_offset_s
    if args.init is not None:
        initial, time_offset_s = starting_point(args.init, source, args.camera)
    # What is not asked for is the checkpoint's; so is the method that was found for the drive.
    if args.method == "auto":
        del flags["calibration.method"]
    asked = settings(made.config, args, flags)
    setup = Setup(source.camera, asked, initial, time_offset_s, args.image_shift)
    swept = with_sweep(source, made.config.calibration.decide_sweep)
    tracker = Tracker.load(args.checkpoint, setup, swept.sweep_decision)
    return tracker, swept, frames_to_come(tracker, swept, args.checkpoint)


def _with_method(config: CalibrationConfig, source: Source) -> CalibrationConfig:
    """The settings with edges where method auto finds no labels in the drive."""
    chosen = with_method_for(config, [source])
    return config if chosen.method == "joint" else chosen


def _with_last(frames: Iterator[Frame]) -> Iterator[tuple[Frame, bool]]:
    """Each frame, and whether it is the last; it is given before an error of the one behind it is raised."""
    waiting = next(frames, None)
    while waiting is not None:
        try:
            following = next(frames, None)
        except Exception:
            yield waiting, False
            raise
        yield waiting, following is None
        waiting = following


def _with_decision(result: CalibrationResult, source: SweptSource) -> CalibrationResult:
    """The result with what was decided of the sweep."""
    diagnostics = {**result.diagnostics, SWEEP_KEY: {source.name: source.sweep_decision.to_dict()}}
    return dataclasses.replace(result, diagnostics=diagnostics)


def _verdict(last: TrackUpdate, result: CalibrationResult) -> int:
    if last.status == "ok":
        return 0
    complain(f"{last.status}: {'; '.join(result.reasons)}")
    return EXIT_NOT_TRUSTED
