"""Width and height of BMP and WebP files, whose headers declare the length of the file.

Sources: BITMAPINFOHEADER (Microsoft); WebP container specification (Google), RFC 6386 (VP8).
"""

from __future__ import annotations

import struct
from pathlib import Path

from sst_graph.errors import DataError

BMP = b"BM"
_LEAST = 30
"""Bytes that hold the size in each of them."""


def is_bmp_or_webp(data: bytes) -> bool:
    """Whether a file begins as one of them."""
    return data.startswith(BMP) or _is_webp(data)


def _is_webp(data: bytes) -> bool:
    return data.startswith(b"RIFF") and data[8:12] == b"WEBP"


def bmp_or_webp_size(data: bytes, path: str | Path) -> tuple[int, int]:
    """Width and height [px] that a file declares.

    Raises:
        DataError: a header cut short, or of an unknown kind.
    """
    if len(data) < _LEAST:
        raise DataError(path, f"a picture truncated at byte {len(data)}", "its header")
    if data.startswith(BMP):
        # Rows of a negative height begin at the top.
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)
    kind = data[12:16]
    if kind == b"VP8X":
        sides = [int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27)]
    elif kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        sides = [(bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1]
    elif kind == b"VP8 ":
        sides = [side & 0x3FFF for side in struct.unpack_from("<HH", data, 26)]
    else:
        raise DataError(path, f"a WebP file that begins with {kind!r}", "VP8, VP8L or VP8X")
    return sides[0], sides[1]


def check_declared_length(data: bytes, path: str | Path) -> None:
    """Require as many bytes as the header declares.

    Raises:
        DataError: fewer.
    """
    declared = (
        struct.unpack_from("<I", data, 4)[0] + 8 if _is_webp(data) else struct.unpack_from("<I", data, 2)[0]
    )
    if len(data) < declared:
        raise DataError(path, f"a picture truncated at byte {len(data)}", f"{declared} bytes")
