"""Segmentation of scans by an ONNX network on range images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.segmentation.label_numbers import LabelNumbers
from sst_graph.segmentation.onnx_network import OnnxNetwork
from sst_graph.segmentation.range_view import CHANNELS, Neighbours, RangeImage, RangeView
from sst_graph.segmentation.segmenter import PointLabels
from sst_graph.types import Scan, SemanticClass

VERSION = 1
"""Version of what is done beside the network: other labels from the same network and file need another."""


@dataclass(frozen=True)
class ScanModel:
    """What a YAML file, or the two of a lidar-bonnetal folder, says of a network for scans.

    Attributes:
        path: of the YAML file or the folder.
        network: of the ONNX file.
        numbers: what the outputs mean.
        view: of its range images.
        neighbours: how points get their labels; None: each from its pixel.
        output: "logits" (1, c, h, w), or "labels" (1, h, w) numbers.
        output_name: of the network's output; None: the first.
    """

    path: Path
    network: Path
    numbers: LabelNumbers
    view: RangeView
    neighbours: Neighbours | None
    output: Literal["logits", "labels"] = "logits"
    output_name: str | None = None


class OnnxScanSegmenter:
    """Satisfies :class:`~sst_graph.segmentation.segmenter.ScanSegmenter`."""

    def __init__(self, model: ScanModel) -> None:
        """Loads the network.

        Raises:
            DataError: it is missing, does not load, or takes other range images than the file says.
            MissingDependencyError: onnxruntime is not installed.
        """
        self.model = model
        self._network = OnnxNetwork(model.network)
        expected = (1, CHANNELS, model.view.height, model.view.width)
        self._network.check_input(expected, "1 x 5 channels (range, x, y, z, remission) x height x width")
        if self._network.dtype == np.uint8:
            raise DataError(model.network, "an input of uint8", "one of floating-point numbers")

    @property
    def name(self) -> str:
        """Name of the YAML file or the folder."""
        return self.model.path.name

    @property
    def identity(self) -> str:
        """Identity of the network and of what is done with it."""
        model = self.model
        use = model.view, model.neighbours, model.output, model.output_name
        return self._network.identity(VERSION, model.numbers, use)

    @property
    def known(self) -> frozenset[SemanticClass]:
        """Classes that its class map names; no point of a scan is sky."""
        return self.model.numbers.known - {SemanticClass.SKY}

    def segment(self, scan: Scan) -> PointLabels:
        """Labels of a scan.

        Raises:
            DataError: outputs that are not what the file says.
        """
        if not len(scan.points):
            return PointLabels(np.zeros(0, np.uint8))
        image = self.model.view.project(scan)
        place = f"the scan stamped {scan.stamp_ns} ns"
        outputs = self._network.run(image.values, place)
        array = self._network.output(outputs, self.model.output_name)
        if self.model.output == "labels":
            return PointLabels(self._by_labels(array, image))
        size = (self.model.view.height, self.model.view.width)
        if array.ndim != 4 or array.shape[0] != 1 or array.shape[2:] != size or array.shape[1] < 2:
            found = f"logits of shape {array.shape}"
            raise DataError(self.model.network, found, f"1 x classes x {size[0]} x {size[1]}")
        classes = self.model.numbers.of_outputs(array.shape[1], self.model.network)
        numbers = np.asarray(array[0].argmax(axis=0), np.intp)
        return PointLabels(self._of_points(image, numbers, classes))

    def _by_labels(self, array: NDArray[Any], image: RangeImage) -> NDArray[np.uint8]:
        size = (self.model.view.height, self.model.view.width)
        whole = array.dtype.kind in "iu" or bool((array == np.floor(array)).all())
        if array.size != size[0] * size[1] or array.shape[-2:] != size or not whole:
            found = f"{'' if whole else 'no whole numbers in '}labels of shape {array.shape}"
            raise DataError(self.model.network, found, f"numbers of classes, 1 x {size[0]} x {size[1]}")
        pixels = self.model.numbers.of_labels(array.reshape(size).astype(np.int64), self.model.network)
        return self._of_points(image, pixels.astype(np.intp), np.arange(256, dtype=np.uint8))

    def _of_points(
        self, image: RangeImage, numbers: NDArray[np.intp], classes: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        found = image.of_points(numbers, self.model.neighbours, classes == SemanticClass.IGNORE)
        return np.append(classes, np.uint8(SemanticClass.IGNORE))[found]
