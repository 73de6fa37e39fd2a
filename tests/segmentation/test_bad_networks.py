"""What cannot be used as a network is refused in one line that says what was found and expected."""

from __future__ import annotations

import builtins
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto
from tiny_networks import (
    PLAIN,
    colour_yaml,
    range_yaml,
    write_colour_network,
    write_network,
    write_range_network,
)

from sst_graph.cli import main
from sst_graph.errors import MissingDependencyError, SstGraphError
from sst_graph.segmentation import open_image_segmenter, open_scan_segmenter
from sst_graph.types import CameraImage, Scan, SemanticClass

IMAGE = CameraImage(5, np.zeros((32, 64), np.uint8), np.full((32, 64, 3), 90, np.uint8))
SCAN = Scan(5, np.array([[5.0, 1, 0.1], [9, -2, -1]], np.float32), np.full(2, SemanticClass.IGNORE, np.uint8))

Made = Callable[[Path], Path]


def colour(more: str = "", **options: Any) -> Made:
    return lambda folder: colour_yaml(write_colour_network(folder / "n.onnx", **options), more)


def described(text: str, network: Made | None = None) -> Made:
    def make(folder: Path) -> Path:
        (network or (lambda f: write_colour_network(f / "n.onnx")))(folder)
        (folder / "n.yaml").write_text(text)
        return folder / "n.yaml"

    return make


def of_bytes(data: bytes) -> Made:
    def make(folder: Path) -> Path:
        (folder / "n.onnx").write_bytes(data)
        return colour_yaml(folder / "n.onnx")

    return make


def truncated(folder: Path) -> Path:
    path = write_colour_network(folder / "n.onnx")
    path.write_bytes(path.read_bytes()[:-40])
    return colour_yaml(path)


def fifo(folder: Path) -> Path:
    os.mkfifo(folder / "n.onnx")
    return colour_yaml(folder / "n.onnx")


def nan_logits(folder: Path) -> Path:
    nodes = [("Log", ["input"], ["logits"], {})]  # of 0 - 1
    write_network(folder / "n.onnx", nodes, [1, 3, "h", "w"], [("logits", TensorProto.FLOAT)])
    (folder / "n.yaml").write_text("network: n.onnx\nclasses: {0: sky, others: vehicle}\nmean: [1, 1, 1]\n")
    return folder / "n.yaml"


def failing(folder: Path) -> Path:
    nodes = [("Reshape", ["input", "size"], ["logits"], {})]
    constants = {"size": np.array([1, 7, 11, 13], np.int64)}
    write_network(folder / "n.onnx", nodes, [1, 3, "h", "w"], [("logits", TensorProto.FLOAT)], constants)
    return colour_yaml(folder / "n.onnx")


def flat(folder: Path) -> Path:
    nodes = [("GlobalAveragePool", ["input"], ["logits"], {})]
    write_network(folder / "n.onnx", nodes, [1, 3, "h", "w"], [("logits", TensorProto.FLOAT)])
    return colour_yaml(folder / "n.onnx")


def of_rank_three(folder: Path) -> Path:
    nodes = [("Relu", ["input"], ["logits"], {})]
    write_network(folder / "n.onnx", nodes, [3, "h", "w"], [("logits", TensorProto.FLOAT)])
    return colour_yaml(folder / "n.onnx")


def of_fixed_size(folder: Path) -> Path:
    nodes = [("Relu", ["input"], ["logits"], {})]
    write_network(folder / "n.onnx", nodes, [1, 3, 48, 96], [("logits", TensorProto.FLOAT)])
    return colour_yaml(folder / "n.onnx", "width: 96\nheight: 64\n")


def of_bytes_in(more: str) -> Made:
    """A network that takes pixels as they are, and a file that says otherwise."""

    def make(folder: Path) -> Path:
        cast = ("Cast", ["input"], ["logits"], {"to": TensorProto.FLOAT})
        shape, outputs = [1, 3, "h", "w"], [("logits", TensorProto.FLOAT)]
        write_network(folder / "n.onnx", [cast], shape, outputs, kind=TensorProto.UINT8)
        (folder / "n.yaml").write_text(f"network: n.onnx\nclasses: {{0: sky, others: vehicle}}\n{more}")
        return folder / "n.yaml"

    return make


