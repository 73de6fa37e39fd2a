"""A video of pictures: MP4 (H.264, which every player and browser plays) or GIF.

Needs imageio-ffmpeg (the extra ``video``), which brings the program ffmpeg: the wheels of OpenCV have no
encoder for a format that browsers play. ffmpeg takes one picture at a time and writes as it goes.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import ConfigError, DataError, MissingDependencyError

Picture = NDArray[np.uint8]

_FORMS: dict[str, tuple[str, ...]] = {
    # Players want an even number of pixels and colours at half the resolution.
    ".mp4": (
        *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p"),
        *("-movflags", "+faststart", "-f", "mp4"),
    ),
    # A palette for each picture, so that none waits for the others; smaller, for it compresses poorly.
    ".gif": (
        "-filter_complex",
        "scale='min(800,iw)':-1:flags=area,split[a][b];"
        "[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none",
        *("-f", "gif"),
    ),
}
"""ffmpeg's options by the suffix of the video's name."""


def check_video_name(path: Path, option: str) -> str:
    """The suffix of a video's name; asked before the work that leads to the video.

    Args:
        option: that named it, for the message.

    Raises:
        ConfigError: no suffix of a video.
        MissingDependencyError: imageio-ffmpeg is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in _FORMS:
        raise ConfigError(f"{option} {path}: expected a name that ends in {' or '.join(_FORMS)}")
    _encoder()
    return suffix


def write_video(path: Path, suffix: str, pictures: Iterable[Picture], rate_hz: float) -> int:
    """Write pictures (h, w, 3) BGR as a video; their number. All get the size of the first.

    Args:
        path: of the file, which may have any name.
        suffix: ".mp4" or ".gif".
        rate_hz: pictures per second.

    Raises:
        DataError: no picture.
        OSError: the file could not be written.
        MissingDependencyError: imageio-ffmpeg is not installed.
    """
    count, process = 0, None
    with tempfile.TemporaryFile() as errors:
        try:
            for picture in pictures:
                if process is None:
                    size = picture.shape[1], picture.shape[0]
                    command = _command(path, suffix, size, rate_hz)
                    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors)
                assert process.stdin is not None
                process.stdin.write(np.ascontiguousarray(_of_size(picture, size)).data)
                count += 1
            if process is None:
                raise DataError(path, "no picture", "one or more")
            process.communicate()
        except BrokenPipeError:
            pass  # ffmpeg has ended: it says why
        except BaseException:
            if process is not None:
                process.kill()
                process.communicate()
            raise
        if process is None or process.wait() != 0:
            errors.seek(0)
            raise OSError(_complaint(errors.read()))
    return count


def _command(path: Path, suffix: str, size: tuple[int, int], rate_hz: float) -> list[str]:
    pictures = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{size[0]}x{size[1]}", "-r", f"{rate_hz:.6f}"]
    head = [_encoder(), "-y", "-nostdin", "-v", "error", *pictures, "-i", "pipe:0", "-an"]
    return [*head, *_FORMS[suffix], str(path)]


def _encoder() -> str:
    """The program ffmpeg."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise MissingDependencyError(
            "videos need imageio-ffmpeg, which is not installed: pip install 'sst-graph[video]'"
        ) from error


def _of_size(picture: Picture, size: tuple[int, int]) -> Picture:
    """The picture on a black ground of a size (width, height), made smaller where it does not fit."""
    height, width = picture.shape[:2]
    if (width, height) == size:
        return picture
    scale = min(1.0, size[0] / width, size[1] / height)
    shown = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    shown = shown[: size[1], : size[0]]
    ground = np.zeros((size[1], size[0], 3), np.uint8)
    ground[: shown.shape[0], : shown.shape[1]] = shown
    return ground


def _complaint(text: bytes) -> str:
    """The last line that ffmpeg wrote, in a sentence."""
    lines = text.decode(errors="replace").strip().splitlines() or ["no reason given"]
    full = next((line for line in lines if "No space left" in line), lines[-1])
    return f"the video could not be written: {' '.join(full.split())}"
