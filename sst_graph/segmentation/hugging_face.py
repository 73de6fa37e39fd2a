"""Segmentation of pictures by models of Hugging Face: SegFormer, Mask2Former, OneFormer, ..."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.classes import class_of_name, map_of_names
from sst_graph.errors import DataError, one_line, optional_module
from sst_graph.segmentation.label_numbers import LabelNumbers
from sst_graph.segmentation.segmenter import ImageLabels
from sst_graph.types import CameraImage, SemanticClass

VERSION = 1
"""Version of what is done beside the model: other labels from the same model need another number."""


class HuggingFaceSegmenter:
    """Satisfies :class:`~sst_graph.segmentation.segmenter.ImageSegmenter`."""

    def __init__(self, model: str | Path, numbers: LabelNumbers | None = None, place: str = "") -> None:
        """Loads the model.

        Args:
            model: folder with config.json, weights and preprocessor_config.json, or a name on the hub.
            numbers: what its labels mean; None: by the names in its configuration (``id2label``).
            place: of the file that names the model, for errors; empty: the model itself.

        Raises:
            DataError: no model for semantic segmentation that loads, or labels without known names.
            MissingDependencyError: transformers or torch is not installed.
        """
        self._place = place or str(model)
        transformers, self._torch = _modules(self._place)
        try:
            self._processor = transformers.AutoImageProcessor.from_pretrained(str(model))
            config = transformers.AutoConfig.from_pretrained(str(model))
            kind = _kind(transformers, config)
            self._model = kind.from_pretrained(str(model)).eval()
        except DataError:
            raise
        except Exception as error:  # of transformers, the hub, safetensors, torch
            found = f"no model that loads ({one_line(error):.200})"
            raise DataError(self._place, found, "a model of transformers for semantic segmentation") from None
        self.name = Path(str(model)).name
        self.numbers = self._numbers() if numbers is None else numbers

    @property
    def known(self) -> frozenset[SemanticClass]:
        """Classes that its labels name."""
        return self.numbers.known

    @property
    def identity(self) -> str:
        """Identity of the weights, the configuration and what is done with them."""
        digest = hashlib.sha256(repr((VERSION, self._model.config.to_json_string(use_diff=False))).encode())
        digest.update(self._processor.to_json_string().encode())
        digest.update(repr(sorted((k, int(c)) for k, c in self.numbers.classes.items())).encode())
        for name, weights in sorted(self._model.state_dict().items()):
            digest.update(name.encode() + weights.cpu().float().numpy().tobytes())
        return digest.hexdigest()

    def segment(self, image: CameraImage) -> ImageLabels:
        """Labels of a picture.

        Raises:
            DataError: no picture, a model that fails on it, or a label without a class.
        """
        place = f"the image stamped {image.stamp_ns} ns"
        if not image.has_picture:
            raise DataError(place, "no picture", "one to segment")
        rgb = np.ascontiguousarray(image.pixels[:, :, ::-1])
        try:
            labels = self._labels(rgb)
        except Exception as error:
            raise DataError(self._place, f"a failure on {place} ({one_line(error):.200})", "labels") from None
        return ImageLabels(self.numbers.of_labels(labels, self._place))

    def _labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Numbers (h, w) of a picture (h, w, 3)."""
        task = {"task_inputs": ["semantic"]} if self._model.config.model_type == "oneformer" else {}
        inputs = self._processor(images=rgb, return_tensors="pt", **task)
        with self._torch.inference_mode():
            outputs = self._model(**inputs)
        logits = getattr(outputs, "logits", None)
        if logits is not None and not bool(self._torch.isfinite(logits).all()):
            raise ValueError("NaN or inf in its output")
        maps = self._processor.post_process_semantic_segmentation(outputs, target_sizes=[rgb.shape[:2]])
        return np.asarray(maps[0].cpu().numpy(), np.int64)

    def _numbers(self) -> LabelNumbers:
        """By the names of the labels: those of a data set, or each by itself."""
        names = {int(k): str(name) for k, name in self._model.config.id2label.items()}
        ordered = [names[k] for k in sorted(names)]
        if (one := map_of_names(ordered)) is not None:
            return LabelNumbers.of(one)
        classes = {k: class_of_name(name) for k, name in names.items()}
        unknown = [names[k] for k, label in classes.items() if label is None]
        if unknown:
            raise DataError(
                self._place,
                f"the label {unknown[0]!r:.40} (and {len(unknown) - 1} more) of an unknown class",
                "a YAML file with hugging_face: this model, and classes: that say what its labels mean",
            )
        return LabelNumbers(self.name, {k: label for k, label in classes.items() if label is not None})


def _kind(transformers: Any, config: Any) -> Any:
    """The class that loads models of a configuration."""
    for name in ("AutoModelForSemanticSegmentation", "AutoModelForUniversalSegmentation"):
        kind = getattr(transformers, name)
        if type(config) in kind._model_mapping:
            return kind
    raise DataError(config.model_type, "a model of another task", "one for semantic segmentation")


def _modules(place: str) -> tuple[Any, Any]:
    without = f"{place}: models of Hugging Face need transformers and torch, which are not installed"
    torch = optional_module("torch", without, "hf")
    return optional_module("transformers", without, "hf"), torch
