"""A drive whose points are given the times that were decided for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import gtsam

from factors.camera import PinholeCamera
from sst_graph.errors import ConfigError
from sst_graph.odometry.sweep.decision import SweepConfig, SweepDecision, decide_sweep
from sst_graph.sweep_timing import SweepStamp, SweepTiming
from sst_graph.types import Frame, GroundTruth, Scan, Source

SWEEP_KEY = "sweep"
"""Where a result's diagnostics keep what was decided of the sweeps, by name of the drive."""


class SweptSource:
    """A source whose scans carry times by azimuth (satisfies :class:`sst_graph.types.Source`).

    Scans that bring times of their own keep them.
    """

    def __init__(
        self, source: Source, decision: SweepDecision, frames: dict[int, Frame] | None = None
    ) -> None:
        """frames: read already, by position; each is let go when it is next asked for."""
        self.source, self.sweep_decision = source, decision
        self._read = {} if frames is None else frames

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.source.name

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics."""
        return self.source.camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        """Nominal cTl of the data."""
        return self.source.nominal

    @property
    def truth(self) -> GroundTruth | None:
        """Truth, where the data bring it."""
        return self.source.truth

    @property
    def truth_is_reference(self) -> bool:
        """Whether it is a reference only."""
        return bool(getattr(self.source, "truth_is_reference", False))

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, position: int) -> Frame:
        """Frame at a position; IndexError as the source's own."""
        frame = self._read.pop(position, None)
        frame = self.source[position] if frame is None else frame
        timing = self.sweep_decision.timing
        if frame.scan is None or frame.scan.offsets_s is not None or timing.instant:
            return frame
        return replace(frame, scan=timed(frame.scan, timing))

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))


_KEPT = 24
"""Most frames that are kept from the decision until they are asked for again."""


def timed(scan: Scan, timing: SweepTiming) -> Scan:
    """The scan with the times of its points."""
    return replace(scan, offsets_s=timing.offsets_s(scan.points))


def with_sweep(source: Source, config: SweepConfig | None = None) -> SweptSource:
    """The source with times for its points, as its scans tell them; few frames are read twice for that.

    Nothing is decided, and the source stays as it is, where its scans bring times, or where it was opened
    with a word on its sweep (its attribute ``sweep`` is other than "auto").

    Raises:
        DataError: a frame cannot be read.
    """
    if isinstance(source, SweptSource):
        return source
    config = config or SweepConfig()
    given = SweepDecision("given", SweepTiming(0.0, 0.0, 0.1))
    if not config.decide or getattr(source, "sweep", "auto") != "auto":
        return SweptSource(source, given)
    read: dict[int, Frame] = {}

    def frame(position: int) -> Frame:
        if position not in read:
            if len(read) >= _KEPT:
                read.pop(next(iter(read)))
            read[position] = source[position]
        return read[position]

    for position in range(len(source)):
        if (scan := frame(position).scan) is not None:
            if scan.offsets_s is not None:
                return SweptSource(source, given, read)
            break
    stamp: SweepStamp = getattr(source, "sweep_stamp", "forward")
    return SweptSource(source, decide_sweep(lambda k: frame(k).scan, len(source), config, stamp), read)


def with_sweep_of(source: Source, diagnostics: Mapping[str, Any]) -> SweptSource:
    """The source with the times that a result's diagnostics tell of the drive of its name; else as it is."""
    entry = diagnostics.get(SWEEP_KEY, {})
    entry = entry.get(source.name, {}) if isinstance(entry, Mapping) else {}
    given = getattr(source, "sweep", "auto") != "auto"
    try:
        timing = SweepTiming(0.0, 0.0, 0.1) if given else SweepTiming.from_dict(entry["timing"])
    except (KeyError, TypeError, ValueError, ConfigError):
        timing = SweepTiming(0.0, 0.0, 0.1)
    return SweptSource(source, SweepDecision("given", timing))
