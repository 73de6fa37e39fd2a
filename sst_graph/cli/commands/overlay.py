"""``sst-graph overlay``: the LiDAR in the image, before and after: one frame, or a video of all."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.inputs import given_result
from sst_graph.cli.messages import mention
from sst_graph.cli.output_places import PNG_FILE, check_apart
from sst_graph.cli.outputs import nominal_of, start_of
from sst_graph.cli.pictures import ShownFrame, close_words, overlay, png, position_of
from sst_graph.cli.progress import ProgressBar
from sst_graph.cli.reading import open_drive_of
from sst_graph.cli.video import VIDEO_FILE, write_drive_video
from sst_graph.data.frame_parts import RecentReader
from sst_graph.errors import ConfigError, count_of
from sst_graph.files import output_file
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.reference import load_initial
from sst_graph.result import CalibrationResult, result_file
from sst_graph.types import Source
from sst_graph.viz import Placement
from sst_graph.viz.video import check_video_name

PICTURE = Path("overlay.png")
"""Written where neither ``--out`` nor ``--video`` says another name."""


def run(args: argparse.Namespace) -> int:
    """Write the picture of one frame to ``args.out``, or a video of all to ``args.video``."""
    if args.video is not None:
        return _write_video(args)
    args.out = PICTURE if args.out is None else args.out
    if args.out.suffix.lower() != ".png":
        raise ConfigError(f"--out {args.out}: expected a name that ends in .png")
    inputs = {"RESULT": result_file(args.result), "DATA": args.data, "--before": args.before}
    check_apart(inputs, {"--out": args.out})
    with output_file(args.out, args.overwrite, PNG_FILE) as out:
        result, source, before = _read(args)
        drive = RecentReader(source)
        position = len(drive) // 2 if args.frame is None else position_of(drive, args.frame)
        shown = ShownFrame.of(drive, position, result)
        drawn = overlay(shown, result, before)
        out.write_bytes(png(drawn.picture))
    close = close_words(drawn.after, drawn.before)
    mention(f"wrote {args.out}: frame {drive.number(position)} of {source.name}{close}")
    return 0


def _write_video(args: argparse.Namespace) -> int:
    if args.frame is not None:
        raise ConfigError("--frame: expected with --out PNG, for a video has all frames")
    check_video_name(args.video, "--video")
    inputs = {"RESULT": result_file(args.result), "DATA": args.data, "--before": args.before}
    check_apart(inputs, {"--video": args.video})
    with output_file(args.video, args.overwrite, VIDEO_FILE) as out:
        result, source, before = _read(args)
        with ProgressBar() as progress:
            stage = progress.stage("video")
            written = write_drive_video(out.partial, args.video, result, [(source, before)], stage)
        out.publish()
    close = close_words(written.after, written.before)
    mention(f"wrote {args.video}: {count_of(written.frames, 'frame')} of {source.name}{close}")
    return 0


def _read(args: argparse.Namespace) -> tuple[CalibrationResult, Source, Placement | None]:
    """The result, its drive, and what it is compared with."""
    result = given_result(args.result)
    source = with_sweep_of(open_drive_of(args, args.data, result, args.result), result.diagnostics)
    return result, source, _before(args.before, result, source)


def _before(choice: str, result: CalibrationResult, source: Source) -> Placement | None:
    """What to compare with; None for a result that had no start."""
    if choice == "initial":
        return start_of(result)
    if choice == "dataset":
        if (nominal := nominal_of(source)) is None:
            raise ConfigError(f"{source.name} brings no nominal calibration to compare with")
        return nominal
    start = load_initial(Path(choice), result.camera_name)
    return Placement(**vars(start), caption=f"before ({Path(choice).name})")
