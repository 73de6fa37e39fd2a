"""Models of Hugging Face, made small at random, saved to a folder and read from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sst_graph.classes import class_map
from sst_graph.errors import DataError
from sst_graph.segmentation import open_image_segmenter, with_labels
from sst_graph.segmentation.label_numbers import LabelNumbers
from sst_graph.segmentation.segmenter import ImageSegmenter
from sst_graph.types import CameraImage, SemanticClass

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

CITYSCAPES = class_map("cityscapes-trainids")
NAMES = {k: CITYSCAPES.names[k] for k in range(19)}


def write_segformer(folder: Path, names: dict[int, str], seed: int = 0) -> Path:
    """The smallest SegFormer there is, with weights at random."""
    torch.manual_seed(seed)
    config = transformers.SegformerConfig(
        num_encoder_blocks=2,
        depths=[1, 1],
        sr_ratios=[4, 2],
        hidden_sizes=[8, 16],
        num_attention_heads=[1, 1],
        patch_sizes=[7, 3],
        strides=[4, 2],
        mlp_ratios=[2, 2],
        decoder_hidden_size=16,
        id2label=names,
        label2id={name: k for k, name in names.items()},
    )
    transformers.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    processor = transformers.SegformerImageProcessor(size={"height": 64, "width": 128})
    processor.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_segformer(tmp_path_factory.mktemp("hf") / "segformer", NAMES)


def image() -> CameraImage:
    rng = np.random.default_rng(2)
    pixels = rng.integers(0, 256, (6, 10, 3)).repeat(10, axis=0).repeat(10, axis=1).astype(np.uint8)
    return CameraImage(5, np.full((60, 100), SemanticClass.IGNORE, np.uint8), pixels)


def by_hand(folder: Path) -> np.ndarray[Any, Any]:
    """Numbers by the model's own steps: logits, bilinear to the picture's size, the largest."""
    model = transformers.SegformerForSemanticSegmentation.from_pretrained(folder).eval()
    processor = transformers.SegformerImageProcessor.from_pretrained(folder)
    rgb = np.ascontiguousarray(image().pixels[:, :, ::-1])
    with torch.no_grad():
        logits = model(**processor(images=rgb, return_tensors="pt")).logits
    full = torch.nn.functional.interpolate(logits, (60, 100), mode="bilinear", align_corners=False)
    return np.asarray(full[0].argmax(0).numpy())


def test_labels_are_those_of_the_model(folder: Path) -> None:
    segmenter: ImageSegmenter = open_image_segmenter(folder)
    found = segmenter.segment(image())
    numbers = by_hand(folder)
    assert len(np.unique(numbers)) > 1
    assert (found.mask == np.vectorize(lambda k: int(CITYSCAPES.classes[k]))(numbers)).all()
    assert segmenter.known == LabelNumbers.of(CITYSCAPES).known
    assert segmenter.name == "segformer"


def test_the_identity_is_that_of_weights_and_labels(folder: Path, tmp_path: Path) -> None:
    first = open_image_segmenter(folder).identity
    assert open_image_segmenter(folder).identity == first
    other = write_segformer(tmp_path / "other", NAMES, seed=1)
    assert open_image_segmenter(other).identity != first


def test_a_yaml_file_names_the_model_and_what_its_labels_mean(tmp_path: Path) -> None:
    write_segformer(tmp_path / "model", {0: "LABEL_0", 1: "LABEL_1"})
    with pytest.raises(DataError, match=r"the label 'LABEL_0' \(and 1 more\) of an unknown class"):
        open_image_segmenter(tmp_path / "model")
    (tmp_path / "m.yaml").write_text("hugging_face: model\nclasses: {0: vehicle, 1: ground}\n")
    found = open_image_segmenter(tmp_path / "m.yaml").segment(image())
    assert set(np.unique(found.mask)) <= {SemanticClass.VEHICLE, SemanticClass.GROUND}
    (tmp_path / "m.yaml").write_text("hugging_face: model\nclasses: {0: vehicle}\n")
    with pytest.raises(DataError, match=r"label 1 \(\d+ times\), expected a number of "):
        open_image_segmenter(tmp_path / "m.yaml").segment(image())


def test_names_of_labels_may_be_of_any_data_set(tmp_path: Path) -> None:
    segmenter = open_image_segmenter(write_segformer(tmp_path / "m", {0: "Car", 1: "road, route", 2: "tree"}))
    assert segmenter.known == {SemanticClass.VEHICLE, SemanticClass.GROUND, SemanticClass.VEGETATION}


def test_what_is_no_model_is_refused_in_one_line(folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "config.json").write_text('{"model_type": "segformer"}')
    with pytest.raises(DataError, match="broken: found no model that loads") as error:
        open_image_segmenter(broken)
    assert "\n" not in str(error.value)
    transformers.BertModel(
        transformers.BertConfig(
            vocab_size=16, hidden_size=8, num_hidden_layers=1, num_attention_heads=1, intermediate_size=8
        )
    ).save_pretrained(tmp_path / "bert")
    transformers.SegformerImageProcessor().save_pretrained(tmp_path / "bert")
    with pytest.raises(DataError, match="found a model of another task, expected one for semantic segment"):
        open_image_segmenter(tmp_path / "bert")


def test_nan_is_refused(folder: Path, tmp_path: Path) -> None:
    model = transformers.SegformerForSemanticSegmentation.from_pretrained(folder)
    with torch.no_grad():
        model.decode_head.classifier.bias[0] = float("nan")
    model.save_pretrained(tmp_path / "nan")
    transformers.SegformerImageProcessor().save_pretrained(tmp_path / "nan")
    with pytest.raises(DataError, match=r"a failure on the image stamped 5 ns \(NaN or inf in its output"):
        open_image_segmenter(tmp_path / "nan").segment(image())


def test_a_drive_is_labelled_by_it(folder: Path, kitti_drive: Path, tmp_path: Path) -> None:
    from sst_graph.data import open_source

    drive = with_labels(open_source(kitti_drive), open_image_segmenter(folder), None, tmp_path / "labels")
    frame = drive[0]
    assert frame.image is not None
    assert frame.image.has_mask
    assert with_labels(open_source(kitti_drive), None, None, tmp_path / "labels")[0] == frame
