"""Videos: read back by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from videos import read_video

from sst_graph.errors import ConfigError, DataError
from sst_graph.viz.video import check_video_name, write_video

SIZE = (161, 95)


def _pictures(count: int, size: tuple[int, int] = SIZE) -> Iterator[NDArray[np.uint8]]:
    """Picture k is BGR (20 k, 100, 200) with a white block at the left."""
    for k in range(count):
        picture = np.full((size[1], size[0], 3), (20 * k, 100, 200), np.uint8)
        picture[:40, :40] = 255
        yield picture


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_pictures_come_back(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / "any name"
    assert write_video(path, suffix, _pictures(7), 8.0) == 7
    pictures, rate_hz = read_video(path)
    assert len(pictures) == 7 and rate_hz == pytest.approx(8.0, rel=0.05)
    # H.264 wants an even number of pixels.
    assert pictures[0].shape == ((96, 162, 3) if suffix == ".mp4" else (95, 161, 3))
    for k, picture in enumerate(pictures):
        np.testing.assert_allclose(picture[60, 100], (20 * k, 100, 200), atol=6)
        np.testing.assert_allclose(picture[20, 20], 255, atol=6)


def test_an_mp4_is_what_browsers_play(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, ".mp4", _pictures(3), 10.0)
    data = path.read_bytes()
    assert data[4:8] == b"ftyp" and b"avc1" in data
    # The index comes first, so that a player begins before it has all of it.
    assert data.index(b"moov") < data.index(b"mdat")


def test_pictures_of_another_size_are_fitted_in(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(
        path, ".mp4", (one for size in (SIZE, (322, 60), (80, 40)) for one in _pictures(1, size)), 10.0
    )
    first, wide, small = read_video(path)[0]
    assert first.shape == wide.shape == small.shape
    assert wide[50, 80].max() < 8 and wide[15, 120] == pytest.approx((0, 100, 200), abs=8)
    assert small[20, 120].max() < 8 and small[20, 60] == pytest.approx((0, 100, 200), abs=8)


def test_a_full_disk_is_named() -> None:
    with pytest.raises(OSError, match="No space left on device"):
        write_video(Path("/dev/full"), ".gif", _pictures(60), 10.0)


def test_an_error_of_the_pictures_is_their_own(tmp_path: Path) -> None:
    def broken() -> Iterator[NDArray[np.uint8]]:
        yield from _pictures(2)
        raise DataError("frame 2", "no points", "some")

    with pytest.raises(DataError, match="frame 2"):
        write_video(tmp_path / "a.mp4", ".mp4", broken(), 10.0)
    with pytest.raises(DataError, match="no picture"):
        write_video(tmp_path / "a.mp4", ".mp4", iter(()), 10.0)


@pytest.mark.parametrize("name", ["a.avi", "mp4", "a"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"--video .*expected a name that ends in .mp4 or .gif"):
        check_video_name(Path(name), "--video")
    assert check_video_name(Path("a.MP4"), "--video") == ".mp4"
