"""Reading what describes a network: a YAML file beside it, or the folder of lidar-bonnetal."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from sst_graph.classes import class_of_name
from sst_graph.errors import DataError
from sst_graph.files.yaml_file import number, numbers, read_yaml
from sst_graph.segmentation.hugging_face import HuggingFaceSegmenter
from sst_graph.segmentation.image_network import MIN_SCORE, ImageModel, OnnxImageSegmenter
from sst_graph.segmentation.label_numbers import LabelNumbers, label_numbers
from sst_graph.segmentation.onnx_network import weights_beside
from sst_graph.segmentation.picture_input import PictureInput
from sst_graph.segmentation.range_view import CHANNELS, Neighbours, RangeView
from sst_graph.segmentation.scan_network import OnnxScanSegmenter, ScanModel
from sst_graph.segmentation.segmenter import ImageSegmenter, ScanSegmenter
from sst_graph.types import SemanticClass

T = TypeVar("T")

HUB = "hf:"
"""Begins the name of a model on Hugging Face's hub."""
_YAML = (".yaml", ".yml")
_MAX_SIZE = 16_384
"""Width and height of an input [px]."""
_INPUT_KEYS = ("width", "height", "resize", "channels", "range", "mean", "std", "layout")
_OUTPUT_NAMES = ("logits", "labels", "boxes", "scores", "masks")
_IMAGE_KEYS = ("network", "classes", *_INPUT_KEYS, "output", "outputs", "min_score")
_VIEW_KEYS = ("width", "height", "fov_up", "fov_down", "mean", "std", "remission_range")
_SCAN_KEYS = ("network", "classes", *_VIEW_KEYS, "neighbours", "output", "output_name")
_NEIGHBOUR_KEYS = ("count", "window", "sigma", "cutoff")
_ARCH, _DATA, _MODEL = "arch_cfg.yaml", "data_cfg.yaml", "model.onnx"


def open_image_segmenter(model: str | Path) -> ImageSegmenter:
    """The network for pictures that a path or a name stands for.

    Args:
        model: a YAML file that describes an ONNX network or a Hugging Face model, a folder of Hugging Face's,
            or "hf:" and a model's name on the hub.

    Raises:
        DataError: nothing there, or what cannot be used.
        MissingDependencyError: what it runs by is not installed.
    """
    if str(model).startswith(HUB):
        return HuggingFaceSegmenter(str(model).removeprefix(HUB))
    path = Path(model)
    if os.path.isfile(path / "config.json"):
        return HuggingFaceSegmenter(path)
    path = _described(path, f"a YAML file, a folder with config.json, or {HUB}NAME")
    table = read_yaml(path)
    if "hugging_face" in table:
        _refuse_others(table, ("hugging_face", "classes"), path)
        folder = path.parent / _text(table, "hugging_face", path)
        name = folder if folder.is_dir() else table["hugging_face"]
        known = label_numbers(table["classes"], f"{path}: classes") if "classes" in table else None
        return HuggingFaceSegmenter(name, known, str(path))
    return OnnxImageSegmenter(image_model(path, table))


def open_scan_segmenter(model: str | Path) -> ScanSegmenter:
    """The network for scans that a path stands for: a YAML file, or the folder of a lidar-bonnetal model.

    Raises:
        DataError: nothing there, or what cannot be used.
        MissingDependencyError: onnxruntime is not installed.
    """
    path = Path(model)
    if os.path.isdir(path):
        return OnnxScanSegmenter(bonnetal_model(path))
    path = _described(path, f"a YAML file, or a folder with {_ARCH}, {_DATA} and {_MODEL}")
    return OnnxScanSegmenter(scan_model(path, read_yaml(path)))


