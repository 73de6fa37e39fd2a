"""Pictures and Cityscapes masks of a drive, kept as files by number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import MaskEncoding, classes_of_mask, classes_of_points, guess_mask_encoding
from sst_graph.data.arrays import read_labels
from sst_graph.data.images import picture_size, read_mask, read_picture
from sst_graph.data.source import LabelEncoding
from sst_graph.errors import DataError
from sst_graph.sampling import evenly_spread
from sst_graph.types import NO_PICTURE, CameraImage, SemanticClass

_MASKS_TO_JUDGE = 8
"""How many masks, spread over the drive, decide on their encoding."""

_ANOTHER_SIZE = 0.15
"""A principal point is farther from the middle of pictures of another size than its own, by this: the sum
across and down of the logarithms of the ratios. It is that of a change of size by 8 %."""


@dataclass(frozen=True)
class PictureFiles:
    """Images by number; a picture or a mask may be missing.

    Attributes:
        size: width and height of all of them [px].
        pictures, masks: paths by number.
        encoding: of the masks.
    """

    size: tuple[int, int]
    pictures: Mapping[int, Path]
    masks: Mapping[int, Path] = field(default_factory=dict)
    encoding: MaskEncoding = MaskEncoding.IDS

    def image(self, number: int, stamp_ns: int) -> CameraImage:
        """Image of a number; without its mask every pixel may be anything.

        Raises:
            DataError: a file is damaged, of another size, or holds what it must not.
        """
        width, height = self.size
        mask = np.full((height, width), SemanticClass.IGNORE, np.uint8)
        if (path := self.masks.get(number)) is not None:
            mask = classes_of_mask(read_mask(path, self.size), self.encoding, path)
        picture = self.pictures.get(number)
        return CameraImage(
            stamp_ns, mask, NO_PICTURE if picture is None else read_picture(picture, self.size)
        )


def check_scale(
    picture: Path, size: tuple[int, int], masks: Mapping[int, Path], centre: tuple[float, float]
) -> None:
    """Refuse pictures of another size than the masks, where the intrinsics were made for the masks' size.

    Their principal point is near the middle of the pictures that they were made for.

    Args:
        picture: file of one of them.
        size: width and height of the pictures [px].
        masks: paths by number.
        centre: the principal point (cx, cy) [px].

    Raises:
        DataError: the pictures have another size, or a mask cannot be read.
    """
    if not masks:
        return
    of_masks = picture_size(next(iter(masks.values())))
    if of_masks == size or _off_middle(size, centre) < _off_middle(of_masks, centre) + _ANOTHER_SIZE:
        return
    (width, height), (w, h), (cx, cy) = of_masks, size, centre
    raise DataError(
        picture,
        f"a picture of {w}x{h} px",
        f"{width}x{height} px, as the masks and the intrinsics (cx = {cx:.0f}, cy = {cy:.0f} px): if the "
        f"pictures were scaled, scale fx and cx by {w / width:.4g}, fy and cy by {h / height:.4g}, and use "
        "masks of the pictures' size",
    )


def _off_middle(size: tuple[int, int], centre: tuple[float, float]) -> float:
    """How far a principal point is from the middle of a picture, as a ratio: 0 in the middle."""
    ratios = np.maximum(2.0 * np.array(centre), 1e-9) / np.array(size)
    return float(np.abs(np.log(ratios)).sum())


def mask_encoding(masks: Mapping[int, Path], wanted: LabelEncoding, size: tuple[int, int]) -> MaskEncoding:
    """Encoding of masks; decided over some of them where ``wanted`` is "auto".

    Raises:
        DataError: a mask that cannot be read, or numbers that no encoding defines.
    """
    if wanted != "auto":
        return MaskEncoding(wanted)
    if not masks:
        return MaskEncoding.IDS
    paths = list(masks.values())
    chosen = evenly_spread(paths, _MASKS_TO_JUDGE)
    return guess_mask_encoding((read_mask(path, size) for path in chosen), paths[0].parent)


def point_labels(
    path: Path | None, used: NDArray[np.bool_], cloud: Path
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Classes and instances of a scan's used points by a SemanticKITTI file; without one, any class.

    Args:
        used: (n,) False for points that are left out.
        cloud: file of the points.

    Raises:
        DataError: a damaged file, another number of labels than points, an unknown class.
    """
    if path is None:
        count = int(used.sum())
        return np.full(count, SemanticClass.IGNORE, np.uint8), np.zeros(count, np.uint16)
    return classes_of_points(read_labels(path, len(used), cloud)[used], path)
