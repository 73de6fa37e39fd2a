"""Segmentation of pictures by an ONNX network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of
from sst_graph.segmentation.label_numbers import LabelNumbers
from sst_graph.segmentation.onnx_network import OnnxNetwork
from sst_graph.segmentation.picture_input import PictureInput, PictureLayout, best_output
from sst_graph.segmentation.segmenter import ImageLabels
from sst_graph.types import CameraImage, SemanticClass

Output = Literal["logits", "labels", "instances"]
VERSION = 1
"""Version of what is done beside the network: other labels from the same network and file need another."""

MIN_SCORE = 0.5
"""Detections below this score are left out, as the demos of Mask R-CNN and YOLO do."""
_MIN_MASK = 0.5
"""Share by which a pixel belongs to a detection: the value at which these networks are trained to decide."""
_MOST_INSTANCES = 255
"""Instances that are kept, the best: stored masks have 8 bits for their number."""


@dataclass(frozen=True)
class ImageModel:
    """What a YAML file says of a network for pictures.

    Attributes:
        path: of the YAML file.
        network: of the ONNX file.
        numbers: what the outputs mean.
        input: how it takes pictures.
        output: "logits" (1, c, h, w) or (1, h, w, c), one output a class; "labels" (1, h, w) numbers; or
            "instances": boxes, scores, labels and masks of detections.
        outputs: names of the network's outputs by ``logits``, ``labels``, ``boxes``, ``scores`` or ``masks``;
            what is not named is called so itself, logits and labels are the first.
        min_score: of detections.
    """

    path: Path
    network: Path
    numbers: LabelNumbers
    input: PictureInput
    output: Output = "logits"
    outputs: Mapping[str, str] = field(default_factory=dict)
    min_score: float = MIN_SCORE


class OnnxImageSegmenter:
    """Satisfies :class:`~sst_graph.segmentation.segmenter.ImageSegmenter`."""

    def __init__(self, model: ImageModel) -> None:
        """Loads the network.

        Raises:
            DataError: it is missing, does not load, or takes other pictures than the YAML file says.
            MissingDependencyError: onnxruntime is not installed.
        """
        self._network = OnnxNetwork(model.network)
        size = model.input.height, model.input.width
        if model.input.layout == "nchw":
            layout = "1 x 3 channels x height x width (layout: nchw)"
            _, channels, height, width = self._network.check_input((1, 3, *size), layout)
            other = width
        else:
            layout = "1 x height x width x 3 channels (layout: nhwc)"
            _, height, width, channels = self._network.check_input((1, *size, 3), layout)
            other = height
        if channels is None and other == 3:
            raise DataError(model.network, "its 3 channels elsewhere", layout)
        changes = {"width": size[1] or width, "height": size[0] or height}
        self._input = PictureInput(**{**vars(model.input), **changes})
        if self._network.dtype == np.uint8 and not self._input.keeps_pixels:
            raise DataError(
                model.network,
                "an input of uint8, which takes the pixels as they are",
                f"range: 1, mean: [0, 0, 0] and std: [1, 1, 1] in {model.path.name}",
            )
        self.model = model

    @property
    def name(self) -> str:
        """Name of the YAML file."""
        return self.model.path.name

    @property
    def identity(self) -> str:
        """Identity of the network and of what is done with it."""
        model = self.model
        use = self._input, model.output, sorted(model.outputs.items()), model.min_score
        return self._network.identity(VERSION, model.numbers, use)

    @property
    def known(self) -> frozenset[SemanticClass]:
        """Classes that its class map names."""
        return self.model.numbers.known

    def segment(self, image: CameraImage) -> ImageLabels:
        """Labels of a picture.

        Raises:
            DataError: no picture, or outputs that are not what the YAML file says.
        """
        if not image.has_picture:
            raise DataError(f"image stamped {image.stamp_ns} ns", "no picture", "one to segment")
        place = self._input.place(image.pixels.shape[1], image.pixels.shape[0])
        outputs = self._network.run(
            self._input.values(image.pixels), f"the image stamped {image.stamp_ns} ns"
        )
        if self.model.output == "instances":
            return self._detected(outputs, place)
        array = self._network.output(outputs, self.model.outputs.get(self.model.output))
        if self.model.output == "labels":
            return ImageLabels(place.labels(self._labels(array, place)))
        logits = self._logits(array, place)
        classes = self.model.numbers.of_outputs(len(logits), self.model.network)
        return ImageLabels(classes[best_output(logits, place)])

    def _labels(self, array: NDArray[Any], place: PictureLayout) -> NDArray[np.uint8]:
        """Classes (h', w') of a map of numbers."""
        found = array.shape
        array = array.squeeze()  # of the batch and of a channel, first or last
        if array.ndim != 2 or not _fits(array.shape[1], array.shape[0], place):
            raise self._unfit("labels", found, f"1 x h x w of {_proportions(place)}")
        if array.dtype.kind == "f" and (array != np.floor(array)).any():
            found_values = "labels that are no whole numbers (logits?)"
            raise DataError(self.model.network, found_values, "numbers of classes (output: labels)")
        return self.model.numbers.of_labels(array.astype(np.int64), self.model.network)

    def _logits(self, array: NDArray[Any], place: PictureLayout) -> NDArray[Any]:
        """Outputs (c, h', w')."""
        if array.ndim == 4 and array.shape[0] == 1:
            if _fits(array.shape[3], array.shape[2], place) and array.shape[1] > 1:
                return np.asarray(array[0])
            if _fits(array.shape[2], array.shape[1], place) and array.shape[3] > 1:
                return np.asarray(array[0].transpose(2, 0, 1))
        expected = f"1 x classes x h x w or 1 x h x w x classes, h x w of {_proportions(place)}"
        raise self._unfit("logits", array.shape, expected)

    def _unfit(self, kind: str, shape: tuple[int, ...], expected: str) -> DataError:
        """An error about an output of another shape; it names the output where there are others."""
        names = self._network.outputs
        found, remedy = f"{kind} of shape {shape}", ""
        if len(names) > 1:
            found += f" in the output {self.model.outputs.get(kind, names[0])} of {', '.join(names)}"
            remedy = f" (another one: outputs: {{{kind}: NAME}})"
        return DataError(self.model.network, found, expected + remedy)

    def _detected(self, outputs: Mapping[str, NDArray[Any]], place: PictureLayout) -> ImageLabels:
        """Mask and instances of detections: of two that overlap the better one has the pixel."""
        scores, labels, masks = (self._part(outputs, name) for name in ("scores", "labels", "masks"))
        scores, labels = scores.reshape(-1), labels.reshape(-1)
        if masks.ndim >= 3 and masks.shape[:1] != scores.shape and masks.shape[0] == 1:
            masks = masks[0]
        if masks.ndim == 4 and masks.shape[1] == 1:
            masks = masks[:, 0]
        if masks.ndim != 3 or not len(scores) == len(labels) == len(masks):
            counts = f"{count_of(len(scores), 'score')}, {count_of(len(labels), 'label')}"
            found = f"{counts}, masks of shape {masks.shape}"
            raise DataError(self.model.network, found, "n scores, n labels, masks n x h x w or n x 1 x h x w")
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] >= self.model.min_score][:_MOST_INSTANCES]
        classes = self.model.numbers.of_labels(labels[order].astype(np.int64), self.model.network)
        width, height = place.picture
        mask = np.full((height, width), SemanticClass.OTHER, np.uint8)
        instances = np.zeros((height, width), np.uint16)
        boxes = self._boxes(outputs, masks, place)
        for number, (k, label) in reversed(list(enumerate(zip(order, classes, strict=True), 1))):
            shape = masks[k] if boxes is None else _pasted(masks[k], boxes[k], place)
            inside = place.scores(shape) > _MIN_MASK
            mask[inside], instances[inside] = label, number
        return ImageLabels(mask, instances)

    def _boxes(
        self, outputs: Mapping[str, NDArray[Any]], masks: NDArray[Any], place: PictureLayout
    ) -> NDArray[Any] | None:
        """(n, 4) corners in the input [px] where masks are those of the boxes; None: of the whole input."""
        if _fits(masks.shape[2], masks.shape[1], place) and masks.shape[2] * 8 >= place.whole[0]:
            return None
        boxes = self._part(outputs, "boxes")
        boxes = boxes.reshape(-1, boxes.shape[-1]) if boxes.ndim else boxes
        if boxes.ndim != 2 or boxes.shape[1] < 4 or len(boxes) != len(masks):
            raise DataError(self.model.network, f"boxes of shape {boxes.shape}", f"{len(masks)} x 4")
        return np.asarray(boxes[:, :4])

    def _part(self, outputs: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
        return self._network.output(outputs, self.model.outputs.get(name, name))


def _pasted(mask: NDArray[Any], box: NDArray[Any], place: PictureLayout) -> NDArray[np.float32]:
    """The mask (h', w') of a box in the input (h, w)."""
    width, height = place.whole
    left, top, right, bottom = (float(value) for value in box)
    scale_x = mask.shape[1] / max(right - left, 1.0)
    scale_y = mask.shape[0] / max(bottom - top, 1.0)
    # Pixel (u, v) has its centre at (u + 0.5, v + 0.5), in the box as in the mask.
    to_mask = np.array(
        [
            [scale_x, 0.0, (0.5 - left) * scale_x - 0.5],
            [0.0, scale_y, (0.5 - top) * scale_y - 0.5],
        ]
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(np.ascontiguousarray(mask, np.float32), to_mask, (width, height), flags=flags)
    )


def _fits(width: int, height: int, place: PictureLayout) -> bool:
    """Whether a map has the proportions of the input, of any stride up to 32 (a stride may round up)."""
    w, h = place.whole
    stride = max(1, round(w / max(width, 1)))
    return stride <= 32 and abs(width * stride - w) <= stride and abs(height * stride - h) <= stride


def _proportions(place: PictureLayout) -> str:
    return f"{place.whole[1]} x {place.whole[0]}, or less by a stride up to 32"
