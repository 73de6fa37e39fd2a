"""Whether pictures and intrinsics are of one camera and one size."""

from __future__ import annotations

import math

from sst_graph.data.images import DARK
from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.factors.camera import PinholeCamera

_FAR = 1.4
"""A principal point off the middle by this factor, in both directions alike, is that of another image size:
lenses and sensors are centred within a few per cent, and a crop seldom cuts width and height alike."""
_ALIKE = 1.25
_AT_MIDDLE_PX = 0.5
"""Half of the size, of the size less 1, and either rounded, are the middle [px]."""


def image_size(camera: PinholeCamera) -> Finding | None:
    """Pictures of another size than the intrinsics were made for: the principal point is off the middle by
    one factor across and down, which gives the ratio of the sizes to some per cent."""
    across, down = 2.0 * camera.cx / camera.width, 2.0 * camera.cy / camera.height
    if min(across, down) <= 0.0:
        return None
    factor = (across * down) ** 0.5
    if max(across, down) > _ALIKE * min(across, down) or 1.0 / _FAR < factor < _FAR:
        return None
    if 1.7 < factor < 2.4:
        size, scale = "half", 0.5
    elif 0.4 < factor < 0.6:
        size, scale = "twice", 2.0
    else:
        scale = 1.0 / factor
        size = f"about {scale:.2g} times"
    return Finding(
        f"the pictures are {size} the size the intrinsics were made for",
        f"cx = {camera.cx:.0f} of {camera.width} px, cy = {camera.cy:.0f} of {camera.height} px",
        f"scale fx, fy, cx and cy by that ratio (about {scale:.2g}), or give pictures and masks at full size",
    )


def uncalibrated(camera: PinholeCamera) -> Finding | None:
    """A principal point in the very middle of the picture, as of a data sheet. It may be right; those of
    real cameras are some pixels beside it."""
    off_x, off_y = camera.cx - 0.5 * (camera.width - 1), camera.cy - 0.5 * (camera.height - 1)
    if max(abs(off_x), abs(off_y)) > _AT_MIDDLE_PX:
        return None
    turn_deg = math.degrees(1.0 / camera.fy)
    return Finding(
        "the principal point is the middle of the picture, as where a camera was not calibrated",
        f"cx = {camera.cx:g} of {camera.width} px, cy = {camera.cy:g} of {camera.height} px; each pixel that "
        f"it is off turns the result by {turn_deg:.2g} deg, beyond the sigmas",
        "if so, calibrate it, or say how far it may be off: --set assumptions.cx=8 --set assumptions.cy=8",
    )


def black_pictures(drive: Drive) -> Finding | None:
    """Pictures that are all black, or nearly."""
    images = () if drive.statistics is None else drive.statistics.images
    brightest = [image.brightest for image in images if image.brightest is not None]
    if not brightest or max(brightest) >= DARK:
        return None
    return Finding(
        "the pictures are black",
        f"no value above {max(brightest)} of 255 in {count_of(len(brightest), 'picture')}",
        "make them brighter, 16 times where 12 bits are kept in 16",
    )
