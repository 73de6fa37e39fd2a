"""A drive of a distorted camera as one of a pinhole."""

from __future__ import annotations

from sst_graph.cameras import CameraModel, Rectification
from sst_graph.data.source_view import ChangedSource
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Source


class RectifiedSource(ChangedSource):
    """A source whose images are rectified as they are read (satisfies :class:`sst_graph.types.Source`).

    Rectification leaves the camera's pose.
    """

    def __init__(self, source: Source, rectification: Rectification) -> None:
        """source: with raw pictures and masks, of the size of the rectification's model."""
        self.source, self.rectification = source, rectification

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole."""
        return self.rectification.camera

    def changed_image(self, image: CameraImage) -> CameraImage:
        """The image rectified."""
        return self.rectification.image(image)


def lens_of(source: Source) -> CameraModel | None:
    """The model of the camera from whose pictures a source's images are rectified, also where the source is
    a view of such a one; None where the images are as they came."""
    rectification = getattr(source, "rectification", None)
    return rectification.model if isinstance(rectification, Rectification) else None
