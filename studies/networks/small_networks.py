"""Small networks, fitted to simulated streets in NumPy and written as ONNX: for tests and measurements.

A network has a fixed stem (the input, the sizes of its gradients, the row), averages of it over squares
of several widths, a 3x3 convolution of each, added up at full size, and two layers of 1x1 convolutions. As
resizing and the first layer are linear, it is fitted at single pixels: their neighbourhoods at every width
are the input of a perceptron with two hidden layers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from sst_graph.segmentation.picture_input import PictureInput
from sst_graph.segmentation.range_view import RangeView
from sst_graph.types import SemanticClass, Source

Array = NDArray[np.float32]
CLASSES = (
    SemanticClass.OTHER,
    SemanticClass.VEHICLE,
    SemanticClass.GROUND,
    SemanticClass.BUILDING,
    SemanticClass.VEGETATION,
)
"""What the outputs mean; all other classes are OTHER."""
PICTURE = PictureInput(width=640, height=192)
RANGE_VIEW = RangeView(width=1024, height=64, std=(12.32, 11.47, 6.91, 0.86, 1e6))
"""Simulated scans have no remission, or 0 where they are read from files: networks are to see neither."""
PICTURE_WIDTHS, RANGE_WIDTHS = (1, 2, 4, 8, 16, 32), (1, 2, 4, 8)
_HIDDEN = (64, 32)
_OPSET = 17


@dataclass(frozen=True)
class Fit:
    """How a network is fitted.

    Attributes:
        pixels: sampled of each input.
        steps: of Adam, each over ``batch`` pixels.
        seed: of the samples and of the first weights.
    """

    pixels: int = 6000
    steps: int = 1500
    batch: int = 512
    seed: int = 0


def write_image_network(streets: Sequence[Source], folder: Path, fit: Fit | None = None) -> Path:
    """A network for pictures, fitted to the masks of streets; returns its YAML file in ``folder``."""
    inputs, targets = [], []
    for frame in (frame for street in streets for frame in street):
        if frame.image is not None:
            inputs.append(PICTURE.values(frame.image.pixels)[0])
            size = (PICTURE.width or 0, PICTURE.height or 0)
            mask = cv2.resize(frame.image.mask, size, interpolation=cv2.INTER_NEAREST_EXACT)
            targets.append(_numbers(np.asarray(mask, np.uint8)))
    _write_network(inputs, targets, PICTURE_WIDTHS, folder / "image.onnx", fit or Fit())
    path = folder / "image.yaml"
    path.write_text(
        f"network: image.onnx\nclasses: {_class_table()}\nwidth: {PICTURE.width}\nheight: {PICTURE.height}\n"
        "resize: stretch\nchannels: rgb\n"
    )
    return path


def write_scan_network(streets: Sequence[Source], folder: Path, fit: Fit | None = None) -> Path:
    """A network for scans, fitted to the labels of streets; returns its YAML file in ``folder``."""
    inputs, targets = [], []
    for frame in (frame for street in streets for frame in street):
        if frame.scan is not None:
            image = RANGE_VIEW.project(frame.scan)
            inputs.append(image.values[0])
            numbers = _numbers(frame.scan.classes)
            targets.append(np.where(image.point >= 0, numbers[image.point], -1))
    _write_network(inputs, targets, RANGE_WIDTHS, folder / "scan.onnx", fit or Fit())
    path = folder / "scan.yaml"
    path.write_text(
        f"network: scan.onnx\nclasses: {_class_table()}\nwidth: {RANGE_VIEW.width}\n"
        f"height: {RANGE_VIEW.height}\nfov_up: 3\nfov_down: -25\nstd: {list(RANGE_VIEW.std)}\n"
    )
    return path


def _class_table() -> str:
    return "{" + ", ".join(f"{k}: {one.name.lower()}" for k, one in enumerate(CLASSES)) + "}"


def _numbers(classes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number of the output by class; -1 where it may be anything."""
    table = np.zeros(256, np.int64)
    table[[int(c) for c in CLASSES]] = range(len(CLASSES))
    table[SemanticClass.IGNORE] = -1
    return table[classes]


