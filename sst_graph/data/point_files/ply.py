"""PLY files, version 1.0: ascii, binary_little_endian, binary_big_endian.

Source: G. Turk, The PLY Polygon File Format (1994). The points are the element ``vertex``. What stands behind
it (faces) is not read; elements with lists before it are refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.point_files.cloud import (
    MAX_POINT_BYTES,
    PointFields,
    check_count,
    cloud_of,
    structured_fields,
    text_records,
)
from sst_graph.errors import DataError, count_of

_MAX_HEADER = 64 * 1024
_EXPECTED = "a PLY header of version 1.0"
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """One kind of element, and its properties: (name, type), the type None for a list."""

    name: str
    count: int
    properties: list[tuple[str, str | None]] = field(default_factory=list)


def read_ply(data: bytes, path: Path) -> PointFields:
    """Points of a PLY file.

    Raises:
        DataError: no such header, fewer points than it declares, lists in or before the points.
    """
    encoding, elements, at = _header(data, path)
    for element in elements:
        dtype = _dtype(element, _ORDERS[encoding], path)
        check_count(path, element.count)
        if element.name == "vertex":
            records = _records(data[at:], encoding, dtype, element.count, path)
            return cloud_of(path, structured_fields(records))
        at = _behind(data, at, encoding, dtype.itemsize, element, path)
    raise DataError(path, "no element vertex", "points in x, y, z")


def _records(body: bytes, encoding: str, dtype: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    if encoding == "ascii":
        return text_records(body, dtype, count, path)
    if len(body) < count * dtype.itemsize:
        raise DataError(
            path,
            f"{count_of(len(body), 'byte')} of points",
            f"{count * dtype.itemsize} for {count_of(count, 'point')}",
        )
    return np.frombuffer(body, dtype, count)


def _behind(data: bytes, at: int, encoding: str, size: int, element: _Element, path: Path) -> int:
    """Where the element ends that begins at ``at``."""
    if encoding != "ascii":
        return at + element.count * size
    for _ in range(element.count):
        at = data.find(b"\n", at) + 1
        if at == 0:
            raise DataError(
                path, f"fewer than {count_of(element.count, 'line')} of {element.name}", "all of them"
            )
    return at


def _header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    """Encoding, elements, and where the first of them begins."""
    head = data[:_MAX_HEADER]
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise DataError(path, f"first bytes {data[:8]!r} and no end_header", _EXPECTED)
    encoding, elements = "", list[_Element]()
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", name, "1.0"] if name in _ORDERS:
                encoding = name
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(_Element(name, int(count)))
            case ["property", "list", *_] if elements:
                elements[-1].properties.append(("", None))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise DataError(path, f"a line {line!r:.60} in the header", _EXPECTED)
    if not encoding:
        raise DataError(path, "no line format", _EXPECTED)
    return encoding, elements, newline + 1


def _dtype(element: _Element, order: str, path: Path) -> np.dtype[Any]:
    if any(kind is None for _, kind in element.properties):
        raise DataError(path, f"a list in {element.name:.40}", "numbers in the points and before them")
    try:
        dtype = np.dtype([(name, f"{order}{kind}") for name, kind in element.properties])
    except ValueError:
        raise DataError(path, f"a property of {element.name:.40} twice", "different names") from None
    if not 0 < dtype.itemsize <= MAX_POINT_BYTES:
        raise DataError(
            path, f"{count_of(dtype.itemsize, 'byte')} for {element.name:.40}", f"1 to {MAX_POINT_BYTES}"
        )
    return dtype
