"""Reading of numbered binary files: point clouds, labels, per-point times."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of, printable
from sst_graph.files.reading import FileKind, read_file
from sst_graph.validation import FARTHEST_M

_NEIGHBOURS, _FEWEST_NEIGHBOURS = 4096, 64
"""Points of a cloud by which its columns are found, and fewest of one whose columns are not taken as 4."""
_ALIKE, _CLEARLY = 0.5, 0.02
"""Median cosine between the azimuths of neighbours above which they are alike, and by how much more than
under a number tried before, of which it may be a multiple. On KITTI's clouds it is 1.00 under the right
number, at most 0.94 under another, and 0.8 where the points are shuffled."""
MAX_POINTS = 10_000_000
"""Points of a scan: a sweep of the densest spinning scanners has under one million. This many take 160 MB."""

SCAN = FileKind("a cloud of x y z intensity in float32", 16 * MAX_POINTS)
LABELS = FileKind("labels, one uint32 a point", 4 * MAX_POINTS)
POINT_TIMES = FileKind("times, one float32 a point", 4 * MAX_POINTS)


def listed(folder: Path, expected: str) -> list[Path]:
    """Entries of a folder, sorted.

    Raises:
        DataError: no folder, or one that cannot be listed.
    """
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(folder, "no folder", expected) from None
    except OSError as error:
        raise DataError(folder, f"an unreadable folder ({error.strerror})", expected) from None


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files of a folder by the number that their name is ("000012.bin" -> 12), sorted.

    Raises:
        DataError: no such folder or one that cannot be listed, no such file in it, or two files
            with one number.
    """
    expected = f"files 000000{suffixes[0]}, 000001{suffixes[0]}, ..."
    entries = listed(folder, expected)
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


def optional_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """As :func:`numbered_files`, of a folder that need not be there."""
    return numbered_files(folder, suffixes) if folder.is_dir() else {}


def check_stamped(times: Path, stamps: int, files: Mapping[int, Path], what: str) -> None:
    """Require a stamp of each file's number.

    Args:
        stamps: how many there are; the first one is of number 0.
        files: by their numbers.
        what: they hold, in the plural.

    Raises:
        DataError: some have none.
    """
    without = [files[k].stem for k in sorted(files) if k >= stamps]
    if without:
        which = without[0] if len(without) == 1 else f"{len(without)} {what}, {without[0]} to {without[-1]}"
        found = f"{count_of(stamps, 'stamp')} for {len(files)} {what}"
        raise DataError(times, found, f"{max(files) + 1}, one for each number from 0: none for {which}")


def read_points(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Points (n, 3) float32 [m] and reflectances (n,), if any, of a KITTI cloud: :func:`float_columns`.

    Beams without a return (:func:`are_returns`) are left in: they have labels.

    Raises:
        DataError: a missing or truncated file, one of more than MAX_POINTS points, or a coordinate that is
            no length.
    """
    values = float_columns(read_file(path, SCAN), path)
    points = np.ascontiguousarray(values[:, :3])
    check_metres(points, path)
    has_intensity = values.shape[1] > 3
    return points, np.ascontiguousarray(values[:, 3]) if has_intensity else None


def float_columns(data: bytes, path: Path) -> NDArray[np.float32]:
    """(n, k) float32 little-endian, one row a point: x y z intensity, as KITTI has them, or x y z alone, or
    with one or two more behind (nuScenes: ring).

    Such a file does not say how many values a point has. A scanner turns, so azimuths of neighbouring points
    are alike under the right number, and anything under another.

    Raises:
        DataError: a truncated file.
    """
    values = np.frombuffer(data, "<f4", len(data) // 4)
    columns = _columns_of(values)
    return _values(data, path, "<f4", columns, "x y z intensity in float32").reshape(-1, columns)


def _columns_of(values: NDArray[np.float32]) -> int:
    """Values a point, by the median cosine between the azimuths of neighbours; 4 where none stands out."""
    best, most = 4, _ALIKE
    for columns in (4, 3, 5, 6):
        if len(values) % columns or len(values) < _FEWEST_NEIGHBOURS * columns:
            continue
        x, y = values[: _NEIGHBOURS * columns].reshape(-1, columns)[:, :2].astype(np.float64).T
        with np.errstate(invalid="ignore"):
            alike = np.cos(np.diff(np.arctan2(y, x)))
        alike = alike[np.isfinite(alike)]
        if len(alike) and (found := float(np.median(alike))) > most + _CLEARLY:
            best, most = columns, found
    return best


def are_returns(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points (n, 3) are returns (n,): drivers give NaN, inf or the origin for beams without one."""
    return np.asarray(np.isfinite(points).all(axis=1) & (points != 0.0).any(axis=1))


def check_metres(points: NDArray[np.float32], path: Path) -> None:
    """Require coordinates (n, 3) that are lengths, in whatever unit, but for NaN and inf.

    Raises:
        DataError: one beyond FARTHEST_M.
    """
    lengths = np.abs(np.where(np.isfinite(points), points, 0.0))
    if len(points) and float(lengths.max()) > FARTHEST_M:
        k = int(np.argmax(lengths.max(axis=1)))
        found = f"a coordinate of {float(lengths[k].max()):.3g} m at index {k}"
        raise DataError(path, found, f"metres in float32, at most {FARTHEST_M:g}")


def read_labels(path: Path, count: int, cloud: Path | None = None) -> NDArray[np.uint32]:
    """Labels (n,) uint32 of a SemanticKITTI file for ``count`` points.

    Args:
        cloud: file of the points, which is named where it has none.

    Raises:
        DataError: a missing or truncated file, or another number of labels than points.
    """
    labels = _values(read_file(path, LABELS), path, "<u4", 1, "one uint32 a point")
    if cloud is not None and count == 0 and len(labels):
        raise DataError(cloud, "no point", f"{len(labels)}, as many as {printable(path)} has labels")
    _check_count(path, len(labels), count, "labels")
    return labels


def read_offsets(path: Path, used: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Per-point times (n,) float32 [s], relative to the scan's stamp.

    Args:
        used: (n,) False for points that are left out, whose times may be anything.

    Raises:
        DataError: a missing or truncated file, another number of times than points, a time that
            is not finite or lies more than a second from the stamp.
    """
    offsets = _values(read_file(path, POINT_TIMES), path, "<f4", 1, "one float32 a point")
    _check_count(path, len(offsets), len(used), "times")
    bad = np.flatnonzero(used & ~(np.abs(offsets) <= 1.0))
    if len(bad):
        times = count_of(len(bad), "time that is", "times that are")
        found = f"{times} NaN or beyond 1 s, first at index {bad[0]}"
        raise DataError(path, found, "seconds relative to the scan's stamp")
    return offsets


def _values(data: bytes, path: Path, dtype: str, columns: int, expected: str) -> NDArray[Any]:
    size = np.dtype(dtype).itemsize * columns
    if len(data) % size:
        raise DataError(path, count_of(len(data), "byte"), f"a multiple of {size} ({expected})")
    return np.frombuffer(data, dtype)


def _check_count(path: Path, found: int, points: int, what: str) -> None:
    if found != points:
        raise DataError(path, f"{found} {what}", f"{points}, one a point of the scan")
