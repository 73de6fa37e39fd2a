"""A source seen through another one, which changes what its frames hold."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Self, overload

import gtsam

from sst_graph.data.frame_parts import image_at, image_positions, number_at, scan_at, scan_positions
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, Source


class SourceView(ABC):
    """What a view of a source passes on; deriving from it and giving frames, and those scans or images
    that differ, makes a :class:`sst_graph.types.Source` that reads the last two separately."""

    source: Source

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

    @property
    def scan_positions(self) -> Sequence[int]:
        """Positions of frames that may have a scan."""
        return scan_positions(self.source)

    @property
    def image_positions(self) -> Sequence[int]:
        """Positions of frames that may have an image."""
        return image_positions(self.source)

    def __len__(self) -> int:
        return len(self.source)

    @abstractmethod
    def __getitem__(self, position: int) -> Frame:
        """Frame at a position; IndexError as the source's own."""

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def frame_number(self, position: int) -> int:
        """Index of the frame at a position."""
        return number_at(self.source, position)

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position."""
        return scan_at(self.source, position)

    def read_image(self, position: int) -> CameraImage | None:
        """Image of the frame at a position."""
        return image_at(self.source, position)


class ChangedSource(SourceView):
    """A view whose scans or images are changed one by one as they are read; so are those of a slice of it.

    What else the source has to say (of its sweep, its topics) is passed on.
    """

    def changed_scan(self, scan: Scan) -> Scan:
        """The scan as it is seen; by default as it is."""
        return scan

    def changed_image(self, image: CameraImage) -> CameraImage:
        """The image as it is seen; by default as it is."""
        return image

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> Self: ...
    def __getitem__(self, position: int | slice) -> Frame | Self:
        """Frame at a position, or the drive restricted to a slice; errors as the source's own."""
        if isinstance(position, slice):
            part = copy.copy(self)
            part.source = self.source[position]  # type: ignore[index, assignment]
            return part
        return self._changed(self.source[position])

    def __iter__(self) -> Iterator[Frame]:
        return map(self._changed, self.source)

    def read_scan(self, position: int) -> Scan | None:
        """Changed scan of the frame at a position."""
        scan = scan_at(self.source, position)
        return None if scan is None else self.changed_scan(scan)

    def read_image(self, position: int) -> CameraImage | None:
        """Changed image of the frame at a position."""
        image = image_at(self.source, position)
        return None if image is None else self.changed_image(image)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "source":
            raise AttributeError(name)
        return getattr(self.source, name)

    def _changed(self, frame: Frame) -> Frame:
        scan = None if frame.scan is None else self.changed_scan(frame.scan)
        image = None if frame.image is None else self.changed_image(frame.image)
        return replace(frame, scan=scan, image=image)