def auxiliary_first(folder: Path) -> Path:
    """Of two outputs the first is another one, of one channel."""
    nodes = [
        ("ReduceMean", ["input"], ["aux"], {"axes": [1]}),
        ("Relu", ["input"], ["main"], {}),
    ]
    outputs = [("aux", TensorProto.FLOAT), ("main", TensorProto.FLOAT)]
    write_network(folder / "n.onnx", nodes, [1, 3, "h", "w"], outputs)
    return colour_yaml(folder / "n.onnx")


BAD_IMAGE_MODELS: dict[str, tuple[Made, str]] = {
    "no file": (lambda folder: folder / "n.yaml", "n.yaml: found no file or folder, expected a YAML file, "),
    "a folder": (lambda folder: folder, "found a folder, expected a YAML file, a folder with config.json"),
    "no network": (described("network: m.onnx\nclasses: coco\n"), "m.onnx: found no such file"),
    "empty network": (of_bytes(b""), "n.onnx: found no network that loads"),
    "no onnx": (of_bytes(b"\x00\xff" * 500), "n.onnx: found no network that loads"),
    "truncated": (truncated, "n.onnx: found no network that loads"),
    "a FIFO": (fifo, "n.onnx: found a FIFO, expected an ONNX network"),
    "no yaml": (described("a: [1"), "n.yaml: found no YAML"),
    "an unknown key": (colour("colour: rgb\n"), "found the key 'colour', expected some of network, classes"),
    "a network for scans": (
        colour("fov_up: 3\n"),
        "layout, output, outputs, min_score; a network for scans (--lidar-model) has that key",
    ),
    "an empty file": (described(""), "n.yaml: found nothing, expected a table"),
    "no classes": (described("network: n.onnx\n"), "n.yaml: found no classes"),
    "an unknown map": (
        described("network: n.onnx\nclasses: pascal\n"),
        "classes: found 'pascal', expected one of cityscapes-ids, cityscapes-trainids, mapillary",
    ),
    "an unknown class": (
        described("network: n.onnx\nclasses: {0: lorry}\n"),
        "found the class 'lorry', expected one of other, vehicle, ground",
    ),
    "a number that is none": (
        described("network: n.onnx\nclasses: {zero: vehicle}\n"),
        "classes: found the number 'zero', expected 0 to 65535, or others",
    ),
    "too many classes": (
        described("network: n.onnx\nclasses: cityscapes-trainids\n" + PLAIN),
        "n.onnx: found 3 outputs a pixel, expected 19, one a class of cityscapes-trainids",
    ),
    "too few classes": (
        described("network: n.onnx\nclasses: {0: vehicle, 1: ground}\n" + PLAIN),
        "n.onnx: found 3 outputs a pixel, and no class for output 2, expected a class for each in",
    ),
    "classes beyond": (
        described("network: n.onnx\nclasses: {0: vehicle, 7: ground, others: other}\n" + PLAIN),
        "n.onnx: found 3 outputs a pixel, expected more than 7",
    ),
    "a mean of two": (
        described("network: n.onnx\nclasses: coco\nmean: [0, 1]\n"),
        "mean: found 2 numbers, expected 3",
    ),
    "std of 0": (
        described("network: n.onnx\nclasses: coco\nstd: [1, 0, 1]\n"),
        "std: found 0, expected positive numbers",
    ),
    "a range that is none": (
        described("network: n.onnx\nclasses: coco\nrange: 1.0e-300\n"),
        "found a value of 1.14e+303 in range, mean, std or what they make of a pixel, expected at most 1e+06",
    ),
    "a width of -1": (
        described("network: n.onnx\nclasses: coco\nwidth: -1\n"),
        "width: found -1, expected 1 to",
    ),
    "an output of three": (
        described("network: n.onnx\nclasses: coco\noutput: boxes\n"),
        "output: found 'boxes', expected one of logits, labels, instances",
    ),
    "logits for labels": (colour("output: labels\n"), "n.onnx: found labels of shape"),
    "labels for logits": (colour(labels=True), "n.onnx: found logits of shape"),
    "the other layout": (
        colour("layout: nhwc\n"),
        "n.onnx: found its 3 channels elsewhere, expected 1 x height x width x 3 channels",
    ),
    "another size": (of_fixed_size, "n.onnx: found an input of 1x3x48x96, expected 1x3x64x96"),
    "rank 3": (of_rank_three, "n.onnx: found an input of 3xanyxany, expected 1x3xanyxany, 1 x 3 channels"),
    "one value a picture": (flat, "n.onnx: found logits of shape (1, 3, 1, 1), expected 1 x classes x h x w"),
    "NaN": (nan_logits, "n.onnx: found NaN or inf in its output logits on the image stamped 5 ns"),
    "a failure": (failing, "n.onnx: found a failure on the image stamped 5 ns"),
    "no such output": (
        colour("outputs: {logits: seg}\n"),
        "n.onnx: found outputs scores, expected one called seg",
    ),
    "the first of two outputs": (
        auxiliary_first,
        "found logits of shape (1, 1, 32, 64) in the output aux of aux, main, expected 1 x classes x h x w "
        "or 1 x h x w x classes, h x w of 32 x 64, or less by a stride up to 32 (another one: outputs: {",
    ),
    "pixels scaled for an input of uint8": (
        of_bytes_in(""),
        "n.onnx: found an input of uint8, which takes the pixels as they are, expected range: 1, mean: [0, 0",
    ),
    "0 to 1 for an input of uint8": (of_bytes_in(PLAIN), "n.onnx: found an input of uint8, which takes"),
    "no instances": (
        colour("output: instances\n"),
        "n.onnx: found outputs scores, expected one called labels",
    ),
}


