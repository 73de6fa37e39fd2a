"""Which images belong to which scan, by true time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.types import FloatArray, IntArray


@dataclass(frozen=True)
class Pair:
    """Scan ``scan`` and image ``image`` (positions in their sequences).

    Attributes:
        base_tau_s: image stamp minus scan stamp [s]; the interval is offset + base_tau_s.
    """

    scan: int
    image: int
    base_tau_s: float


def pair_by_time(
    scan_stamps_ns: Sequence[int], image_stamps_ns: Sequence[int], time_offset_s: float, max_interval_s: float
) -> list[Pair]:
    """Each scan with the image closest to it in true time, under a time offset (sign: :mod:`factors`).

    Args:
        scan_stamps_ns, image_stamps_ns: rising stamps of either clock [ns].
        max_interval_s: pairs farther apart in true time are left out [s].
    """
    images, base_taus_s = nearest_images(
        scan_stamps_ns, image_stamps_ns, np.array([time_offset_s]), max_interval_s
    )
    return [
        Pair(scan, int(images[0, scan]), float(base_taus_s[0, scan]))
        for scan in np.flatnonzero(images[0] >= 0).tolist()
    ]


def pair_every_image(
    scan_stamps_ns: Sequence[int], image_stamps_ns: Sequence[int], time_offset_s: float, max_interval_s: float
) -> list[Pair]:
    """Each image with the scan closest to it in true time; arguments as of :func:`pair_by_time`."""
    away_s = np.array([-time_offset_s])
    scans, base_taus_s = nearest_images(image_stamps_ns, scan_stamps_ns, away_s, max_interval_s)
    return [
        Pair(int(scans[0, image]), image, -float(base_taus_s[0, image]))
        for image in np.flatnonzero(scans[0] >= 0).tolist()
    ]


def nearest_images(
    scan_stamps_ns: Sequence[int],
    image_stamps_ns: Sequence[int],
    offsets_s: FloatArray,
    max_interval_s: float,
) -> tuple[IntArray, FloatArray]:
    """:func:`pair_by_time` under several time offsets at once.

    Args:
        offsets_s: (m,).

    Returns:
        Position of each scan's image, (m, scans), -1 where none is near; and the image's stamp minus the
        scan's (m, scans) [s].
    """
    shape = (len(offsets_s), len(scan_stamps_ns))
    if not len(scan_stamps_ns) or not len(image_stamps_ns):
        return np.full(shape, -1, np.intp), np.zeros(shape)
    epoch = int(scan_stamps_ns[0])
    scans = (np.asarray(scan_stamps_ns, dtype=np.int64) - epoch) * 1e-9
    base = (np.asarray(image_stamps_ns, dtype=np.int64) - epoch) * 1e-9
    away = offsets_s[:, None]
    last = len(base) - 1
    right = np.minimum(np.maximum(np.searchsorted(base, scans - away), 1), max(1, last))
    left, right = right - 1, np.minimum(right, last)
    early, late = (np.abs(base[side] + away - scans) for side in (left, right))
    nearest = np.where(early <= late, left, right)
    close = np.minimum(early, late) <= max_interval_s
    return np.where(close, nearest, -1), base[nearest] - scans