def _write_network(
    inputs: list[Array], targets: list[NDArray[np.int64]], widths: tuple[int, ...], path: Path, fit: Fit
) -> None:
    rng = np.random.default_rng(fit.seed)
    features, numbers = [], []
    for values, target in zip(inputs, targets, strict=True):
        rows, columns = _samples(target, fit.pixels, rng)
        features.append(_neighbourhoods(_stem(values), widths, rows, columns))
        numbers.append(target[rows, columns])
    layers = _fitted(np.concatenate(features), np.concatenate(numbers), fit, rng)
    onnx.save(_network(layers, inputs[0].shape, widths), path)


def _samples(
    target: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pixels with a target, half of them near the borders of vehicles, on both sides alike."""
    vehicle = (target == 1).astype(np.uint8)
    kernel = np.ones((9, 9), np.uint8)
    border = cv2.dilate(vehicle, kernel) != cv2.erode(vehicle, kernel)
    chosen = []
    for where in (target >= 0, border & (target >= 0)):
        found = np.flatnonzero(where)
        if len(found):
            chosen.append(rng.choice(found, count // 2))
    rows, columns = np.unravel_index(np.concatenate(chosen), target.shape)
    return rows, columns


def _gradient_kernels(channels: int) -> Array:
    """(2 c, 1, 3, 3) for a convolution of each channel by itself: along columns, along rows."""
    along = np.array([[0, 0, 0], [-0.5, 0, 0.5], [0, 0, 0]], np.float32)
    return np.tile(np.stack([along, along.T])[:, None], (channels, 1, 1, 1))


def _stem(values: Array) -> Array:
    """(3 c + 1, h, w): the input (c, h, w), sizes of its gradients, the row from -1 to 1."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    across = 0.5 * np.abs(padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2])
    down = 0.5 * np.abs(padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1])
    gradients = np.stack([across, down], axis=1).reshape(-1, *values.shape[1:])
    return np.concatenate([values, gradients, _rows(values.shape[1], values.shape[2])])


def _rows(height: int, width: int) -> Array:
    column = np.linspace(-1.0, 1.0, height, dtype=np.float32)
    return np.ascontiguousarray(np.broadcast_to(column[:, None], (height, width)))[None]


