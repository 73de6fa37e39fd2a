"""A drive held in memory, so that it can be read often or changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

import gtsam

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, Source
from sst_graph.validation import checked_position, checked_slice


@dataclass(frozen=True)
class KeptDrive:
    """A drive whose frames are held in memory (satisfies :class:`sst_graph.types.Source`).

    Attributes:
        name, camera, nominal, truth: as in a source.
        frames: all of them.
        sweep: what the data say of the sweep (:mod:`sst_graph.odometry.sweep`); ``auto``: nothing.
    """

    name: str
    camera: PinholeCamera
    nominal: gtsam.Pose3 | None
    truth: GroundTruth | None
    frames: Sequence[Frame]
    sweep: str = "auto"

    @classmethod
    def of(cls, source: Source, sweep: str | None = None) -> KeptDrive:
        """All frames of a source, read now.

        Args:
            sweep: what is to be said of the sweep; the source's own word where it is None.
        """
        word = getattr(source, "sweep", "auto") if sweep is None else sweep
        return cls(source.name, source.camera, source.nominal, source.truth, tuple(source), word)

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> KeptDrive: ...
    def __getitem__(self, position: int | slice) -> Frame | KeptDrive:
        """Frame at a position, or the drive restricted to a slice of positions.

        Raises:
            DataError: neither a whole number nor a slice.
            IndexError: no frame at this position.
        """
        if isinstance(position, slice):
            return replace(self, frames=self.frames[checked_slice(position, len(self))])
        return self.frames[checked_position(position, len(self), slices=True)]

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def with_images(self, change: Callable[[CameraImage], CameraImage]) -> KeptDrive:
        """The drive with every image changed."""
        return replace(self, frames=tuple(replace(f, image=f.image and change(f.image)) for f in self.frames))

    def with_scans(self, change: Callable[[Scan], Scan]) -> KeptDrive:
        """The drive with every scan changed."""
        return replace(self, frames=tuple(replace(f, scan=f.scan and change(f.scan)) for f in self.frames))
