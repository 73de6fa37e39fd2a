"""Size of a TIFF file by its first directory, and whether its pixels are all there.

Source: TIFF Revision 6.0 (Adobe, 1992). Pictures of 8 or 16 bits with up to four channels are read.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from sst_graph.errors import DataError, count_of

TIFF = (b"II*\0", b"MM\0*")

_WIDTH, _HEIGHT, _BITS, _CHANNELS = 256, 257, 258, 277
_STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES = 273, 279, 324, 325
_FORMATS = {3: ("H", 2), 4: ("I", 4)}
"""Of SHORT and LONG values."""
_MAX_VALUES = 1_000_000
"""Of one entry: strips or tiles of a picture."""


@dataclass(frozen=True)
class _Directory:
    """Entries of the first directory: values of SHORT and LONG ones by tag."""

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
            if kind not in _FORMATS or not 1 <= values <= _MAX_VALUES:
                continue
            code, size = _FORMATS[kind]
            place = at + 10 + 12 * k
            if values * size > 4:
                (place,) = struct.unpack_from(f"{order}I", data, place)
            entries[tag] = struct.unpack_from(f"{order}{values}{code}", data, place)
    except struct.error:
        raise DataError(path, f"a TIFF file truncated at byte {len(data)}", "its directory") from None
    return _Directory(path, entries)