def model_files(model: str | Path) -> tuple[Path, ...]:
    """The files that a network for pictures or scans is made from; none of one on a hub.

    Raises:
        DataError: nothing there, or no description of a network.
    """
    if str(model).startswith(HUB):
        return ()
    path = Path(model)
    if os.path.isdir(path):
        return tuple(sorted(one for one in path.iterdir() if one.is_file()))
    path = _described(path, "a YAML file, or a folder with a network")
    table = read_yaml(path)
    if "hugging_face" in table:
        folder = path.parent / _text(table, "hugging_face", path)
        return (path, *(model_files(folder) if os.path.isdir(folder) else ()))
    network = path.parent / _text(table, "network", path)
    return (path, network, *weights_beside(network))


_LARGEST_INPUT = 1e6
"""Largest value of a pixel that a network for pictures is given: those of real ones are below 256."""


def image_model(path: Path, table: Mapping[str, Any]) -> ImageModel:
    """What the table of a YAML file says of a network for pictures.

    Raises:
        DataError: an unknown key, or a value out of its range.
    """
    _refuse_others(table, _IMAGE_KEYS, path, _SCAN_KEYS, "scans (--lidar-model)")
    default = PictureInput()
    values = PictureInput(
        width=_size(table, "width", path),
        height=_size(table, "height", path),
        resize=_choice(table, "resize", ("stretch", "letterbox"), path),
        channels=_choice(table, "channels", ("rgb", "bgr"), path),
        range=_positive(table, "range", default.range, path),
        mean=_triple(table, "mean", default.mean, path),
        std=_triple(table, "std", default.std, path, positive=True),
        layout=_choice(table, "layout", ("nchw", "nhwc"), path),
    )
    if not values.largest <= _LARGEST_INPUT:
        found = f"a value of {values.largest:.3g} in range, mean, std or what they make of a pixel"
        raise DataError(path, found, f"at most {_LARGEST_INPUT:g}")
    return ImageModel(
        path=path,
        network=path.parent / _text(table, "network", path),
        numbers=_numbers(table, path),
        input=values,
        output=_choice(table, "output", ("logits", "labels", "instances"), path),
        outputs=_names(table, path),
        min_score=_positive(table, "min_score", MIN_SCORE, path),
    )


def scan_model(path: Path, table: Mapping[str, Any]) -> ScanModel:
    """What the table of a YAML file says of a network for scans.

    Raises:
        DataError: an unknown key, or a value out of its range.
    """
    _refuse_others(table, _SCAN_KEYS, path, _IMAGE_KEYS, "pictures (--image-model)")
    default = RangeView()
    view = RangeView(
        width=_size(table, "width", path) or default.width,
        height=_size(table, "height", path) or default.height,
        fov_up_deg=_number(table, "fov_up", default.fov_up_deg, path),
        fov_down_deg=_number(table, "fov_down", default.fov_down_deg, path),
        mean=_channels(table, "mean", default.mean, path),
        std=_channels(table, "std", default.std, path),
        remission_range=_positive(table, "remission_range", default.remission_range, path),
    )
    return ScanModel(
        path=path,
        network=path.parent / _text(table, "network", path),
        numbers=_numbers(table, path),
        view=_checked_view(view, path),
        neighbours=_neighbours(table.get("neighbours", {}), _NEIGHBOUR_KEYS, f"{path}: neighbours"),
        output=_choice(table, "output", ("logits", "labels"), path),
        output_name=_text(table, "output_name", path) if "output_name" in table else None,
    )


