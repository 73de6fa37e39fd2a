"""Which image belongs to which scan, by true time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


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
    scan_stamps_ns: Sequence[int], image_stamps_ns: Sequence[int], offset_s: float, max_interval_s: float
) -> list[Pair]:
    """Each scan with the image closest to it in true time, under a time offset (sign: :mod:`factors`).

    Args:
        scan_stamps_ns, image_stamps_ns: rising stamps of either clock [ns].
        max_interval_s: pairs farther apart in true time are left out [s].
    """
    if not len(scan_stamps_ns) or not len(image_stamps_ns):
        return []
    epoch = int(scan_stamps_ns[0])
    scans = (np.asarray(scan_stamps_ns, dtype=np.int64) - epoch) * 1e-9
    base = (np.asarray(image_stamps_ns, dtype=np.int64) - epoch) * 1e-9
    images = base + offset_s
    right = np.clip(np.searchsorted(images, scans), 1, max(1, len(images) - 1))
    left = right - 1
    right = np.minimum(right, len(images) - 1)
    nearest = np.where(np.abs(images[left] - scans) <= np.abs(images[right] - scans), left, right)
    close = np.flatnonzero(np.abs(images[nearest] - scans) <= max_interval_s)
    return [Pair(int(k), int(nearest[k]), float(base[nearest[k]] - scans[k])) for k in close]
