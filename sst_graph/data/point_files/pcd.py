"""PCD files of the Point Cloud Library, version 0.7: ascii, binary, binary_compressed.

Source: the format's description in PCL's documentation (pcd_file_format). A compressed block holds two
uint32, its own and its unpacked size, and the fields one after the other in LZF.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.point_files.cloud import (
    CLOUD_FILE,
    MAX_POINT_BYTES,
    PointFields,
    check_count,
    cloud_of,
    structured_fields,
    text_records,
)
from sst_graph.errors import DataError, count_of
from sst_graph.files.reading import MAX_DIGITS

_MAX_HEADER = 64 * 1024
_TYPES = {
    (kind, size): np.dtype(f"<{kind.lower()}{size}")
    for kind, sizes in (("F", (4, 8)), ("I", (1, 2, 4, 8)), ("U", (1, 2, 4, 8)))
    for size in sizes
}


@dataclass(frozen=True)
class PcdHeader:
    """What the header of a PCD file declares.

    Attributes:
        dtype: of a point's record; fields of several values are (count,) arrays.
        count: number of points.
        data: ascii, binary or binary_compressed.
        end: where the points begin [bytes].
    """

    dtype: np.dtype[Any]
    count: int
    data: str
    end: int


def read_pcd(data: bytes, path: Path) -> PointFields:
    """Points of a PCD file.

    Raises:
        DataError: no such header, another number of points than it declares, damaged compression.
    """
    header = _header(data, path)
    body = data[header.end :]
    if header.data == "ascii":
        records = text_records(body, header.dtype, header.count, path)
    elif header.data == "binary":
        records = _binary(body, header, path)
    else:
        records = _compressed(body, header, path)
    return cloud_of(path, structured_fields(records))


def _whole_numbers(name: str, words: list[str], path: Path) -> list[int]:
    """One or more, of a line of the header."""
    if not words or not all(word.isdecimal() and len(word) <= MAX_DIGITS for word in words):
        raise DataError(path, f"{name} {' '.join(words):.40}", "whole numbers in this line of the header")
    return [int(word) for word in words]


def _header(data: bytes, path: Path) -> PcdHeader:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = data.find(b"\n", at, _MAX_HEADER)
        if end < 0:
            raise DataError(path, "no line DATA", "a PCD header of version 0.7")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        names = entries["FIELDS"]
        sizes, kinds = _whole_numbers("SIZE", entries["SIZE"], path), entries["TYPE"]
        counts = _whole_numbers("COUNT", entries.get("COUNT", ["1"] * len(names)), path)
        totals = ("POINTS",) if "POINTS" in entries else ("WIDTH", "HEIGHT")
        count = prod(_whole_numbers(name, entries[name], path)[0] for name in totals)
        kind = " ".join(entries["DATA"])
    except KeyError as error:
        raise DataError(path, f"a header without {error}"[:80], "a PCD header of version 0.7") from None
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise DataError(path, f"DATA {kind:.40}", "ascii, binary or binary_compressed")
    check_count(path, count)
    return PcdHeader(_dtype(names, kinds, sizes, counts, path), count, kind, at)


def _dtype(
    names: list[str], kinds: list[str], sizes: list[int], counts: list[int], path: Path
) -> np.dtype[Any]:
    if not names or not len(names) == len(kinds) == len(sizes) == len(counts):
        found = f"{len(names)} FIELDS, {len(kinds)} TYPE, {len(sizes)} SIZE, {len(counts)} COUNT"
        raise DataError(path, found, "as many of each")
    fields: list[tuple[Any, ...]] = []
    for k, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True)):
        if (kind, size) not in _TYPES or not 1 <= count <= MAX_POINT_BYTES:
            found = f"field {name:.40} of type {kind:.10}, {size} bytes, count {count}"
            raise DataError(path, found, "F of 4 or 8 bytes, I or U of 1, 2, 4 or 8")
        # PCL pads with fields named _ that may come several times
        unique = f"_{k}" if name == "_" else name
        fields.append((unique, _TYPES[kind, size]) if count == 1 else (unique, _TYPES[kind, size], (count,)))
    try:
        dtype = np.dtype(fields)
    except ValueError:
        raise DataError(path, f"fields {' '.join(names)}"[:200], "fields of different names") from None
    if dtype.itemsize > MAX_POINT_BYTES:
        raise DataError(path, f"{count_of(dtype.itemsize, 'byte')} a point", f"at most {MAX_POINT_BYTES}")
    return dtype


def _binary(body: bytes, header: PcdHeader, path: Path) -> NDArray[Any]:
    size = header.count * header.dtype.itemsize
    if len(body) < size:
        raise DataError(
            path, f"{count_of(len(body), 'byte')} of points", f"{size} for {count_of(header.count, 'point')}"
        )
    return np.frombuffer(body, header.dtype, header.count)


def _compressed(body: bytes, header: PcdHeader, path: Path) -> NDArray[Any]:
    """Records of fields that stand one after the other, packed."""
    if len(body) < 8:
        raise DataError(path, f"{count_of(len(body), 'byte')} of points", "the sizes of a compressed block")
    packed, size = struct.unpack_from("<II", body)
    if size != header.count * header.dtype.itemsize:
        expected = f"{header.count * header.dtype.itemsize} for {count_of(header.count, 'point')}"
        raise DataError(path, f"{count_of(size, 'unpacked byte')} declared", expected)
    if size > CLOUD_FILE.max_bytes:
        raise DataError(
            path, f"{count_of(size, 'unpacked byte')} declared", f"at most {CLOUD_FILE.max_bytes}"
        )
    if len(body) - 8 < packed:
        raise DataError(path, count_of(len(body) - 8, "compressed byte"), f"{packed}")
    columns = unpack_lzf(body[8 : 8 + packed], size, path)
    records = np.zeros(header.count, header.dtype)
    at = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        end = at + header.count * field.itemsize
        records[name] = np.frombuffer(columns[at:end], field.base).reshape(header.count, *field.shape)
        at = end
    return records


def unpack_lzf(packed: bytes, size: int, path: Path) -> bytes:
    """The ``size`` bytes that were packed by LZF (Marc Lehmann's liblzf).

    A control byte c < 32 is followed by c + 1 bytes as they are. Else bytes are repeated: c >> 5 (7: plus the
    next byte) + 2 of them, from ((c & 31) << 8 | next byte) + 1 before the end of what was unpacked.

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