def bonnetal_model(folder: Path) -> ScanModel:
    """The network in a folder of lidar-bonnetal, RangeNet++ and those who kept its layout (SalsaNext, CENet).

    Raises:
        DataError: a file is missing, or lacks what the network needs to be used.
    """
    arch, data = read_yaml(folder / _ARCH), read_yaml(folder / _DATA)
    place = folder / _ARCH
    sensor = _below(arch, ("dataset", "sensor"), place)
    size = _below(sensor, ("img_prop",), place)
    view = RangeView(
        width=_size(size, "width", place) or 0,
        height=_size(size, "height", place) or 0,
        fov_up_deg=_number(sensor, "fov_up", None, place),
        fov_down_deg=_number(sensor, "fov_down", None, place),
        mean=_channels(sensor, "img_means", None, place),
        std=_channels(sensor, "img_stds", None, place),
    )
    if not view.width or not view.height:
        raise DataError(
            place, "no dataset: sensor: img_prop: width and height", "the size of the range image"
        )
    neighbours = None
    voting = arch.get("post", {}).get("KNN", {}) if isinstance(arch.get("post"), dict) else {}
    if isinstance(voting, dict) and voting.get("use", False):
        keys = ("knn", "search", "sigma", "cutoff")
        neighbours = _neighbours(voting.get("params", {}), keys, f"{place}: post: KNN: params")
    return ScanModel(
        folder,
        folder / _MODEL,
        _bonnetal_numbers(data, folder / _DATA),
        _checked_view(view, place),
        neighbours,
    )


def _bonnetal_numbers(data: Mapping[str, Any], place: Path) -> LabelNumbers:
    """By the data set's own names of what ``learning_map_inv`` says of each output."""
    inverse, names = _below(data, ("learning_map_inv",), place), _below(data, ("labels",), place)
    ignored = data.get("learning_ignore", {})
    classes: dict[int, SemanticClass] = {}
    for output, label in inverse.items():
        name = names.get(label) if isinstance(label, int) else None
        if not isinstance(output, int) or not isinstance(name, str):
            raise DataError(place, f"learning_map_inv: {output!r:.20}: {label!r:.20}", "numbers of labels")
        if isinstance(ignored, dict) and ignored.get(output) is True:
            classes[output] = SemanticClass.IGNORE
            continue
        known = class_of_name(name)
        if known is None:
            expected = "a name of a public data set; other ones need a YAML file with network: and classes:"
            raise DataError(place, f"the label {name!r:.40} of an unknown class", expected)
        classes[output] = known
    return LabelNumbers(str(place), classes, None, len(classes))


def _described(path: Path, expected: str) -> Path:
    """The YAML file of a network: itself, or the one beside an ONNX file."""
    if not os.path.lexists(path):
        raise DataError(path, "no file or folder", expected)
    if path.suffix.lower() == ".onnx":
        for suffix in _YAML:
            if os.path.isfile(path.with_suffix(suffix)):
                return path.with_suffix(suffix)
        raise DataError(
            path, f"no {path.stem}.yaml beside it", "a YAML file that says how the network is used"
        )
    if os.path.isdir(path) or path.suffix.lower() not in _YAML:
        raise DataError(path, "a folder" if os.path.isdir(path) else f"a file {path.suffix!r:.20}", expected)
    return path


def _refuse_others(
    table: Mapping[str, Any],
    keys: tuple[str, ...],
    place: str | Path,
    of_others: tuple[str, ...] = (),
    others: str = "",
) -> None:
    """Refuse keys that are none of these; of_others: keys of the networks that ``others`` names.

    Those come first: they tell more.
    """
    unknown = sorted((key for key in table if key not in keys), key=lambda key: key not in of_others)
    if unknown:
        key, expected = unknown[0], f"some of {', '.join(keys)}"
        if key in of_others:
            expected += f"; a network for {others} has that key"
        raise DataError(place, f"the key {key!r:.40}", expected)


def _numbers(table: Mapping[str, Any], path: Path) -> LabelNumbers:
    if "classes" not in table:
        raise DataError(path, "no classes", "classes: what the network's outputs mean")
    return label_numbers(table["classes"], f"{path}: classes")


