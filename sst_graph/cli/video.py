"""A video of a result: the LiDAR in the pictures along its drives."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.cli.drive_odometry import DriveOdometry
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.outputs import placement_before
from sst_graph.cli.pictures import Overlay, ShownFrame, overlay
from sst_graph.cli.progress import ProgressBar
from sst_graph.data.frame_parts import RecentReader, scan_positions
from sst_graph.errors import ConfigError, DataError
from sst_graph.files import OutputFile, OutputFileKind, output_file
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.quality.frame_share import ClosePoints
from sst_graph.result import CalibrationResult
from sst_graph.types import Source
from sst_graph.viz import Placement
from sst_graph.viz.video import check_video_name, write_video

VIDEO_FILE = OutputFileKind("a video", lambda head: head[4:8] == b"ftyp" or head.startswith(b"GIF8"))

_INTERVALS = 9
"""So many intervals of the first scans tell the rate of a drive."""
_RATES_HZ = 1.0, 60.0
"""Slowest and fastest video."""


@dataclass(frozen=True)
class VideoOutput:
    """The video of one camera that ``calibrate`` was asked for.

    Attributes:
        path: as it was named.
        beside: the file, where it is to stand elsewhere than in the folder of the calibration.
    """

    path: Path
    beside: OutputFile | None

    def write_inside(self, folder: Path, result: CalibrationResult, sources: Sequence[Source]) -> list[str]:
        """Write it into the folder of the calibration; its name, where it is to stand there."""
        if self.beside is not None:
            return []
        self._write(folder / self.path.name, result, sources)
        return [self.path.name]

    def write_beside(self, result: CalibrationResult, sources: Sequence[Source]) -> list[Path]:
        """Write the file of its own; its path, where it is to be one."""
        if self.beside is None:
            return []
        self._write(self.beside.partial, result, sources)
        self.beside.publish()
        return [self.path]

    def _write(self, place: Path, result: CalibrationResult, sources: Sequence[Source]) -> None:
        swept = (with_sweep_of(source, result.diagnostics) for source in sources)
        drives = [(source, placement_before(result, source)) for source in swept]
        with ProgressBar() as progress:
            write_drive_video(place, self.path, result, drives, progress.stage("video"))


@dataclass(frozen=True)
class WrittenVideo:
    """What was written.

    Attributes:
        frames: number of pictures.
        after: close points of all frames under the result; None without labels.
        before: the same under what it is compared with; None without.
    """

    frames: int
    after: ClosePoints | None
    before: ClosePoints | None


def video_of(path: Path, folder: str) -> Path:
    """The video of one camera of a rig: drive_image_3.mp4 for drive.mp4 and the folder image_3."""
    return path.with_name(f"{path.stem}_{folder}{path.suffix}")


@contextmanager
def videos_beside(paths: Sequence[Path], out: Path, overwrite: bool) -> Iterator[list[VideoOutput]]:
    """Videos beside or in the folder ``out``, their names taken.

    Raises:
        ConfigError: no name of a video, or a file that may not be replaced.
        MissingDependencyError: videos cannot be made.
    """
    with ExitStack() as stack:
        yield [_video_beside(stack, path, out, overwrite) for path in paths]


def _video_beside(stack: ExitStack, path: Path, out: Path, overwrite: bool) -> VideoOutput:
    check_video_name(path, "--video")
    if os.path.realpath(path.parent) == os.path.realpath(out):
        return VideoOutput(path, None)
    check_apart({"--out": out}, {"--video": path})
    if Path(os.path.realpath(out)) in Path(os.path.realpath(path)).parents:
        raise ConfigError(f"--video {path}: expected a name in {out} itself, or elsewhere")
    return VideoOutput(path, stack.enter_context(output_file(path, overwrite, VIDEO_FILE)))


def write_drive_video(
    place: Path,
    path: Path,
    result: CalibrationResult,
    drives: Sequence[tuple[Source, Placement | None]],
    progress: Callable[[int, int], None],
) -> WrittenVideo:
    """Write every scan of some drives in the image that shows its instant, at the rate of the first drive.

    Args:
        place: where the file is written.
        path: the video's name, for its form and for messages.
        drives: as they are read, each with the placement that the result is compared with.
        progress: called with the scans done and all scans.

    Raises:
        DataError: no scan has an image.
        OSError: the video cannot be written.
    """
    readers = [(RecentReader(source), before) for source, before in drives]
    total = sum(len(scan_positions(source)) for source, _ in drives)

    after, before_all = [], []

    def pictures() -> Iterator[NDArray[np.uint8]]:
        done = 0
        for reader, before in readers:
            motion = DriveOdometry(reader)
            for position in scan_positions(reader.source):
                drawn = _drawn(ShownFrame.of(reader, position, result, motion), result, before)
                if drawn is not None:
                    after.append(drawn.after)
                    before_all.append(drawn.before)
                    yield drawn.picture
                done += 1
                progress(done, total)

    try:
        count = write_video(place, path.suffix.lower(), pictures(), _rate_hz(readers[0][0]))
    except OSError as error:
        if error.errno is None:  # ffmpeg's own sentence
            raise OSError(f"{path}: {error}") from error
        raise
    return WrittenVideo(count, _together(after), _together(before_all))


def _together(found: Sequence[ClosePoints | None]) -> ClosePoints | None:
    """Those of all frames; None where no frame has labels."""
    known = [one for one in found if one is not None]
    return sum(known, ClosePoints(0, 0)) if known else None


def _drawn(shown: ShownFrame, result: CalibrationResult, before: Placement | None) -> Overlay | None:
    """A frame; None where it has no scan, or no image is near."""
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
