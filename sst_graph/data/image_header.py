"""Width and height of a PNG, JPEG, TIFF, BMP or WebP file by its header, and whether the file is whole.

A TIFF file is known by its first directory; source: TIFF Revision 6.0 (Adobe, 1992). Pictures of 8 or 16 bits
with up to four channels are read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.length_header import bmp_or_webp_size, check_declared_length, is_bmp_or_webp
from sst_graph.errors import DataError, count_of

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*")

_START_OF_FRAME = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}
_COLOUR_TYPE, _OF_PALETTE = 25, 3
"""Where the header of a PNG file says what its pixels are, and that of indices."""
_STANDALONE = {0x01, *range(0xD0, 0xD8)}
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_MAX_SCANS = 100
"""Of a JPEG picture; encoders make ten."""


def image_size(data: bytes, path: str | Path) -> tuple[int, int]:
    """Width and height [px] that a PNG, JPEG, TIFF, BMP or WebP file declares.

    Raises:
        DataError: none of them, or without a header that says so.
    """
    if data.startswith(PNG):
        width, height = _png_size(data, path)
    elif data.startswith(JPEG):
        width, height = _jpeg_size(data, path)
    elif data.startswith(TIFF):
        width, height = tiff_size(data, path)
    elif is_bmp_or_webp(data):
        width, height = bmp_or_webp_size(data, path)
    else:
        expected = "a PNG, JPEG, TIFF, BMP or WebP file"
        raise DataError(path, f"first bytes {data[:4]!r} of {len(data)}", expected)
    if width == 0 or height == 0:
        raise DataError(path, f"a size of {width}x{height} px", "a picture with pixels")
    return width, height


def check_whole(data: bytes, path: str | Path) -> None:
    """Find truncation and damage that decoders pass over in silence, leaving grey areas.

    Raises:
        DataError: a PNG chunk that misses its checksum, or a file without its end.
    """
    if data.startswith(PNG):
        _check_png_chunks(data, path)
    elif data.startswith(TIFF):
        check_tiff_whole(data, path)
    elif is_bmp_or_webp(data):
        check_declared_length(data, path)
    else:
        _check_jpeg_end(data, path)


def palette_of(data: bytes) -> NDArray[np.uint8] | None:
    """Colours (n, 3) by index of a whole PNG file of indices; None of another one."""
    if not data.startswith(PNG) or data[_COLOUR_TYPE] != _OF_PALETTE:
        return None
    colours = next((data[at + 8 : end - 4] for kind, at, end in _png_chunks(data) if kind == b"PLTE"), b"")
    return np.frombuffer(colours, np.uint8, len(colours) // 3 * 3).reshape(-1, 3)


def _png_size(data: bytes, path: str | Path) -> tuple[int, int]:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise DataError(path, f"a PNG file truncated at byte {len(data)}", "its header IHDR")
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg_size(data: bytes, path: str | Path) -> tuple[int, int]:
    for marker, start, end in _jpeg_segments(data):
        if marker in _START_OF_FRAME and end - start >= 5:
            height, width = struct.unpack_from(">HH", data, start + 1)
            return width, height
    raise DataError(path, "a truncated JPEG file", "a frame header")


def _jpeg_segments(data: bytes) -> list[tuple[int, int, int]]:
    """Markers before the first scan with the range of their contents; that of the scan goes on to the end."""
    segments = []
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _STANDALONE:
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker == _START_OF_SCAN:
            segments.append((marker, at + 4, len(data)))
            break
        if length < 2 or at + 2 + length > len(data):
            break
        segments.append((marker, at + 4, at + 2 + length))
        at += 2 + length
    return segments


def _check_jpeg_end(data: bytes, path: str | Path) -> None:
    """An end of image behind the first scan: a preview in the header has one of its own."""
    scans = [start for marker, start, _ in _jpeg_segments(data) if marker == _START_OF_SCAN]
    # Each scan takes the time of the whole picture, however short it is; within one, 0xFF is followed by 0.
    if scans and (count := data.count(bytes((0xFF, _START_OF_SCAN)), scans[0])) >= _MAX_SCANS:
        raise DataError(path, f"{count_of(count, 'scan')} of one JPEG picture", f"less than {_MAX_SCANS}")
    if not scans or data.find(bytes((0xFF, _END_OF_IMAGE)), scans[0]) < 0:
        raise DataError(path, "a truncated JPEG file", "an end-of-image marker")


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, begin and end of each whole chunk of a PNG file, up to the last one."""
    kind, end = b"", len(PNG)
    while kind != b"IEND" and end + 12 <= len(data):
        at = end
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if end > len(data):
            return
        yield kind, at, end