def _neighbours(value: Any, keys: tuple[str, ...], place: str) -> Neighbours | None:
    """From count, window, sigma and cutoff under the given keys; ``false``: none."""
    if value is False or value is None:
        return None
    if not isinstance(value, dict):
        raise DataError(place, f"{value!r:.40}", f"a table of {', '.join(keys)}, or false")
    _refuse_others(value, keys, place)
    default = Neighbours()
    count, window = (value.get(key, 5) for key in keys[:2])
    for key, one in zip(keys[:2], (count, window), strict=True):
        if isinstance(one, bool) or not isinstance(one, int) or not 1 <= one <= 31:
            raise DataError(f"{place}: {key}", f"{one!r:.40}", "1 to 31")
    if window % 2 == 0:
        raise DataError(f"{place}: {keys[1]}", f"{window}", "an odd number: the pixel stands in the middle")
    sigma = _positive(value, keys[2], default.sigma_px, place)
    cutoff = _number(value, keys[3], default.cutoff_m, place)
    return Neighbours(count, window, sigma, max(cutoff, 0.0))


def _checked_view(view: RangeView, place: str | Path) -> RangeView:
    if not -90.0 <= view.fov_down_deg < view.fov_up_deg <= 90.0:
        found = f"a field of view from {view.fov_down_deg:g} to {view.fov_up_deg:g} deg"
        raise DataError(place, found, "fov_down below fov_up, within -90 to 90 deg")
    if min(view.std) <= 0.0:
        raise DataError(place, f"a standard deviation of {min(view.std):g}", "positive ones")
    return view


def _below(table: Mapping[Any, Any], keys: tuple[str, ...], place: str | Path) -> dict[Any, Any]:
    value: Any = table
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    if not isinstance(value, dict):
        raise DataError(place, f"no table {': '.join(keys)}", "the file of a trained network")
    return value


def _text(table: Mapping[str, Any], key: str, place: str | Path) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise DataError(f"{place}: {key}", "nothing" if value is None else f"{value!r:.40}", "a name")
    return value


def _choice(table: Mapping[str, Any], key: str, choices: tuple[T, ...], place: str | Path) -> T:
    """One of the choices; the first where the key is not there."""
    value = table.get(key, choices[0])
    if value not in choices:
        raise DataError(f"{place}: {key}", f"{value!r:.40}", f"one of {', '.join(map(str, choices))}")
    return choices[choices.index(value)]


def _size(table: Mapping[str, Any], key: str, place: str | Path) -> int | None:
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_SIZE:
        raise DataError(f"{place}: {key}", f"{value!r:.40}", f"1 to {_MAX_SIZE} px")
    return value


def _number(table: Mapping[str, Any], key: str, default: float | None, place: str | Path) -> float:
    if key not in table and default is not None:
        return default
    return number(table.get(key), f"{place}: {key}")


def _positive(table: Mapping[str, Any], key: str, default: float, place: str | Path) -> float:
    value = _number(table, key, default, place)
    if value <= 0.0:
        raise DataError(f"{place}: {key}", f"{value:g}", "a positive number")
    return value


def _triple(
    table: Mapping[str, Any],
    key: str,
    default: tuple[float, float, float],
    place: str | Path,
    positive: bool = False,
) -> tuple[float, float, float]:
    """Three numbers of the colour channels."""
    if key not in table:
        return default
    a, b, c = numbers(table[key], f"{place}: {key}", 3)
    if positive and min(a, b, c) <= 0.0:
        raise DataError(f"{place}: {key}", f"{min(a, b, c):g}", "positive numbers")
    return a, b, c


def _channels(
    table: Mapping[str, Any], key: str, default: tuple[float, ...] | None, place: str | Path
) -> tuple[float, ...]:
    """Numbers of range, x, y, z, remission."""
    if key not in table and default is not None:
        return default
    return tuple(numbers(table.get(key), f"{place}: {key}", CHANNELS))


def _names(table: Mapping[str, Any], path: Path) -> dict[str, str]:
    """Names of outputs by what they are."""
    value = table.get("outputs", {})
    if not isinstance(value, dict):
        raise DataError(f"{path}: outputs", f"{value!r:.40}", f"names for some of {', '.join(_OUTPUT_NAMES)}")
    _refuse_others(value, _OUTPUT_NAMES, f"{path}: outputs")
    return {key: _text(value, key, f"{path}: outputs") for key in value}
