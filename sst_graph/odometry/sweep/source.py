"""A drive whose points are given the times that were decided for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from sst_graph.data.frame_parts import (
    AheadReader,
    scan_at,
    scan_positions,
)
from sst_graph.data.source_view import SourceView
from sst_graph.errors import ConfigError
from sst_graph.odometry.sweep.decision import CLAIMS, MAX_WINDOWS, SweepDecision, decide_sweep
from sst_graph.odometry.sweep.given_times import compared_with_times, turn_of
from sst_graph.sampling import evenly_spread
from sst_graph.sweep_timing import AT_ONCE, SweepStamp, SweepTiming
from sst_graph.types import Frame, Scan, Source
from sst_graph.validation import checked_position

SWEEP_KEY = "sweep"
"""Where a result's diagnostics keep what was decided of the sweeps, by name of the drive."""

_TIMED_SCANS = 3
"""Scans, spread over the drive, whose times tell the turn."""
_COMPARED_WINDOWS = 2
"""Parts of a drive that are registered to compare given times with."""


class SweptSource(SourceView):
    """A source whose scans carry times by azimuth (satisfies :class:`sst_graph.types.Source`).

    Scans that bring times of their own keep them.
    """

    def __init__(self, source: Source, decision: SweepDecision, ahead: AheadReader | None = None) -> None:
        """ahead: reader of the source that has read some scans already."""
        self.source, self.sweep_decision = source, decision
        self._ahead = AheadReader(source) if ahead is None else ahead

    def __getitem__(self, position: int) -> Frame:
        """Frame at a position; errors as :func:`~sst_graph.validation.checked_position`, and its own."""
        position = checked_position(position, len(self))
        frame = self._ahead.frame(position)
        return replace(frame, scan=self._timed(frame.scan))

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position."""
        return self._timed(scan_at(self.source, position))

    def _timed(self, scan: Scan | None) -> Scan | None:
        timing = self.sweep_decision.timing
        if scan is None or scan.offsets_s is not None or timing.instant:
            return scan
        return timed(scan, timing)


def timed(scan: Scan, timing: SweepTiming) -> Scan:
    """The scan with the times of its points."""
    return replace(scan, offsets_s=timing.offsets_s(scan.points))


def with_sweep(
    source: Source, decide: bool = True, progress: Callable[[str, int, int], None] | None = None
) -> SweptSource:
    """The source with times for its points, decided from its scans; scans read for that are not read again.

    Where its scans have times, nothing is decided, and the source stays as it is. So it does where it was
    opened with a given sweep (its attribute ``sweep`` is other than "auto"). What a spinning scanner's times,
    or a word of ``--sweep``, say of it is compared with the scans.

    Args:
        decide: False leaves scans without times as they are, and compares nothing.
        progress: called with (stage, steps done, steps in all) while it is decided.

    Raises:
        DataError: a frame cannot be read.
    """
    if isinstance(source, SweptSource):
        return source
    given, word = SweepDecision("given", AT_ONCE), getattr(source, "sweep", "auto")
    if not decide or word not in ("auto", *CLAIMS):
        return SweptSource(source, given)
    ahead = AheadReader(source)
    stamp: SweepStamp = getattr(source, "sweep_stamp", "forward")
    # Where frames have one sensor each, scans follow one another at positions that do not.
    positions = scan_positions(source)
    turn_s = None
    if word == "auto" and _has_times(ahead):
        some = [ahead.look(k) for k in evenly_spread(positions, _TIMED_SCANS)]
        turn_s = turn_of([scan for scan in some if scan is not None and len(scan.points)])
        if turn_s is None:
            return SweptSource(source, given, ahead)
    decision = decide_sweep(
        lambda k: _without_times(ahead.look(positions[k])),
        len(positions),
        stamp,
        MAX_WINDOWS if turn_s is None else _COMPARED_WINDOWS,
        None if progress is None else partial(progress, f"sweep of {source.name}"),
    )
    decision = replace(decision, frames=tuple(positions[k] for k in decision.frames))
    if turn_s is not None:
        decision = compared_with_times(decision, turn_s)
    elif word != "auto":
        decision = decision.given_as(word)
    return SweptSource(source, decision, ahead)


def _has_times(ahead: AheadReader) -> bool:
    """Whether the first scan with points has times of them; one without points has none either."""
    for position in range(len(ahead.source)):
        if (scan := ahead.look(position)) is not None and len(scan.points):
            return scan.offsets_s is not None
    return False


def _without_times(scan: Scan | None) -> Scan | None:
    return None if scan is None else replace(scan, offsets_s=None)


def with_sweep_of(source: Source, diagnostics: Mapping[str, Any]) -> SweptSource:
    """The source with the times in a result's diagnostics for a drive of its name; without any, as it is."""
    entry = diagnostics.get(SWEEP_KEY, {})
    entry = entry.get(source.name, {}) if isinstance(entry, Mapping) else {}
    given = getattr(source, "sweep", "auto") != "auto"
    try:
        timing = AT_ONCE if given else SweepTiming.from_dict(entry["timing"])
    except (KeyError, TypeError, ValueError, ConfigError):
        timing = AT_ONCE
    return SweptSource(source, SweepDecision("given", timing))