def _check_png_chunks(data: bytes, path: str | Path) -> None:
    for kind, at, end in _png_chunks(data):
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise DataError(path, f"a damaged PNG chunk at byte {at}", "one that fits its checksum")
        if kind == b"IEND":
            return
    raise DataError(path, f"a PNG file truncated at byte {len(data)}", "its last chunk IEND")


_WIDTH, _HEIGHT, _BITS, _CHANNELS = 256, 257, 258, 277
_STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES = 273, 279, 324, 325
_USED = frozenset((_WIDTH, _HEIGHT, _BITS, _CHANNELS, _STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES))
_FORMATS = {3: ("H", 2), 4: ("I", 4)}
"""Of SHORT and LONG values."""
_MAX_VALUES = 1_000_000
"""Of one entry: strips or tiles of a picture."""


@dataclass(frozen=True)
class _Directory:
    """Entries of the first directory that are used: values of SHORT and LONG ones by tag."""

    path: str | Path
    entries: dict[int, tuple[int, ...]]

    def one(self, tag: int, what: str, default: int | None = None) -> int:
        values = self.entries.get(tag, () if default is None else (default,))
        if not values:
            raise DataError(self.path, f"a TIFF file without its {what}", "a directory that has it")
        return values[0]


def tiff_size(data: bytes, path: str | Path) -> tuple[int, int]:
    """Width and height [px] that a TIFF file declares.

    Raises:
        DataError: no such directory, or a kind of pixels that is not read.
    """
    directory = _directory(data, path)
    bits, channels = set(directory.entries.get(_BITS, (1,))), directory.one(_CHANNELS, "channels", 1)
    if not bits <= {8, 16} or not 1 <= channels <= 4:
        found = f"{count_of(channels, 'channel')} of {'/'.join(map(str, sorted(bits)))} bits"
        raise DataError(path, found, "1 to 4 channels of 8 or 16 bits")
    return directory.one(_WIDTH, "width"), directory.one(_HEIGHT, "height")


def check_tiff_whole(data: bytes, path: str | Path) -> None:
    """Require that all strips or tiles lie within the file.

    Raises:
        DataError: one does not.
    """
    entries = _directory(data, path).entries
    starts = entries.get(_STRIPS) or entries.get(_TILES) or ()
    sizes = entries.get(_STRIP_BYTES) or entries.get(_TILE_BYTES) or ()
    if not starts or len(starts) != len(sizes):
        raise DataError(
            path, f"{count_of(len(starts), 'strip')} with {count_of(len(sizes), 'size')}", "one size a strip"
        )
    if max(start + size for start, size in zip(starts, sizes, strict=True)) > len(data):
        raise DataError(path, f"a TIFF file truncated at byte {len(data)}", "all strips of its pixels")


def _directory(data: bytes, path: str | Path) -> _Directory:
    order = "<" if data.startswith(b"II") else ">"
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        entries = {}
        for k in range(count):
            tag, kind, values = struct.unpack_from(f"{order}HHI", data, at + 2 + 12 * k)
            # Of each only the first: a file may name one tag 65,535 times, with a million values each.
            if tag not in _USED or tag in entries or kind not in _FORMATS or not 1 <= values <= _MAX_VALUES:
                continue
            code, size = _FORMATS[kind]
            place = at + 10 + 12 * k
            if values * size > 4:
                (place,) = struct.unpack_from(f"{order}I", data, place)
            entries[tag] = struct.unpack_from(f"{order}{values}{code}", data, place)
    except struct.error:
        raise DataError(path, f"a TIFF file truncated at byte {len(data)}", "its directory") from None
    return _Directory(path, entries)
