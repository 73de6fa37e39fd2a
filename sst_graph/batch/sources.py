"""What a caller may hand to ``calibrate``: a source, several, or a slice of one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any

from sst_graph.errors import DataError
from sst_graph.factors.arguments import is_several
from sst_graph.types import Source
from sst_graph.validation import checked_source, is_source

_MOST = 10_000
"""Most drives of one calibration."""


def as_sources(frames: Source | Sequence[Source]) -> list[Source]:
    """Sources in a list.

    Raises:
        DataError: neither a source nor a sequence of sources with at least one frame each, or too many.
    """
    sources: list[Any] = [frames]
    if not is_source(frames):
        # What is endless is no sequence of drives, nor is an array without dimensions.
        sources = list(islice(frames, _MOST + 1)) if is_several(frames) else []
    if not sources or not all(is_source(source) for source in sources):
        found = type(frames).__name__ if not sources else f"a sequence of {type(sources[0]).__name__}"
        raise DataError("frames to calibrate", found, "a source (open_source), a slice of one, or several")
    if len(sources) > _MOST:
        raise DataError("frames to calibrate", f"more than {_MOST} drives", "so many at most")
    for source in sources:
        checked_source(source)
    return sources