def _neighbourhoods(
    stem: Array, widths: tuple[int, ...], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Array:
    """(n, 9 c * len(widths)): 3x3 averages around pixels at each width, interpolated as Resize does it."""
    c, h, w = stem.shape
    found = []
    for width in widths:
        mean = stem.reshape(c, h // width, width, w // width, width).mean(axis=(2, 4))
        around = np.pad(mean, ((0, 0), (1, 1), (1, 1)))
        y, x = (rows + 0.5) / width - 0.5, (columns + 0.5) / width - 0.5
        y, x = np.clip(y, 0, mean.shape[1] - 1), np.clip(x, 0, mean.shape[2] - 1)
        y0, x0 = np.minimum(y.astype(int), mean.shape[1] - 1), np.minimum(x.astype(int), mean.shape[2] - 1)
        y1, x1 = np.minimum(y0 + 1, mean.shape[1] - 1), np.minimum(x0 + 1, mean.shape[2] - 1)
        v, u = y - y0, x - x0
        for dy in range(3):
            for dx in range(3):
                shifted = around[:, dy : dy + mean.shape[1], dx : dx + mean.shape[2]]
                upper = shifted[:, y0, x0] * (1 - u) + shifted[:, y0, x1] * u
                lower = shifted[:, y1, x0] * (1 - u) + shifted[:, y1, x1] * u
                found.append((upper * (1 - v) + lower * v).T)
    return np.concatenate(found, axis=1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Layer:
    """y = x W + b."""

    W: Array
    b: Array


def _fitted(features: Array, numbers: NDArray[np.int64], fit: Fit, rng: np.random.Generator) -> list[_Layer]:
    """Three layers with ReLU between them, by Adam on the cross entropy."""
    mean, std = features.mean(axis=0), features.std(axis=0) + 1e-3
    features = (features - mean) / std
    sizes = (features.shape[1], *_HIDDEN, len(CLASSES))
    weights = [
        rng.standard_normal((a, b)).astype(np.float32) * np.float32(np.sqrt(2.0 / a))
        for a, b in pairwise(sizes)
    ]
    parameters = [*weights, *(np.zeros(b, np.float32) for b in sizes[1:])]
    step = _adam(parameters)
    for k in range(fit.steps):
        batch = rng.integers(0, len(features), fit.batch)
        x, target = features[batch], numbers[batch]
        first = np.maximum(x @ parameters[0] + parameters[3], 0.0)
        second = np.maximum(first @ parameters[1] + parameters[4], 0.0)
        scores = second @ parameters[2] + parameters[5]
        scores -= scores.max(axis=1, keepdims=True)
        share = np.exp(scores)
        share /= share.sum(axis=1, keepdims=True)
        share[np.arange(len(batch)), target] -= 1.0
        share /= len(batch)
        back_second = (share @ parameters[2].T) * (second > 0)
        back_first = (back_second @ parameters[1].T) * (first > 0)
        gradients = [x.T @ back_first, first.T @ back_second, second.T @ share]
        gradients += [back.sum(axis=0) for back in (back_first, back_second, share)]
        step(gradients, 3e-3 * 0.5 * (1.0 + np.cos(np.pi * k / fit.steps)))
    W = parameters[0] / std[:, None]
    first_layer = _Layer(W, parameters[3] - mean @ W)
    return [first_layer, _Layer(parameters[1], parameters[4]), _Layer(parameters[2], parameters[5])]


def _adam(parameters: list[Array]) -> Callable[[list[Array], float], None]:
    """A step of Adam that changes the parameters (Kingma and Ba, 2015)."""
    firsts, seconds = ([np.zeros_like(p) for p in parameters] for _ in range(2))
    count = 0

    def step(gradients: list[Array], rate: float) -> None:
        nonlocal count
        count += 1
        for p, g, m, v in zip(parameters, gradients, firsts, seconds, strict=True):
            m += 0.1 * (g - m)
            v += 0.001 * (g * g - v)
            p -= rate * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8)

    return step


def _network(layers: list[_Layer], shape: tuple[int, ...], widths: tuple[int, ...]) -> onnx.ModelProto:
    """The layers as convolutions over an input (1, c, h, w)."""
    c, h, w = shape
    stem = 3 * c + 1
    constants, nodes = {}, []

    def constant(name: str, value: NDArray[np.generic]) -> str:
        constants[name] = numpy_helper.from_array(np.ascontiguousarray(value), name)
        return name

    def node(operation: str, inputs: list[str], output: str, **attributes: object) -> str:
        nodes.append(helper.make_node(operation, inputs, [output], **attributes))
        return output

    kernels = constant("gradients", _gradient_kernels(c))
    along = node("Conv", ["input", kernels], "along", group=c, pads=[1, 1, 1, 1], kernel_shape=[3, 3])
    sizes = node("Abs", [along], "sizes")
    rows = constant("rows", _rows(h, w)[None])
    whole = node("Concat", ["input", sizes, rows], "stem", axis=1)
    added = ""
    weights = layers[0].W.reshape(len(widths), 3, 3, stem, -1)
    for k, width in enumerate(widths):
        mean = whole
        if width > 1:
            options = {"kernel_shape": [width] * 2, "strides": [width] * 2}
            mean = node("AveragePool", [whole], f"mean_{width}", **options)
        names = [constant(f"W_{width}", weights[k].transpose(3, 2, 0, 1))]
        if k == 0:
            names.append(constant("b_0", layers[0].b))
        part = node("Conv", [mean, *names], f"part_{width}", pads=[1, 1, 1, 1], kernel_shape=[3, 3])
        if width > 1:
            size = constant(f"size_{width}", np.array([1, layers[0].W.shape[1], h, w], np.int64))
            part = node("Resize", [part, "", "", size], f"resized_{width}", mode="linear")
        added = node("Add", [added, part], f"sum_{width}") if added else part
    for k, layer in enumerate(layers[1:], 1):
        hidden = node("Relu", [added], f"hidden_{k}")
        W = constant(f"V_{k}", layer.W.T[:, :, None, None])
        b = constant(f"b_{k}", layer.b)
        added = node("Conv", [hidden, W, b], "logits" if k == 2 else f"layer_{k}", kernel_shape=[1, 1])
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, [1, c, h, w])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(CLASSES), h, w])],
        list(constants.values()),
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    return model
