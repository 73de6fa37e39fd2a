"""Pictures and masks of sensor_msgs/Image and CompressedImage."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.images import MAX_PIXELS, decoded_mask, decoded_picture
from sst_graph.data.ros.topics import COMPRESSED
from sst_graph.errors import DataError, count_of

_CHANNELS = {
    "mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
}  # fmt: skip
"""Bytes a pixel of each encoding (sensor_msgs/image_encodings.h)."""

_OF_16_BITS = {f"{name.removesuffix('8')}16": name for name in _CHANNELS if name.endswith("8")}
"""Encodings of 16 bits by those of 8, the upper ones, as which they are read; depths have 16UC1."""

_TO_BGR = {
    "mono8": cv2.COLOR_GRAY2BGR,
    "8UC1": cv2.COLOR_GRAY2BGR,
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "8UC4": cv2.COLOR_BGRA2BGR,
    # OpenCV names a Bayer pattern by its second row and column, ROS by its first (as cv_bridge has it).
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
}
"""Conversions of OpenCV; what is not here is BGR already."""

_BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)")
"""At the beginning of a format: "bayer_rggb8; jpeg compressed "."""


def picture_of(message: Any, type_name: str, place: str) -> NDArray[np.uint8]:
    """Picture (h, w, 3) uint8 BGR of a message.

    Raises:
        DataError: an encoding that is not understood, or fewer bytes than the picture has.
    """
    if type_name == COMPRESSED:
        _check_compressed(message, place)
        return _demosaiced(decoded_picture(bytes(message.data), place), str(message.format))
    rows = _rows(message, place)
    code = _TO_BGR.get(_OF_16_BITS.get(message.encoding, message.encoding))
    if code is None:
        return np.ascontiguousarray(rows)
    try:
        return np.asarray(cv2.cvtColor(rows, code), np.uint8)
    except cv2.error:
        # Such as an odd width, where two pixels share their colour.
        found = f"{message.width}x{message.height} px"
        raise DataError(place, found, f"a size that encoding {message.encoding} can have") from None


def _demosaiced(picture: NDArray[np.uint8], form: str) -> NDArray[np.uint8]:
    """The picture; of a Bayer pattern that was compressed as it is, as image_transport does, in colour."""
    pattern = _BAYER.match(form)
    grey = picture[..., 0]
    if pattern is None or not (picture == grey[..., None]).all():
        return picture
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(grey), _TO_BGR[f"{pattern[0]}8"]), np.uint8)


def mask_of(message: Any, type_name: str, place: str) -> NDArray[np.uint8]:
    """Mask (h, w) uint8 of a message: mono8, or a PNG of one channel.

    Raises:
        DataError: another encoding, or fewer bytes than the mask has.
    """
    if type_name == COMPRESSED:
        _check_compressed(message, place)
        return decoded_mask(bytes(message.data), place)
    if message.encoding not in ("mono8", "8UC1"):
        raise DataError(place, f"a mask in encoding {message.encoding!r}", "mono8 with Cityscapes numbers")
    return np.ascontiguousarray(_rows(message, place))


def _rows(message: Any, place: str) -> NDArray[np.uint8]:
    """Pixels (h, w) or (h, w, channels) without the padding of the rows."""
    encoding, height, width = str(message.encoding), int(message.height), int(message.width)
    of_8_bits = _OF_16_BITS.get(encoding, encoding)
    if of_8_bits not in _CHANNELS:
        hint = ", convert it to 8 bits" if "16" in encoding or "32" in encoding else ""
        known = ", ".join((*_CHANNELS, *_OF_16_BITS))
        raise DataError(place, f"encoding {encoding!r}", f"one of {known}{hint}")
    if min(height, width) < 1 or height * width > MAX_PIXELS:
        raise DataError(place, f"{width}x{height} px", f"1 to {MAX_PIXELS} pixels")
    channels, each = _CHANNELS[of_8_bits], 1 if encoding == of_8_bits else 2
    row = width * channels * each
    # Of a single row nothing follows, whatever its step says.
    step = (height > 1 and int(message.step)) or row
    data = np.asarray(message.data, np.uint8)
    if step < row or len(data) < step * (height - 1) + row:
        found = f"{count_of(len(data), 'byte')} in rows of {step}"
        raise DataError(place, found, f"{width}x{height} px of {channels * each} bytes ({encoding})")
    padded = np.zeros(step * height, np.uint8)
    padded[: min(len(data), len(padded))] = data[: len(padded)]
    upper = each - 1 if not message.is_bigendian else 0
    rows = padded.reshape(height, step)[:, upper:row:each]
    return rows if channels == 1 else rows.reshape(height, width, channels)


def _check_compressed(message: Any, place: str) -> None:
    if "compressedDepth" in message.format:
        raise DataError(place, f"format {message.format!r}", "a JPEG or PNG picture")
