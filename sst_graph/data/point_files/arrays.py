"""Clouds in files of plain arrays: KITTI's .bin, NumPy's .npy and .npz.

A .npy is a structured array with fields x, y, z, ..., or an array (n, 3) of x y z, which intensity and more
may follow; an organized cloud has rows and columns in the place of n. A .npz has one array a field, or such
an array, the only one of two or three dimensions or named ``points``, beside fields of their own; single
values are left out. Nothing is unpickled.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import MAX_POINTS, float_columns
from sst_graph.data.point_files.cloud import (
    MAX_POINT_BYTES,
    PointFields,
    check_count,
    cloud_of,
    structured_fields,
)
from sst_graph.errors import DataError, count_of, first_line
from sst_graph.files.reading import MAX_DIGITS

_MAX_BYTES = 512 * 1024 * 1024
"""Of one array, unpacked."""
_MAX_HEADER = 10_000
_COLUMNS = ("x", "y", "z", "intensity")
_MAX_COLUMNS = 16
"""Most values a point of an array without names; of more, rows are taken for columns."""
_BROKEN = (
    ValueError,
    EOFError,
    OSError,
    KeyError,
    TypeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_bin(data: bytes, path: Path) -> PointFields:
    """As :func:`~sst_graph.data.arrays.float_columns`; what is behind the intensity is left out, for nothing
    says what it is.

    Raises:
        DataError: a truncated file.
    """
    values = float_columns(data, path)
    return cloud_of(path, {name: values[:, k] for k, name in enumerate(_COLUMNS[: values.shape[1]])})


def read_npy(data: bytes, path: Path) -> PointFields:
    """One array.

    Raises:
        DataError: no such array.
    """
    return cloud_of(path, _fields(_array(data, path), path))


def read_npz(data: bytes, path: Path) -> PointFields:
    """Arrays by name.

    Raises:
        DataError: no such arrays, or more of them than a cloud has.
    """
    fields: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            # by the directory, before a byte is unpacked
            unpacked = sum(member.file_size for member in members)
            if len(members) > 64 or unpacked > _MAX_BYTES:
                found = f"{count_of(len(members), 'array')} of {count_of(unpacked, 'byte')}"
                raise DataError(path, found, f"at most 64 of {_MAX_BYTES} bytes")
            arrays = {}
            for member in members:
                with archive.open(member) as stream:
                    content = stream.read(member.file_size + 1)
                if (array := _array(content, path)).ndim:
                    arrays[member.filename.removesuffix(".npy")] = array
    except (*_BROKEN, RuntimeError) as error:
        raise DataError(path, f"no .npz file ({first_line(error)})", "arrays that NumPy wrote") from None
    tables = [name for name, array in arrays.items() if array.ndim > 1]
    alone = len(tables) == 1 and "x" not in {name.lower() for name in arrays}
    for name, array in arrays.items():
        is_table = name == "points" or (alone and name in tables)
        fields.update(_fields(array, path) if is_table else {name: array})
    return cloud_of(path, fields)


def _array(data: bytes, path: Path) -> NDArray[Any]:
    """The array of a .npy file, its size compared with the file's before memory is taken."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version}")
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read_header(stream, max_header_size=_MAX_HEADER)
        if any(abs(length) >= 10**MAX_DIGITS for length in shape):
            raise ValueError(f"a length of more than {MAX_DIGITS} digits")
    except (*_BROKEN, RecursionError, MemoryError) as error:
        raise DataError(path, f"no .npy file ({first_line(error)})", "an array that NumPy wrote") from None
    if (
        dtype.subdtype is not None
        or dtype.hasobject
        or dtype.itemsize == 0
        or dtype.itemsize > MAX_POINT_BYTES
        or len(shape) > 3
    ):
        raise DataError(path, f"an array of {dtype}, shape {shape}", "numbers or structured records")
    count = 1
    for length in shape:
        count *= int(length)
    rest = len(data) - stream.tell()
    if (
        min(shape, default=0) < 0
        or math.prod(shape[:-1] or shape) > MAX_POINTS
        or count * dtype.itemsize != rest
    ):
        raise DataError(
            path, f"{count_of(rest, 'byte')} behind the header", f"those of an array of shape {shape}"
        )
    array = np.frombuffer(data, dtype, count, stream.tell())
    return array.reshape(shape, order="F" if fortran else "C")


def _fields(array: NDArray[Any], path: Path) -> dict[str, NDArray[Any]]:
    if array.dtype.names is not None:
        array = array.reshape(-1)
        check_count(path, len(array))
        return structured_fields(array)
    if array.ndim < 2 or not 3 <= array.shape[-1] <= _MAX_COLUMNS:
        expected = f"(n, 3) to (n, {_MAX_COLUMNS}), or records with x, y, z"
        raise DataError(path, f"an array of shape {array.shape}", expected)
    table = array.reshape(-1, array.shape[-1])
    check_count(path, len(table))
    # Nothing says what is behind the intensity.
    return {name: table[:, k] for k, name in enumerate(_COLUMNS[: table.shape[1]])}
