"""Scans and images of a drive, read separately where its source supports it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Protocol, runtime_checkable

from sst_graph.types import CameraImage, Frame, Scan, Source, intensities_of, with_intensities
from sst_graph.validation import checked_frame, checked_image, checked_scan


@runtime_checkable
class SeparateReader(Protocol):
    """Optional methods of a source that read scans and images separately. Positions, and errors, are those of
    its frames."""

    def frame_number(self, position: int) -> int:
        """Index of the frame; nothing is read."""
        ...

    def read_scan(self, position: int) -> Scan | None:
        """The frame's scan."""
        ...

    def read_image(self, position: int) -> CameraImage | None:
        """The frame's image; instances may be left out."""
        ...


def number_at(source: Source, position: int) -> int:
    """Index of the frame at a position."""
    if isinstance(source, SeparateReader):
        return source.frame_number(position)
    return frame_at(source, position).index


def scan_at(source: Source, position: int) -> Scan | None:
    """Scan of the frame at a position."""
    if isinstance(source, SeparateReader):
        return source.read_scan(position)
    return frame_at(source, position).scan


def image_at(source: Source, position: int) -> CameraImage | None:
    """Image of the frame at a position."""
    if isinstance(source, SeparateReader):
        return source.read_image(position)
    return frame_at(source, position).image


def frame_at(source: Source, position: int) -> Frame:
    """Frame at a position; of a source that was made by hand, with checked parts.

    Raises:
        DataError: a part that cannot be used.
    """
    if isinstance(source, SeparateReader):
        return source[position]
    place = f"{source.name}, frame at position {position}"
    frame = checked_frame(source[position], place)
    scan, image = frame.scan, frame.image
    if scan is not None:
        scan = with_intensities(checked_scan(scan, place, fewest=0), intensities_of(scan))
    return Frame(frame.index, scan, None if image is None else checked_image(image, source.camera, place))


@dataclass(frozen=True, eq=False)
class NumberedFrames:
    """Scans and images of a source that was read before, read again by the number of their frame.

    Attributes:
        source: that was read.
        positions: of its frames, by number.
    """

    source: Source
    positions: Mapping[int, int]

    def scan(self, number: int) -> Scan | None:
        """Checked scan of a frame.

        Raises:
            DataError: it cannot be used.
        """
        scan = scan_at(self.source, self.positions[number])
        place = f"{self.source.name}, frame {number}"
        return None if scan is None else checked_scan(scan, place, fewest=0)

    def image(self, number: int) -> CameraImage | None:
        """Checked image of a frame.

        Raises:
            DataError: it cannot be used.
        """
        image = image_at(self.source, self.positions[number])
        place = f"{self.source.name}, frame {number}"
        return None if image is None else checked_image(image, self.source.camera, place)


def scan_positions(source: Source) -> Sequence[int]:
    """Positions of frames that may have a scan: those that the source names, else all."""
    named: Sequence[int] | None = getattr(source, "scan_positions", None)
    return range(len(source)) if named is None else named


def image_positions(source: Source) -> Sequence[int]:
    """Positions of frames that may have an image: those that the source names, else all."""
    named: Sequence[int] | None = getattr(source, "image_positions", None)
    return range(len(source)) if named is None else named


_FRAMES, _SCANS = 24, 48
"""Most frames, or scans where these are read apart, that are kept until they are asked for again: 100 MB of
an HDL-64E's. A sweep is decided by 48 scans at most."""


class AheadReader:
    """A drive some of whose scans are read before the frames are read in turn. These are kept until their
    frames are read, so no file is read twice.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self._frames: dict[int, Frame] = {}
        self._scans: dict[int, Scan | None] = {}

    def look(self, position: int) -> Scan | None:
        """Scan of the frame at a position."""
        source = self.source
        if isinstance(source, SeparateReader):
            if position not in self._scans:
                _make_room(self._scans, _SCANS)
                self._scans[position] = source.read_scan(position)
            return self._scans[position]
        if position not in self._frames:
            _make_room(self._frames, _FRAMES)
            self._frames[position] = frame_at(source, position)
        return self._frames[position].scan

    def frame(self, position: int) -> Frame:
        """Frame at a position; IndexError as the source's own."""
        if position in self._frames:
            return self._frames.pop(position)
        source = self.source
        if not isinstance(source, SeparateReader):
            return frame_at(source, position)
        seen = position in self._scans
        scan = self._scans.pop(position) if seen else source.read_scan(position)
        return Frame(source.frame_number(position), scan, source.read_image(position))


_RECENT = 12
"""Scans, and images, that are kept of those read last: the four candidates for a picture, and what is around
the one that is drawn."""


class RecentReader:
    """Scans and images of a drive by position; those read last are not read again."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.scan = lru_cache(_RECENT)(partial(scan_at, source))
        self.image = lru_cache(_RECENT)(partial(image_at, source))

    def __len__(self) -> int:
        return len(self.source)

    def number(self, position: int) -> int:
        """Index of the frame at a position."""
        return number_at(self.source, position)

    def frame(self, position: int) -> Frame:
        """Frame at a position."""
        return Frame(self.number(position), self.scan(position), self.image(position))


def _make_room(kept: dict[int, Frame] | dict[int, Scan | None], most: int) -> None:
    """Let the oldest go where there are so many."""
    if len(kept) >= most:
        kept.pop(next(iter(kept)))
