"""Pictures and masks that are not whole, or declare what they do not hold."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from checks.fuzz_mutations import png_chunks, png_of
from sst_graph.data.decoder_output import decoder_output
from sst_graph.data.images import picture_size, read_instances, read_mask, read_picture
from sst_graph.errors import DataError

WIDTH, HEIGHT = 160, 120


def picture() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (7, 7), 3), np.uint8)


def encoded(suffix: str, image: NDArray[Any] | None = None, *parameters: int) -> bytes:
    return cv2.imencode(suffix, picture() if image is None else image, list(parameters))[1].tobytes()


def with_header(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return png_of([(b"IHDR", header), *png_chunks(encoded(".png"))[1:]])


def with_data(change: Any) -> bytes:
    """The picture with its compressed data, in one chunk, changed."""
    parts = png_chunks(encoded(".png"))
    data = change(b"".join(data for kind, data in parts if kind == b"IDAT"))
    return png_of([parts[0], (b"IDAT", data), parts[-1]])


JPEG = encoded(".jpg")
PROGRESSIVE = encoded(".jpg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
PREVIEW = b"\xff\xe1" + struct.pack(">H", 2 + len(JPEG)) + JPEG


@pytest.mark.parametrize(
    "data",
    [
        JPEG[: len(JPEG) // 2],
        JPEG[: len(JPEG) // 2] + b"\xff\xd9",
        PROGRESSIVE[: len(PROGRESSIVE) // 2] + b"\xff\xd9",
        # A preview in the header ends with an end of its own.
        JPEG[:2] + PREVIEW + JPEG[2 : len(JPEG) // 2],
        JPEG[:2] + PREVIEW,
        JPEG[:30],
        JPEG[:3],
        JPEG.replace(struct.pack(">HH", HEIGHT, WIDTH), struct.pack(">HH", 0, WIDTH), 1),
        encoded(".png")[:-12],
        encoded(".png")[:20],
        with_data(lambda data: data[: len(data) // 2]),
        with_data(lambda data: data[:200] + bytes([data[200] ^ 0x55]) + data[201:]),
        with_data(lambda data: b""),
        with_data(lambda data: zlib.compress(bytes(100))),
        with_header(WIDTH, HEIGHT + 1),
        with_header(WIDTH, HEIGHT - 1),
        with_header(WIDTH + 1, HEIGHT),
        with_header(0, HEIGHT),
        with_header(WIDTH, HEIGHT, 16),
        with_header(WIDTH, HEIGHT, 8, 7),
        b"GIF89a" + bytes(100),
        b"",
    ],
)
def test_damaged_pictures_are_refused_and_nothing_is_printed(
    tmp_path: Path, data: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a"
    path.write_bytes(data)
    with pytest.raises(DataError, match="a: found"):
        read_picture(path)
    with pytest.raises(DataError, match="a: found"):
        read_mask(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "data",
    [
        JPEG,
        PROGRESSIVE,
        JPEG[:2] + PREVIEW + JPEG[2:],
        JPEG[:-2] + bytes(20) + JPEG[-2:],  # padded, as some cameras do
        JPEG + bytes(100),
        encoded(".png"),
        encoded(".png") + b"trailing",
        # What libpng warns of, but no pixel is touched by it.
        png_of([*png_chunks(encoded(".png"))[:1], (b"iCCP", b"bad\0\0"), *png_chunks(encoded(".png"))[1:]]),
    ],
)
def test_whole_pictures_print_nothing(tmp_path: Path, data: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a"
    path.write_bytes(data)
    assert picture_size(path) == (WIDTH, HEIGHT)
    pixels = read_picture(path, (WIDTH, HEIGHT))
    assert np.abs(pixels.astype(int) - picture()).max() < 60 and pixels.shape == (HEIGHT, WIDTH, 3)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("size", [(60_000, 60_000), (32_767, 32_767), (2**31 - 1, 1), (8000, 7000)])
def test_a_declared_giant_costs_no_memory(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(with_header(*size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (read_picture, read_mask, read_instances):
        with pytest.raises(DataError, match=f"found {size[0]}x{size[1]} px, expected at most 50000000"):
            read(path)
        with pytest.raises(DataError, match=f"found {size[0]}x{size[1]} px, expected 8x6 px"):
            read(path, (8, 6))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def test_an_orientation_tag_is_not_followed(tmp_path: Path) -> None:
    tiff = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    path = tmp_path / "a.jpg"
    path.write_bytes(JPEG[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif + JPEG[2:])
    assert cv2.imread(str(path)).shape[:2] == (WIDTH, HEIGHT)
    assert read_picture(path).shape[:2] == (HEIGHT, WIDTH)


def test_what_others_write_meanwhile_is_passed_on(capfd: pytest.CaptureFixture[str]) -> None:
    with decoder_output() as lines:
        os.write(2, b"libpng error: x\nsomebody else\nCorrupt JPEG data: y\n")
    assert lines == ["libpng error: x", "Corrupt JPEG data: y"]
    assert capfd.readouterr().err == "somebody else\n"


def test_a_check_of_opencv_that_fails_is_no_line_of_ours(capfd: pytest.CaptureFixture[str]) -> None:
    said = "> too large (expected: 'a < B'), where\n>     'a' is 4\n> must be less than\n>     'B' is 3\n"
    with decoder_output() as lines:
        os.write(2, said.encode())
    assert len(lines) == 4 and capfd.readouterr().err == ""


def test_a_tiff_file_of_many_long_entries_takes_no_memory(tmp_path: Path) -> None:
    path, count = tmp_path / "a.tif", 2000
    entries = b"".join(struct.pack("<HHII", 300 + k, 4, 100_000, 24_100) for k in range(count))
    path.write_bytes((b"II*\0" + struct.pack("<IH", 8, count) + entries).ljust(500_000, b"\1"))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="1 channel of 1 bits"):
        picture_size(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_jpeg_file_of_many_scans_is_not_decoded(tmp_path: Path) -> None:
    """60,000 empty ones of a large picture would take minutes."""
    path, empty = tmp_path / "a.jpg", b"\xff\xda\0\x08\1\1\0\1\5\0\0\0"
    path.write_bytes(PROGRESSIVE[:-2] + 60_000 * empty + b"\xff\xd9")
    with pytest.raises(DataError, match="scans of one JPEG picture, expected less than 100"):
        read_picture(path)
    path.write_bytes(PROGRESSIVE)
    assert read_picture(path).shape == (HEIGHT, WIDTH, 3)


def test_more_than_a_pipe_holds_does_not_block(capfd: pytest.CaptureFixture[str]) -> None:
    with decoder_output() as lines:
        for _ in range(20_000):
            try:
                os.write(2, b"libpng error: x\n")
            except BlockingIOError:
                break
    assert len(lines) > 1000 and capfd.readouterr().err == ""


def test_a_process_without_stderr_reads_pictures_too(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(JPEG)
    code = (
        f"import os; os.close(2)\nfrom sst_graph.data.images import read_picture\nread_picture({str(path)!r})"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_palette_behind_an_empty_chunk_is_found(tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    mask = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
    mask.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    mask.save(path)
    data, end_of_header = path.read_bytes(), 33
    empty = bytes(4) + b"tEXt" + zlib.crc32(b"tEXt").to_bytes(4, "big")
    path.write_bytes(data[:end_of_header] + empty + data[end_of_header:])
    with pytest.raises(DataError, match=r"mask\.png: found a palette of colours"):
        read_mask(path)


def test_a_palette_of_colours_is_named(tmp_path: Path) -> None:
    """As segmentation tools write masks for the eye. Of greys the indices may be meant, or the greys."""
    mask = Image.fromarray(np.array([[0, 1], [2, 1]], np.uint8), "P")
    mask.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    mask.save(tmp_path / "mask.png")
    with pytest.raises(DataError, match=r"mask\.png: found a palette of colours, expected one channel"):
        read_mask(tmp_path / "mask.png")
    mask.putpalette([7, 7, 7, 8, 8, 8, 9, 9, 9])
    mask.save(tmp_path / "grey.png")
    with pytest.raises(DataError, match=r"grey\.png: found a palette of greys other than their indices"):
        read_mask(tmp_path / "grey.png")
    for entries in (3, 256):
        mask.putpalette(np.repeat(np.arange(entries), 3).tolist())
        mask.save(tmp_path / "same.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "same.png"), [[0, 1], [2, 1]])


FORKS = """
import os, sys, threading
from pathlib import Path
from sst_graph.data.images import read_mask

mask, done = Path(sys.argv[1]), threading.Event()

def decode():
    while not done.is_set():
        read_mask(mask)

stderr = os.fstat(2).st_ino  # before the thread: while it decodes, the process's stderr is a pipe
thread = threading.Thread(target=decode, daemon=True)
thread.start()
for _ in range(5):
    child = os.fork()
    if child == 0:
        read_mask(mask)
        os._exit(os.fstat(2).st_ino != stderr)
    assert os.waitpid(child, 0)[1] == 0
done.set()
thread.join()
"""


def test_a_fork_while_another_thread_decodes(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((64, 64), np.uint8))
    command = [sys.executable, "-c", FORKS, str(tmp_path / "mask.png")]
    subprocess.run(command, check=True, timeout=30)
