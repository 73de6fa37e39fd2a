"""What a caller may hand to ``calibrate``: a source, several, or a slice of one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError, one_line
from sst_graph.factors.arguments import described
from sst_graph.files.checked_values import checked_text
from sst_graph.types import Source
from sst_graph.validation import checked_intrinsics

_MOST = 10_000
"""Most drives of one calibration."""


def as_sources(frames: Source | Sequence[Source]) -> list[Source]:
    """Sources in a list.

    Raises:
        DataError: neither a source nor a sequence of sources with at least one frame each, or too many.
    """
    sources: list[Any] = [frames]
    if not _is_source(frames):
        # What is endless is no sequence of drives, nor is an array without dimensions.
        several = isinstance(frames, Iterable) and not (isinstance(frames, np.ndarray) and frames.ndim == 0)
        sources = list(islice(frames, _MOST + 1)) if several else []
    if not sources or not all(_is_source(source) for source in sources):
        found = type(frames).__name__ if not sources else f"a sequence of {type(sources[0]).__name__}"
        raise DataError("frames to calibrate", found, "a source (open_source), a slice of one, or several")
    if len(sources) > _MOST:
        raise DataError("frames to calibrate", f"more than {_MOST} drives", "so many at most")
    for source in sources:
        _check_source(source)
    return sources


def _check_source(source: Any) -> None:
    """What any source says of itself: its name, which results are written with, its length and its camera.

    Raises:
        DataError: one of these is none.
    """
    name = source.name
    if not isinstance(name, str):
        raise DataError(f"a {type(source).__name__}: name", described(name), "text")
    checked_text(name, f"a {type(source).__name__}: name")
    try:
        count = len(source)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{name}: length", one_line(error), "a number of frames") from error
    if count == 0:
        raise DataError(name, "no frame", "one or more")
    checked_intrinsics(source.camera, f"{name}: camera")
    if not isinstance(source.nominal, gtsam.Pose3 | None):
        raise DataError(f"{name}: nominal", described(source.nominal), "a gtsam.Pose3, or None")


def _is_source(value: Any) -> bool:
    return all(hasattr(value, name) for name in ("camera", "nominal", "name", "__len__", "__getitem__"))