@pytest.mark.parametrize("name", BAD_IMAGE_MODELS)
def test_bad_network_for_pictures_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD_IMAGE_MODELS[name]
    with pytest.raises(SstGraphError) as error:
        open_image_segmenter(make(tmp_path)).segment(IMAGE)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1300


def ranged(more: str = "", size: tuple[int, int] = (16, 64), **options: Any) -> Made:
    return lambda folder: range_yaml(write_range_network(folder / "n.onnx", **options), more, size)


def of_bytes_of_a_range_image(folder: Path) -> Path:
    cast = ("Cast", ["input"], ["logits"], {"to": TensorProto.FLOAT})
    outputs = [("logits", TensorProto.FLOAT)]
    write_network(folder / "n.onnx", [cast], [1, 5, 16, 64], outputs, kind=TensorProto.UINT8)
    return range_yaml(folder / "n.onnx")


BAD_SCAN_MODELS: dict[str, tuple[Made, str]] = {
    "no file": (lambda folder: folder / "n.yaml", "n.yaml: found no file or folder, expected a YAML file, "),
    "no arch_cfg": (lambda folder: folder, "arch_cfg.yaml: found no such file"),
    "another size": (
        ranged(size=(32, 64)),
        "found an input of 1x5x16x64, expected 1x5x32x64, 1 x 5 channels",
    ),
    "a network for pictures": (
        lambda folder: range_yaml(write_colour_network(folder / "n.onnx")),
        "n.onnx: found an input of 1x3xanyxany, expected 1x5x16x64",
    ),
    "an input of uint8": (
        of_bytes_of_a_range_image,
        "found an input of uint8, expected one of float",
    ),
    "too many outputs": (ranged(classes=5), "n.onnx: found 5 outputs a pixel, and no class for output 3"),
    "an even window": (
        ranged("neighbours: {window: 4}\n"),
        "neighbours: window: found 4, expected an odd number",
    ),
    "no window": (ranged("neighbours: {window: 0}\n"), "neighbours: window: found 0, expected 1 to 31"),
    "an unknown key": (
        ranged("neighbours: {k: 4}\n"),
        "neighbours: found the key 'k', expected some of count",
    ),
    "the file of a network for pictures": (
        ranged("layout: nhwc\n"),
        "output_name; a network for pictures (--image-model) has that key",
    ),
    "upside down": (ranged("fov_up: -30\n"), "found a field of view from -25 to -30 deg"),
    "labels that are logits": (ranged("output: labels\n"), "labels of shape (1, 3, 16, 64)"),
}


