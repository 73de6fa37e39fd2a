"""A video of a result: the LiDAR in the pictures along its drives."""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.cli.drive_motion import DriveMotion
from sst_graph.cli.outputs import check_apart, placement_before
from sst_graph.cli.pictures import ShownFrame, overlay
from sst_graph.cli.progress import ProgressBar
from sst_graph.data.frame_parts import RecentReader, scan_positions
from sst_graph.errors import ConfigError, DataError
from sst_graph.files import FileKind, OutputFile, output_file
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.result import CalibrationResult
from sst_graph.types import Source
from sst_graph.viz import Placement
from sst_graph.viz.video import check_video_name, write_video

VIDEO_FILE = FileKind("a video", lambda head: head[4:8] == b"ftyp" or head.startswith(b"GIF8"))

_INTERVALS = 9
"""So many intervals of the first scans tell the rate of a drive."""
_RATES_HZ = 1.0, 60.0
"""Slowest and fastest video."""


@dataclass(frozen=True)
class VideoOutput:
    """The video that ``calibrate`` was asked for.

    Attributes:
        path: as it was named.
        inside: its name in the folder of the calibration, where it is to stand there.
        beside: the file, where it is to stand elsewhere.
    """

    path: Path
    inside: str | None
    beside: OutputFile | None

    def write(self, place: Path, result: CalibrationResult, sources: Sequence[Source]) -> str:
        """Write the video of a result's drives to a place, with progress on stderr; its name."""
        swept = (with_sweep_of(source, result.diagnostics) for source in sources)
        drives = [(source, placement_before(result, source)) for source in swept]
        with ProgressBar() as progress:
            write_drive_video(place, self.path, result, drives, progress.stage("video"))
        return self.path.name


@contextmanager
def video_beside(args: argparse.Namespace) -> Iterator[VideoOutput | None]:
    """The video that ``--video`` asks for beside or in ``--out``, its name taken; None where it does not.

    Raises:
        ConfigError: no name of a video, or a file that may not be replaced.
        MissingDependencyError: videos cannot be made.
    """
    path: Path | None = args.video
    if path is None:
        yield None
        return
    check_video_name(path, "--video")
    if os.path.realpath(path.parent) == os.path.realpath(args.out):
        yield VideoOutput(path, path.name, None)
        return
    check_apart({"--out": args.out}, {"--video": path})
    if Path(os.path.realpath(args.out)) in Path(os.path.realpath(path)).parents:
        raise ConfigError(f"--video {path}: expected a name in {args.out} itself, or elsewhere")
    with output_file(path, args.overwrite, VIDEO_FILE) as beside:
        yield VideoOutput(path, None, beside)


def refuse_video_of_rig(args: argparse.Namespace) -> None:
    """A video shows one camera.

    Raises:
        ConfigError: one is asked for.
    """
    if args.video is not None:
        raise ConfigError(
            "--video: expected with one camera (afterwards: sst-graph overlay OUT/CAMERA DATA --video FILE)"
        )


def write_drive_video(
    place: Path,
    path: Path,
    result: CalibrationResult,
    drives: Sequence[tuple[Source, Placement | None]],
    progress: Callable[[int, int], None],
) -> int:
    """Write every scan of some drives in the image that shows its instant, at the rate of the first drive.

    Args:
        place: where the file is written.
        path: the video's name, for its form and for messages.
        drives: as they are read, each with the placement that the result is compared with.
        progress: called with the scans done and all scans.

    Returns:
        Number of pictures.

    Raises:
        DataError: no scan has an image.
        OSError: the video cannot be written.
    """
    readers = [(RecentReader(source), before) for source, before in drives]
    total = sum(len(scan_positions(source)) for source, _ in drives)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        done = 0
        for reader, before in readers:
            motion = DriveMotion(reader)
            for position in scan_positions(reader.source):
                picture = _picture(ShownFrame.of(reader, position, result, motion), result, before)
                if picture is not None:
                    yield picture
                done += 1
                progress(done, total)

    try:
        return write_video(place, path.suffix.lower(), pictures(), _rate_hz(readers[0][0]))
    except OSError as error:
        if error.errno is None:  # ffmpeg's own sentence
            raise OSError(f"{path}: {error}") from error
        raise


def _picture(
    shown: ShownFrame, result: CalibrationResult, before: Placement | None
) -> NDArray[np.uint8] | None:
    """The picture of a frame; None where it has no scan, or no image is near."""
    if None in (shown.frame.scan, shown.frame.image, shown.own.scan, shown.own.image):
        return None
    return overlay(shown, result, before)


def _rate_hz(drive: RecentReader) -> float:
    """Scans per second, by the median of the first intervals."""
    first = itertools.islice(scan_positions(drive.source), _INTERVALS + 1)
    stamps_ns = [scan.stamp_ns for position in first if (scan := drive.scan(position)) is not None]
    if not stamps_ns:
        raise DataError(drive.source.name, "no scan in the first frames", "scans to draw")
    if len(stamps_ns) < 2:
        return 10.0
    seconds = 1e-9 * float(np.median(np.diff(stamps_ns)))
    return float(np.clip(1.0 / max(seconds, 1e-6), *_RATES_HZ))
