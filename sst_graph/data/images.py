"""Reading of pictures, semantic masks and instance masks, refusing files that are not whole.

The size that a file declares is compared with what is expected before anything is decoded, so that no memory
is taken for a wrong one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.decoder_output import decoder_output
from sst_graph.data.image_header import JPEG, check_whole, image_size, palette_of
from sst_graph.errors import DataError
from sst_graph.files.reading import FileKind, read_file

IMAGE = FileKind("a PNG, JPEG, TIFF, BMP or WebP file", 128 * 1024 * 1024)

MAX_PIXELS = 50_000_000
"""Pixels of an image; a picture of 8K video has 33 million. As 16-bit RGBA this many take 0.4 GB."""

DARK = 16
"""Pictures of no brighter value are black to the eye: so are 12 bits that were kept in 16, read as 8."""

Size = tuple[int, int]
"""Width, height [px]."""

_PADDING = "extraneous bytes before marker 0xd9"
"""What libjpeg says of padding before the end, as some cameras write it: no pixel is missing."""


def picture_size(path: Path) -> Size:
    """Width and height [px] by the header of a PNG, JPEG, TIFF, BMP or WebP file; nothing is decoded.

    Raises:
        DataError: a missing file, none of these, or more than MAX_PIXELS.
    """
    return _checked_size(read_file(path, IMAGE), path, None)


def read_picture(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Picture (h, w, 3) uint8 BGR of a PNG, JPEG, TIFF, BMP or WebP file, grey ones repeated in the channels.

    Rows and columns are those of the sensor: an orientation tag is not followed, as intrinsics and masks do
    not follow it either.

    Args:
        size: width and height that it must have [px]; None: any.

    Raises:
        DataError: a missing, truncated or damaged file, or one of another size.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return _decoded(read_file(path, IMAGE), flags, path, size).astype(np.uint8, copy=False)


def decoded_picture(data: bytes, place: str | Path) -> NDArray[np.uint8]:
    """Picture (h, w, 3) uint8 BGR of the bytes of a PNG or JPEG file; ``place`` is named in errors.

    Raises:
        DataError: truncated or damaged.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return _decoded(data, flags, place, None).astype(np.uint8, copy=False)


def decoded_mask(data: bytes, place: str | Path) -> NDArray[np.uint8]:
    """Mask (h, w) uint8 of the bytes of a PNG file; ``place`` is named in errors.

    Raises:
        DataError: as :func:`read_mask`.
    """
    return _as_mask(_one_channel(_decoded(data, cv2.IMREAD_UNCHANGED, place, None), data, place), place)


def read_mask(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Mask (h, w) uint8 of a PNG file; several channels or 16 bits only where nothing is lost.

    Args:
        size: width and height that it must have [px]; None: any.

    Raises:
        DataError: a missing, truncated or damaged file, one of another size, channels that differ (a
            coloured mask), values that do not fit into 8 bits.
    """
    return _as_mask(_single_channel(path, size), path)


def _as_mask(mask: NDArray[Any], place: str | Path) -> NDArray[np.uint8]:
    if mask.dtype != np.uint8:
        if int(mask.max(initial=0)) > 255:
            raise DataError(place, f"{mask.dtype} values up to {mask.max()}", "8-bit class numbers")
        mask = mask.astype(np.uint8)
    return mask


def read_instances(path: Path, size: Size | None = None) -> NDArray[np.uint16]:
    """Instances (h, w) uint16 of a PNG file with class * 256 + instance; 0: none.

    Args:
        size: width and height that it must have [px]; None: any.

    Raises:
        DataError: a missing, truncated or damaged file, one of another size, or channels that differ.
    """
    values = _single_channel(path, size).astype(np.uint16)
    instances: NDArray[np.uint16] = np.where(values < 256, 0, values % 256).astype(np.uint16)
    return instances


def _single_channel(path: Path, size: Size | None) -> NDArray[Any]:
    data = read_file(path, IMAGE)
    return _one_channel(_decoded(data, cv2.IMREAD_UNCHANGED, path, size), data, path)


def _one_channel(image: NDArray[Any], data: bytes, place: str | Path) -> NDArray[Any]:
    if data.startswith(JPEG):
        raise DataError(place, "a JPEG picture, whose numbers are not exact", "a mask as PNG")
    if image.ndim == 3:
        channels = image[:, :, :3]
        has_colours, palette = bool((channels != channels[:, :, :1]).any()), palette_of(data)
        if has_colours or not (palette is None or _are_indices(palette)):
            found = f"{image.shape[2]} channels that differ"
            if palette is not None:
                found = (
                    "a palette of colours" if has_colours else "a palette of greys other than their indices"
                )
            raise DataError(place, found, "one channel of class numbers, without colours")
        image = channels[:, :, 0]
    return np.ascontiguousarray(image)


def _are_indices(palette: NDArray[np.uint8]) -> bool:
    """Whether a palette (n, 3) gives each index as its grey, so that it does not matter which one is meant;
    behind its last entry tools write black."""
    used = palette[: int(np.flatnonzero(palette.any(axis=1)).max(initial=0)) + 1]
    return bool((used == np.arange(len(used))[:, None]).all())


def _decoded(data: bytes, flags: int, path: str | Path, size: Size | None) -> NDArray[Any]:
    width, height = _checked_size(data, path, size)
    check_whole(data, path)
    with decoder_output() as complaints:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            image = None
    if image is None:
        raise DataError(path, "an image that does not decode", "a whole PNG, JPEG, TIFF, BMP or WebP file")
    damage = [line for line in complaints if _tells_damage(line)]
    if damage:
        raise DataError(path, f"a damaged image ({damage[0]})", "a whole PNG, JPEG, TIFF, BMP or WebP file")
    decoded: NDArray[Any] = np.asarray(image)
    if decoded.shape[:2] != (height, width):
        found = f"{decoded.shape[1]}x{decoded.shape[0]} px"
        raise DataError(path, found, f"{width}x{height} px, as its header says")
    return decoded


def _tells_damage(line: str) -> bool:
    """Whether a decoder's line says that pixels are missing or wrong; libpng warns of much besides."""
    if line.startswith("[ERROR") and "tiff" in line:
        return True
    if line.startswith("libpng warning"):
        return "IDAT" in line
    return line.startswith(("libpng", "Corrupt", "Premature", "Inconsistent")) and _PADDING not in line


def _checked_size(data: bytes, path: str | Path, expected: Size | None) -> Size:
    width, height = image_size(data, path)
    if expected is not None and (width, height) != expected:
        wanted = f"{expected[0]}x{expected[1]} px, the camera's size"
        raise DataError(path, f"{width}x{height} px", wanted)
    if width * height > MAX_PIXELS:
        raise DataError(path, f"{width}x{height} px", f"at most {MAX_PIXELS} pixels")
    return width, height
