"""Labels that methods of calibration cannot do without."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from sst_graph.data.frame_parts import image_at, image_positions, scan_at, scan_positions
from sst_graph.errors import DataError
from sst_graph.sampling import evenly_spread
from sst_graph.types import CameraImage, Scan, Source

METHODS_BY_LABELS = ("joint", "paper", "static", "semalign")
"""Methods that align nothing without labels of both sensors."""
_FIRST = 8
"""Scans, or images, that are looked at before all others."""


def require_labels(cameras: Sequence[Sequence[Source]], method: str) -> None:
    """Require labels on each side of one camera at least, for a method that aligns nothing else; those by
    networks are made later.

    Args:
        cameras: drives of each.

    Raises:
        DataError: no scan of any drive has labels, or no image, for every camera; or a frame that cannot be
            read.
    """
    found = []
    for sources in cameras:
        found.append(missing_labels(sources, method))
        if not found[-1]:
            return
    raise DataError(
        ", ".join(source.name for source in cameras[0]),
        f"no {' and no '.join(found[0])}",
        f"both for method {method}: say where they are, make them by networks, or take --method edges",
    )


def missing_labels(sources: Sequence[Source], method: str) -> list[str]:
    """What labels a method needs and no drive has, in words.

    Raises:
        DataError: a frame that cannot be read.
    """
    if method not in METHODS_BY_LABELS or any(getattr(one, "labelling", None) is not None for one in sources):
        return []
    missing = []
    if not any(_any_labels(scan_positions(one), partial(scan_at, one)) for one in sources):
        missing.append("labels of points")
    if not any(_any_labels(image_positions(one), partial(image_at, one)) for one in sources):
        missing.append("semantic masks of images")
    return missing


def _any_labels(positions: Sequence[int], read: Callable[[int], Scan | CameraImage | None]) -> bool:
    """Whether a scan or image has labels; some that are spread over the drive are looked at first."""
    order = dict.fromkeys((*evenly_spread(positions, _FIRST), *positions))
    measured = (read(position) for position in order)
    return any(one is not None and _has_labels(one) for one in measured)


def _has_labels(one: Scan | CameraImage) -> bool:
    return one.has_labels if isinstance(one, Scan) else one.has_mask
