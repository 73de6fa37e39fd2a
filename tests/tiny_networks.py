"""ONNX networks of a few operations, whose outputs are known beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from sst_graph.types import Scan, SemanticClass, with_intensities

Node = tuple[str, list[str], list[str], dict[str, Any]]


def write_network(
    path: Path,
    nodes: Sequence[Node],
    shape: Sequence[int | str],
    outputs: Sequence[tuple[str, int]],
    constants: dict[str, np.ndarray] | None = None,
    kind: int = TensorProto.FLOAT,
) -> Path:
    """A network of nodes (operation, inputs, outputs, attributes) on ``input`` of a shape.

    Args:
        outputs: names and types (TensorProto.FLOAT, ...); shapes are left open.
        kind: type of the input.
    """
    graph = helper.make_graph(
        [helper.make_node(op, ins, outs, **attributes) for op, ins, outs, attributes in nodes],
        "tiny",
        [helper.make_tensor_value_info("input", kind, list(shape))],
        [helper.make_tensor_value_info(name, kind, None) for name, kind in outputs],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, path)
    return path


def write_colour_network(path: Path, stride: int = 1, nhwc: bool = False, labels: bool = False) -> Path:
    """Outputs: how much brighter than 0.5 the red channel is, less that, and -9; so class 0 where it is red.

    Args:
        stride: of the output, by averaging.
        nhwc: input and output with the channels last.
        labels: the number of the class instead.
    """
    W = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, 0]], np.float32)[:, :, None, None]
    nodes: list[Node] = []
    now = "input"
    if nhwc:
        nodes.append(("Transpose", [now], ["first"], {"perm": [0, 3, 1, 2]}))
        now = "first"
    if stride > 1:
        nodes.append(
            ("AveragePool", [now], ["mean"], {"kernel_shape": [stride] * 2, "strides": [stride] * 2})
        )
        now = "mean"
    nodes.append(("Conv", [now, "W", "b"], ["scores"], {"kernel_shape": [1, 1]}))
    now, kind = "scores", TensorProto.FLOAT
    if labels:
        nodes.append(("ArgMax", [now], ["numbers"], {"axis": 1, "keepdims": 0}))
        now, kind = "numbers", TensorProto.INT64
    elif nhwc:
        nodes.append(("Transpose", [now], ["last"], {"perm": [0, 2, 3, 1]}))
        now = "last"
    shape = [1, "h", "w", 3] if nhwc else [1, 3, "h", "w"]
    return write_network(
        path, nodes, shape, [(now, kind)], {"W": W, "b": np.array([-0.5, 0.5, -9], np.float32)}
    )


PLAIN = "range: 255\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n"
"""Of a YAML file: pixels from 0 to 1."""


def colour_yaml(path: Path, more: str = "") -> Path:
    """The YAML file of a network at ``path`` (.onnx); red is a vehicle, the rest ground."""
    described = path.with_suffix(".yaml")
    described.write_text(f"network: {path.name}\nclasses: {{0: vehicle, 1: ground, 2: sky}}\n{PLAIN}{more}")
    return described


def write_range_network(path: Path, size: tuple[int, int] = (16, 64), classes: int = 3) -> Path:
    """Outputs on range images: -1 for unlabelled, z for car, -z for road (and -9 for further ones)."""
    W = np.zeros((classes, 5, 1, 1), np.float32)
    W[1, 3], W[2, 3] = 1.0, -1.0
    b = np.full(classes, -9.0, np.float32)
    b[:3] = (-1.0, 0.0, 0.0)
    nodes: list[Node] = [("Conv", ["input", "W", "b"], ["logits"], {"kernel_shape": [1, 1]})]
    outputs = [("logits", TensorProto.FLOAT)]
    return write_network(path, nodes, [1, 5, *size], outputs, {"W": W, "b": b})


def range_yaml(path: Path, more: str = "", size: tuple[int, int] = (16, 64)) -> Path:
    """The YAML file of a network at ``path``: what is above the sensor is a vehicle, the rest ground."""
    described = path.with_suffix(".yaml")
    described.write_text(
        f"network: {path.name}\nclasses: {{0: ignore, 1: vehicle, 2: ground}}\nwidth: {size[1]}\n"
        f"height: {size[0]}\nmean: [0, 0, 0, 0, 0]\nstd: [1, 1, 1, 1, 1]\n{more}"
    )
    return described


def scan_of(points: np.ndarray, intensities: np.ndarray | None = None) -> Scan:
    """A scan without labels of points (n, 3)."""
    classes = np.full(len(points), SemanticClass.IGNORE, np.uint8)
    return with_intensities(Scan(7, points.astype(np.float32), classes), intensities)
