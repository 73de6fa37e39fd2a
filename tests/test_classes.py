"""Label numbers of the data sets against the published class lists."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.classes import (
    CLASS_MAPS,
    MaskEncoding,
    cityscapes_ids_of,
    class_map,
    class_of_name,
    classes_of_mask,
    classes_of_points,
    guess_mask_encoding,
    map_of_names,
    semantic_kitti_of,
)
from sst_graph.classes.data_sets import CITYSCAPES_IDS, CITYSCAPES_TRAIN_IDS, SEMANTIC_KITTI
from sst_graph.errors import ConfigError, DataError
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
        assert SEMANTIC_KITTI.classes[moving] == SEMANTIC_KITTI.classes[static]


@pytest.mark.parametrize("label", [2, 12, 100, 260, 65535])
def test_undefined_point_label_is_refused(label: int) -> None:
    with pytest.raises(DataError, match=rf"cloud: found label {label} \(2 times\), expected .*SemanticKITTI"):
        classes_of_points(np.array([10, label, label], np.uint32), "cloud")


def test_ids_and_train_ids_name_the_same_classes() -> None:
    for train_id, name in enumerate(TRAIN_ID_NAMES):
        assert CITYSCAPES_TRAIN_IDS.classes[train_id].name == name
    vehicles = {label for label, c in CITYSCAPES_IDS.classes.items() if c == SemanticClass.VEHICLE}
    assert vehicles == {26, 27, 28, 29, 30, 31}


def test_mask_keeps_its_shape_and_background_is_other() -> None:
    mask = np.array([[0, 26], [255, 7], [1, 23]], np.uint8)
    classes = classes_of_mask(mask, MaskEncoding.IDS)
    names = [[SemanticClass(c).name for c in row] for row in classes]
    assert names == [["OTHER", "VEHICLE"], ["IGNORE", "GROUND"], ["IGNORE", "SKY"]]
    assert SemanticClass(classes_of_mask(mask_of(0), MaskEncoding.TRAIN_IDS)[0, 0]) == SemanticClass.GROUND


def test_id_read_as_train_id_is_refused() -> None:
    with pytest.raises(DataError, match=r"label 26 \(1 time\), expected a Cityscapes trainids number"):
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


NUMBERED = {
    "cityscapes-trainids": (19, {0: "road", 13: "car", 18: "bicycle"}),
    "semantickitti-20": (20, {1: "car", 9: "road", 19: "traffic-sign"}),
    "semantickitti-19": (19, {0: "car", 8: "road", 18: "traffic-sign"}),
    "nuscenes-17": (17, {4: "car", 11: "driveable_surface", 16: "vegetation"}),
    "nuscenes-16": (16, {3: "car", 15: "vegetation"}),
    "coco": (201, {3: "car", 8: "truck", 13: "stop sign", 149: "road", 187: "sky-other-merged"}),
    "coco-80": (80, {2: "car", 7: "truck", 11: "stop sign", 79: "toothbrush"}),
    "coco-133": (133, {2: "car", 80: "banner", 132: "rug-merged"}),
    "ade20k": (151, {7: "road", 21: "car", 81: "bus", 84: "truck", 103: "van", 150: "flag"}),
    "ade20k-150": (150, {6: "road", 20: "car", 80: "bus", 93: "pole", 149: "flag"}),
    "mapillary": (66, {13: "Road", 27: "Sky", 45: "Pole", 55: "Car", 61: "Truck", 65: "Unlabeled"}),
}
"""Outputs of a network, and some of the published names by number."""


@pytest.mark.parametrize("name", NUMBERED)
def test_numbers_are_the_published_ones(name: str) -> None:
    outputs, names = NUMBERED[name]
    one = class_map(name)
    assert one.outputs == outputs
    assert {number: one.names[number] for number in names} == names
    assert SemanticClass.VEHICLE in one.classes.values()
    meaning = {"car": "VEHICLE", "truck": "VEHICLE", "bus": "VEHICLE", "road": "GROUND"}
    for number, label in names.items():
        assert label.lower() not in meaning or one.classes[number].name == meaning[label.lower()]


def test_every_map_is_known_by_its_name_and_says_where_it_is_from() -> None:
    for name, one in CLASS_MAPS.items():
        assert one.name == name
        assert one.source
        assert one.classes.keys() == one.names.keys()
    with pytest.raises(ConfigError, match="class map 'pascal': expected one of cityscapes-ids, "):
        class_map("pascal")


def test_names_of_labels_mean_classes() -> None:
    assert class_of_name("Traffic Sign (Front)") == SemanticClass.SIGN
    assert class_of_name("building, edifice") == SemanticClass.BUILDING
    assert class_of_name("moving_car") == SemanticClass.VEHICLE
    assert class_of_name("LABEL_3") is None
    cityscapes = [CITYSCAPES_TRAIN_IDS.names[k] for k in range(19)]
    assert map_of_names(cityscapes) is CITYSCAPES_TRAIN_IDS
    assert map_of_names(cityscapes[::-1]) is None


def test_classes_come_back_from_their_stored_numbers() -> None:
    """All but objects found by geometry, which no data set labels."""
    classes = np.array([int(c) for c in SemanticClass if c != SemanticClass.OBJECT], np.uint8)
    assert (classes_of_mask(cityscapes_ids_of(classes[None]), MaskEncoding.IDS)[0] == classes).all()
    points = classes[classes != SemanticClass.SKY]  # no point of a cloud is sky
    instances = np.arange(len(points), dtype=np.uint16)
    back, numbers = classes_of_points(semantic_kitti_of(points, instances))
    assert (back == points).all()
    assert (numbers == instances).all()
    with pytest.raises(DataError, match="labels: found class 12, expected one that Cityscapes and Semantic"):
        cityscapes_ids_of(np.array([1, SemanticClass.OBJECT], np.uint8))
    with pytest.raises(DataError, match="labels: found class 12"):
        semantic_kitti_of(np.array([1, SemanticClass.OBJECT], np.uint8), None)


@pytest.mark.parametrize(
    ("encoding", "number", "label"),
    [
        ("coco", 3, "VEHICLE"),
        ("ade20k-150", 20, "VEHICLE"),
        ("mapillary", 17, "BUILDING"),
        ("coco", 255, "IGNORE"),
    ],
)
def test_masks_of_other_data_sets(encoding: str, number: int, label: str) -> None:
    assert SemanticClass(classes_of_mask(mask_of(number), MaskEncoding(encoding))[0, 0]).name == label
