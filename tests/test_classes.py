"""Label numbers of the data sets against the published class lists."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.classes import (
    CITYSCAPES_IDS,
    CITYSCAPES_TRAIN_IDS,
    SEMANTIC_KITTI,
    MaskEncoding,
    classes_of_mask,
    classes_of_points,
    guess_mask_encoding,
)
from sst_graph.errors import DataError
from sst_graph.types import SemanticClass

MOVING_TO_STATIC = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}
"""``learning_map`` of semantic-kitti.yaml for the moving classes."""

# fmt: off
TRAIN_ID_NAMES = (
    "GROUND", "GROUND", "BUILDING", "FENCE", "FENCE",  # road sidewalk building wall fence
    "POLE", "OTHER", "SIGN", "VEGETATION", "TERRAIN", "SKY",  # pole light sign vegetation terrain sky
    "PERSON", "TWO_WHEELER",  # person rider
    "VEHICLE", "VEHICLE", "VEHICLE", "VEHICLE",  # car truck bus train
    "TWO_WHEELER", "TWO_WHEELER",  # motorcycle bicycle
)
# fmt: on


def mask_of(*values: int) -> np.ndarray:
    return np.array([values], np.uint8)


def test_point_labels_split_into_class_and_instance() -> None:
    labels = np.array([0, 1, 10 | 7 << 16, 18 | 65535 << 16, 40, 99], np.uint32)
    classes, instances = classes_of_points(labels)
    expected = ["IGNORE", "IGNORE", "VEHICLE", "VEHICLE", "GROUND", "OTHER"]
    assert [SemanticClass(c).name for c in classes] == expected
    assert instances.tolist() == [0, 0, 7, 65535, 0, 0]
    assert classes.dtype == np.uint8
    assert instances.dtype == np.uint16


def test_moving_classes_fold_into_static_ones() -> None:
    for moving, static in MOVING_TO_STATIC.items():
        assert SEMANTIC_KITTI[moving] == SEMANTIC_KITTI[static]


@pytest.mark.parametrize("label", [2, 12, 100, 260, 65535])
def test_undefined_point_label_is_refused(label: int) -> None:
    with pytest.raises(DataError, match=rf"cloud: found label {label} \(2 times\), expected .*SemanticKITTI"):
        classes_of_points(np.array([10, label, label], np.uint32), "cloud")


def test_ids_and_train_ids_name_the_same_classes() -> None:
    for train_id, name in enumerate(TRAIN_ID_NAMES):
        assert CITYSCAPES_TRAIN_IDS[train_id].name == name
    vehicles = {label for label, c in CITYSCAPES_IDS.items() if c == SemanticClass.VEHICLE}
    assert vehicles == {26, 27, 28, 29, 30, 31}


def test_mask_keeps_its_shape_and_background_is_other() -> None:
    mask = np.array([[0, 26], [255, 7], [1, 23]], np.uint8)
    classes = classes_of_mask(mask, MaskEncoding.IDS)
    names = [[SemanticClass(c).name for c in row] for row in classes]
    assert names == [["OTHER", "VEHICLE"], ["IGNORE", "GROUND"], ["IGNORE", "SKY"]]
    assert SemanticClass(classes_of_mask(mask_of(0), MaskEncoding.TRAIN_IDS)[0, 0]) == SemanticClass.GROUND


def test_id_read_as_train_id_is_refused() -> None:
    with pytest.raises(DataError, match=r"label 26 \(1 times\), expected a Cityscapes trainids number"):
        classes_of_mask(mask_of(0, 26), MaskEncoding.TRAIN_IDS)


@pytest.mark.parametrize(
    ("masks", "encoding"),
    [
        ([mask_of(0, 255), mask_of(0, 26)], MaskEncoding.IDS),  # vehicles and background, one empty mask
        ([mask_of(0, 0, 255)], MaskEncoding.IDS),  # nothing seen at all
        ([mask_of(7, 7, 11, 13, 17)], MaskEncoding.IDS),  # a street without anything beyond 18
        ([mask_of(0, 1, 2, 8, 10, 13)], MaskEncoding.TRAIN_IDS),
        ([mask_of(0, 0, 0, 7, 13)], MaskEncoding.TRAIN_IDS),  # road, sign, car
        ([mask_of(13, 255)], MaskEncoding.TRAIN_IDS),  # cars only
    ],
)
def test_encoding_is_guessed_from_the_masks(masks: list[np.ndarray], encoding: MaskEncoding) -> None:
    assert guess_mask_encoding(masks) == encoding


def test_number_of_neither_encoding_is_refused() -> None:
    with pytest.raises(DataError, match="semantic_2: found label 77, expected Cityscapes ids"):
        guess_mask_encoding([mask_of(0, 13), mask_of(77)], "semantic_2")
