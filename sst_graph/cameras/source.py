"""A drive of a distorted camera as one of a pinhole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast, overload

import gtsam

from sst_graph.cameras.rectification import Rectification
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, GroundTruth, Scan, Source


class RectifiedSource:
    """A source whose images are rectified as they are read (satisfies :class:`sst_graph.types.Source`).

    What else the source has to say (of its sweep, of its reference) is passed on; frames are read apart where
    the source can do that.
    """

    def __init__(self, source: Source, rectification: Rectification) -> None:
        """source: with raw pictures and masks, of the size of the rectification's model."""
        self.source, self.rectification = source, rectification

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.source.name

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole."""
        return self.rectification.camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        """Nominal cTl of the data: rectification leaves the camera's pose."""
        return self.source.nominal

    @property
    def truth(self) -> GroundTruth | None:
        """Truth, where the data bring it."""
        return self.source.truth

    def __len__(self) -> int:
        return len(self.source)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> RectifiedSource: ...
    def __getitem__(self, position: int | slice) -> Frame | RectifiedSource:
        """Frame at a position, or the drive restricted to a slice; errors as the source's own."""
        if isinstance(position, slice):
            part = cast("Source", self.source[position])  # type: ignore[index]
            return RectifiedSource(part, self.rectification)
        return self._rectified(self.source[position])

    def __iter__(self) -> Iterator[Frame]:
        return map(self._rectified, self.source)

    def frame_number(self, position: int) -> int:
        """Index of the frame at a position."""
        known = getattr(self.source, "frame_number", None)
        return int(known(position)) if known is not None else self.source[position].index

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position."""
        read = getattr(self.source, "read_scan", None)
        return cast("Scan | None", read(position)) if read is not None else self.source[position].scan

    def read_image(self, position: int) -> CameraImage | None:
        """Rectified image of the frame at a position."""
        read = getattr(self.source, "read_image", None)
        image = read(position) if read is not None else self.source[position].image
        return None if image is None else self.rectification.image(image)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name in ("source", "rectification"):
            raise AttributeError(name)
        return getattr(self.source, name)

    def _rectified(self, frame: Frame) -> Frame:
        if frame.image is None:
            return frame
        return replace(frame, image=self.rectification.image(frame.image))