@pytest.mark.parametrize("name", BAD_SCAN_MODELS)
def test_bad_network_for_scans_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD_SCAN_MODELS[name]
    with pytest.raises(SstGraphError) as error:
        open_scan_segmenter(make(tmp_path)).segment(SCAN)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_any_damage_to_a_network_is_refused_or_harmless(tmp_path: Path) -> None:
    """Bytes changed and cut at random: nothing but our own errors, and no crash."""
    path = write_colour_network(tmp_path / "n.onnx")
    data, described = path.read_bytes(), colour_yaml(path)
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(150):
        changed = bytearray(data)
        for _ in range(int(rng.integers(1, 5))):
            changed[rng.integers(len(changed))] = rng.integers(256)
        path.write_bytes(bytes(changed[: rng.integers(1, len(data))] if rng.random() < 0.3 else changed))
        try:
            labels = open_image_segmenter(described).segment(IMAGE)
        except SstGraphError as error:
            refused += 1
            assert "\n" not in str(error)
        else:
            assert labels.mask.shape == (32, 64)
    assert refused > 50


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("onnxruntime", "networks need onnxruntime, which is not installed: pip install 'sst-graph[onnx]'"),
        ("yaml", "reading YAML needs PyYAML, which is not installed: pip install 'sst-graph[yaml]'"),
    ],
)
def test_a_missing_extra_is_named(
    module: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = colour()(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=message.replace("[", r"\[")):
        open_image_segmenter(path)


def test_missing_transformers_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "config.json").write_text("{}")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sst-graph\[hf\]'"):
        open_image_segmenter(tmp_path)


def test_the_command_line_ends_with_2_and_one_line(
    kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = str(of_bytes(b"none")(tmp_path))
    out = ["--out", str(tmp_path / "out")]
    for command in (
        ["segment", str(kitti_drive), "--image-model", model, *out],
        ["calibrate", str(kitti_drive), "--image-model", model, *out],
        ["track", str(kitti_drive), "--image-model", model],
        ["info", str(kitti_drive), "--image-model", model],
    ):
        assert main(command) == 2
        captured = capsys.readouterr()
        assert captured.err.count("\n") == 1
        assert "n.onnx: found no network that loads" in captured.err
        assert not (tmp_path / "out").exists()


def test_labels_of_no_use_are_refused_before_they_are_made(
    kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = write_colour_network(tmp_path / "n.onnx")
    out = tmp_path / "out"
    command = ["segment", str(kitti_drive), "--image-model", str(model.with_suffix(".yaml"))]
    described(f"network: n.onnx\nclasses: {{0: other, 1: ground, 2: sky}}\n{PLAIN}")(tmp_path)
    assert main([*command, "--out", str(out)]) == 2
    assert "found no class that can be aligned among its classes" in capsys.readouterr().err
    assert not out.exists()


def test_labels_without_vehicles_say_what_calibrate_has_to_be_told(
    kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_colour_network(tmp_path / "n.onnx")
    model = described(f"network: n.onnx\nclasses: {{0: pole, 1: ground, 2: fence}}\n{PLAIN}")(tmp_path)
    assert (
        main(["segment", str(kitti_drive), "--image-model", str(model), "--out", str(tmp_path / "out")]) == 0
    )
    assert "knows no vehicles: calibrate with --classes pole,fence" in capsys.readouterr().err


def test_the_library_starts_without_the_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither importing the package nor reading its help imports what a network runs by."""
    found: list[str] = []

    def watched(real: Callable[..., Any]) -> Callable[..., Any]:
        def imported(name: str, *args: Any, **kwargs: Any) -> Any:
            if name.partition(".")[0] in ("onnxruntime", "torch", "transformers", "onnx"):
                found.append(name)
            return real(name, *args, **kwargs)

        return imported

    for name in [name for name in sys.modules if name.startswith("sst_graph.segmentation")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", watched(builtins.__import__))
    monkeypatch.setattr(importlib, "import_module", watched(importlib.import_module))
    __import__("sst_graph.segmentation")
    assert found == []


def test_a_damaged_network_says_nothing_of_its_own(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Every byte in turn to 0xff: onnxruntime's fallback to other providers prints on stdout."""
    path = write_colour_network(tmp_path / "n.onnx")
    valid = path.read_bytes()
    refused = 0
    for k in range(0, len(valid), 7):
        path.write_bytes(valid[:k] + b"\xff" + valid[k + 1 :])
        try:
            open_image_segmenter(colour_yaml(path))
        except SstGraphError as error:
            refused += 1
            assert str(error).isprintable()
    assert refused > 5
    assert capfd.readouterr() == ("", "")
