"""Reading of numbered binary files: point clouds, labels, per-point times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError

MAX_COORDINATE_M = 10_000.0
"""Coordinates beyond this [m] mean that the file holds something else than metres in float32."""


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files of a folder by the number that their name is ("000012.bin" -> 12), sorted.

    Raises:
        DataError: no such folder or one that cannot be listed, no such file in it, or two files
            with one number.
    """
    expected = f"files 000000{suffixes[0]}, 000001{suffixes[0]}, ..."
    if not folder.is_dir():
        raise DataError(folder, "no folder", expected)
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise DataError(folder, f"an unreadable folder ({error.strerror})", expected) from None
    files: dict[int, Path] = {}
    for path in entries:
        if path.suffix.lower() not in suffixes or not path.stem.isdecimal():
            continue
        if int(path.stem) in files:
            raise DataError(path, f"a second file of number {int(path.stem)}", "one")
        files[int(path.stem)] = path
    if not files:
        raise DataError(folder, "no file that is named by its number", expected)
    return dict(sorted(files.items()))


def read_bytes(path: Path) -> bytes:
    """Contents of a file.

    Raises:
        DataError: it is missing or cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DataError(path, "no file", "a file") from None
    except OSError as error:
        raise DataError(path, f"an unreadable file ({error.strerror})", "a readable file") from None


def read_points(path: Path) -> NDArray[np.float32]:
    """Points (n, 3) float32 [m] of a KITTI cloud: x y z reflectance, float32 little-endian.

    Raises:
        DataError: a missing or truncated file, NaN or inf in a coordinate, or one that is no length.
    """
    values = _values(read_bytes(path), path, "<f4", 4, "x y z r in float32")
    points = np.ascontiguousarray(values.reshape(-1, 4)[:, :3])
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = np.flatnonzero(~finite)
        raise DataError(path, f"{len(bad)} points with NaN or inf, first at index {bad[0]}", "finite points")
    if len(points) and float(np.abs(points).max()) > MAX_COORDINATE_M:
        k = int(np.argmax(np.abs(points).max(axis=1)))
        found = f"a coordinate of {float(np.abs(points[k]).max()):.3g} m at index {k}"
        raise DataError(path, found, f"metres in float32, at most {MAX_COORDINATE_M:g}")
    return points


def read_labels(path: Path, count: int) -> NDArray[np.uint32]:
    """Labels (n,) uint32 of a SemanticKITTI file for ``count`` points.

    Raises:
        DataError: a missing or truncated file, or another number of labels than points.
    """
    labels = _values(read_bytes(path), path, "<u4", 1, "one uint32 a point")
    _check_count(path, len(labels), count, "labels")
    return labels


def read_offsets(path: Path, count: int) -> NDArray[np.float32]:
    """Per-point times (n,) float32 [s], relative to the scan's stamp, for ``count`` points.

    Raises:
        DataError: a missing or truncated file, another number of times than points, a time that
            is not finite or lies more than a second from the stamp.
    """
    offsets = _values(read_bytes(path), path, "<f4", 1, "one float32 a point")
    _check_count(path, len(offsets), count, "times")
    bad = np.flatnonzero(~(np.abs(offsets) <= 1.0))
    if len(bad):
        found = f"{len(bad)} times that are NaN or beyond 1 s, first at index {bad[0]}"
        raise DataError(path, found, "seconds relative to the scan's stamp")
    return offsets


def _values(data: bytes, path: Path, dtype: str, columns: int, expected: str) -> NDArray[Any]:
    size = np.dtype(dtype).itemsize * columns
    if len(data) % size:
        raise DataError(path, f"{len(data)} bytes", f"a multiple of {size} ({expected})")
    return np.frombuffer(data, dtype)


def _check_count(path: Path, found: int, points: int, what: str) -> None:
    if found != points:
        raise DataError(path, f"{found} {what}", f"{points}, one a point of the scan")
