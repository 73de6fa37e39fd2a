"""From a picture to a network's input, and from its outputs back to the picture's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray

Resize = Literal["stretch", "letterbox"]
Channels = Literal["rgb", "bgr"]
Layout = Literal["nchw", "nhwc"]


@dataclass(frozen=True)
class PictureInput:
    """How a network takes its pictures.

    Attributes:
        width, height: of the input [px]; None: those of the picture.
        resize: "stretch" to the whole input, or "letterbox": of the same proportions, in the middle, with the
            mean colour around it.
        channels: their order.
        range: pixel value that counts as 1 before mean and std: 255, or 1 for networks that take 0 to 255.
        mean, std: by channel, in the order of ``channels``; value = (pixel / range - mean) / std.
        layout: of the input.
    """

    width: int | None = None
    height: int | None = None
    resize: Resize = "stretch"
    channels: Channels = "rgb"
    range: float = 255.0
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    layout: Layout = "nchw"

    @property
    def keeps_pixels(self) -> bool:
        """Whether the values are the pixels themselves, 0 to 255."""
        return bool((np.rint(self._black_and_white) == [[0.0], [255.0]]).all())

    @property
    def largest(self) -> float:
        """Largest absolute value of a pixel, and of what it is made with."""
        return float(np.abs([*self._black_and_white, self.mean, self.std, [self.range] * 3]).max())

    @property
    def _black_and_white(self) -> FloatArray:
        """(2, 3) values of a black and of a white pixel by channel."""
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = np.array([[0.0], [255.0]]) / self.range
            return np.asarray((scaled - np.array(self.mean)) / np.array(self.std))

    def place(self, width: int, height: int) -> PictureLayout:
        """Where a picture of a size [px] lies in the input."""
        w, h = self.width or width, self.height or height
        if self.resize == "stretch":
            return PictureLayout((width, height), (w, h), (0, 0, w, h))
        scale = min(w / width, h / height)
        inner_w, inner_h = max(1, round(width * scale)), max(1, round(height * scale))
        left, top = (w - inner_w) // 2, (h - inner_h) // 2
        return PictureLayout((width, height), (w, h), (left, top, inner_w, inner_h))

    def values(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The input (1, 3, h, w) or (1, h, w, 3) of a picture (h, w, 3) BGR."""
        place = self.place(pixels.shape[1], pixels.shape[0])
        left, top, w, h = place.inner
        shrinks = w < pixels.shape[1] or h < pixels.shape[0]
        picture = pixels if self.channels == "bgr" else pixels[:, :, ::-1]
        if (w, h) != place.picture:
            method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            picture = np.asarray(cv2.resize(np.ascontiguousarray(picture), (w, h), interpolation=method))
        mean, std = np.asarray(self.mean, np.float32), np.asarray(self.std, np.float32)
        scaled = (picture.astype(np.float32) / self.range - mean) / std
        values = np.zeros((place.whole[1], place.whole[0], 3), np.float32)
        values[top : top + h, left : left + w] = scaled
        return (values if self.layout == "nhwc" else values.transpose(2, 0, 1))[None]


@dataclass(frozen=True)
class PictureLayout:
    """Where a picture lies in an input: sizes (width, height), and its (left, top, width, height) there."""

    picture: tuple[int, int]
    whole: tuple[int, int]
    inner: tuple[int, int, int, int]

    def scores(self, channel: NDArray[Any]) -> NDArray[np.float32]:
        """One output (h', w') of the input, whatever its stride, at the picture's pixels (h, w)."""
        channel = np.ascontiguousarray(channel, np.float32)
        left, top, w, h = self.inner
        if (w, h) != self.whole:
            channel = _resized(channel, self.whole, cv2.INTER_LINEAR)[top : top + h, left : left + w]
        return np.asarray(_resized(channel, self.picture, cv2.INTER_LINEAR), np.float32)

    def labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Classes (h', w') of the input at the picture's pixels (h, w)."""
        left, top, w, h = self.inner
        if (w, h) != self.whole:
            labels = _resized(labels, self.whole, cv2.INTER_NEAREST_EXACT)[top : top + h, left : left + w]
        return np.asarray(_resized(labels, self.picture, cv2.INTER_NEAREST_EXACT), np.uint8)


def best_output(logits: NDArray[Any], place: PictureLayout) -> NDArray[np.intp]:
    """Number (h, w) of the largest of the outputs (c, h', w') at each of the picture's pixels.

    One output at a time, for all at the picture's size take a gigabyte where there are 150.
    """
    best = place.scores(logits[0])
    number = np.zeros(best.shape, np.intp)
    for k in range(1, len(logits)):
        scores = place.scores(logits[k])
        larger = scores > best
        number[larger] = k
        np.maximum(best, scores, out=best)
    return number


def _resized(array: NDArray[Any], size: tuple[int, int], method: int) -> NDArray[Any]:
    if (array.shape[1], array.shape[0]) == size:
        return array
    return np.asarray(cv2.resize(np.ascontiguousarray(array), size, interpolation=method))
