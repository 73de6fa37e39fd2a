"""A drive of a distorted camera as one of a pinhole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast, overload

from sst_graph.cameras import Rectification
from sst_graph.data.frame_parts import image_at
from sst_graph.data.source_view import SourceView
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, Source


class RectifiedSource(SourceView):
    """A source whose images are rectified as they are read (satisfies :class:`sst_graph.types.Source`).

    What else the source has to say (of its sweep, its topics) is passed on; rectification leaves the camera's
    pose.
    """

    def __init__(self, source: Source, rectification: Rectification) -> None:
        """source: with raw pictures and masks, of the size of the rectification's model."""
        self.source, self.rectification = source, rectification

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole."""
        return self.rectification.camera

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

    def read_image(self, position: int) -> CameraImage | None:
        """Rectified image of the frame at a position."""
        image = image_at(self.source, position)
        return None if image is None else self.rectification.image(image)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name in ("source", "rectification"):
            raise AttributeError(name)
        return getattr(self.source, name)

    def _rectified(self, frame: Frame) -> Frame:
        if frame.image is None:
            return frame
        return replace(frame, image=self.rectification.image(frame.image))
