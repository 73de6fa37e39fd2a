"""Reading of pictures, semantic masks and instance masks, refusing files that are not whole."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import read_bytes
from sst_graph.errors import DataError

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Picture (h, w, 3) uint8 BGR of a PNG or JPEG file, grey ones repeated in the channels.

    Raises:
        DataError: a missing, truncated or damaged file.
    """
    return _decode(path, cv2.IMREAD_COLOR).astype(np.uint8, copy=False)


def read_mask(path: Path) -> NDArray[np.uint8]:
    """Mask (h, w) uint8 of a PNG file; several channels or 16 bits only where nothing is lost.

    Raises:
        DataError: a missing, truncated or damaged file, channels that differ (a coloured mask),
            values that do not fit into 8 bits.
    """
    mask = _single_channel(path)
    if mask.dtype != np.uint8:
        if int(mask.max(initial=0)) > 255:
            raise DataError(path, f"{mask.dtype} values up to {mask.max()}", "8-bit class numbers")
        mask = mask.astype(np.uint8)
    return mask


def read_instances(path: Path) -> NDArray[np.uint16]:
    """Instances (h, w) uint16 of a PNG file with class * 256 + instance; 0: none.

    Raises:
        DataError: a missing, truncated or damaged file, or channels that differ.
    """
    values = _single_channel(path).astype(np.uint16)
    instances: NDArray[np.uint16] = np.where(values < 256, 0, values % 256).astype(np.uint16)
    return instances


def check_size(path: Path, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Require an image's shape (h, w, ...) to begin with the expected (h, w).

    Raises:
        DataError: another size.
    """
    if shape[:2] != expected[:2]:
        wanted = f"{expected[1]}x{expected[0]} px, as the first image"
        raise DataError(path, f"{shape[1]}x{shape[0]} px", wanted)


def _single_channel(path: Path) -> NDArray[Any]:
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim == 3:
        channels = image[:, :, :3]
        if (channels != channels[:, :, :1]).any():
            raise DataError(path, f"{image.shape[2]} channels that differ", "one channel of class numbers")
        image = channels[:, :, 0]
    return np.ascontiguousarray(image)


def _decode(path: Path, flags: int) -> NDArray[Any]:
    data = read_bytes(path)
    _check_whole(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise DataError(path, "an image that does not decode", "a whole PNG or JPEG file")
    decoded: NDArray[Any] = np.asarray(image)
    return decoded


def _check_whole(path: Path, data: bytes) -> None:
    """Find truncation and damage that decoders pass over in silence, leaving grey areas."""
    if data.startswith(_PNG):
        _check_png_chunks(path, data)
    elif data.startswith(_JPEG):
        if b"\xff\xd9" not in data[-64:]:
            raise DataError(path, "a truncated JPEG file", "an end-of-image marker")
    else:
        raise DataError(path, f"first bytes {data[:4]!r} of {len(data)}", "a PNG or JPEG file")


def _check_png_chunks(path: Path, data: bytes) -> None:
    at = len(_PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise DataError(path, f"a damaged PNG chunk at byte {at}", "one that fits its checksum")
        if data[at + 4 : at + 8] == b"IEND":
            return
        at = end
    raise DataError(path, f"a PNG file truncated at byte {len(data)}", "its last chunk IEND")
