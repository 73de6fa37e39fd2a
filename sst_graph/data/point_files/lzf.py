"""LZF, the compression of PCD files (Marc Lehmann's liblzf).

A control byte c < 32 is followed by c + 1 bytes as they are. Else bytes are repeated: c >> 5 (7: plus the
next byte) + 2 of them, from ((c & 31) << 8 | next byte) + 1 before the end of what was unpacked.
"""

from __future__ import annotations

from pathlib import Path

from sst_graph.errors import DataError, count_of


def unpack_lzf(packed: bytes, size: int, path: Path) -> bytes:
    """The ``size`` bytes that were packed.

    Raises:
        DataError: a damaged block; no more memory than ``size`` is taken.
    """
    out = bytearray()
    at, end = 0, len(packed)
    try:
        while at < end:
            control = packed[at]
            at += 1
            if control < 32:
                length = control + 1
                if at + length > end:
                    raise IndexError
                out += packed[at : at + length]
                at += length
            else:
                length = (control >> 5) + 2
                if length == 9:
                    length += packed[at]
                    at += 1
                start = len(out) - ((control & 31) << 8) - packed[at] - 1
                at += 1
                if start < 0:
                    raise IndexError
                piece = out[start : start + length]
                # a repetition may overlap what it writes
                out += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
            if len(out) > size:
                raise IndexError
    except IndexError:
        raise DataError(path, f"a damaged LZF block at byte {at}", count_of(size, "unpacked byte")) from None
    if len(out) != size:
        raise DataError(path, count_of(len(out), "unpacked byte"), f"{size}")
    return bytes(out)
