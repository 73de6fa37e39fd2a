"""Numbers and names of labels turned into :class:`~sst_graph.types.SemanticClass`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.classes.data_sets import (
    ADE20K,
    ADE20K_150,
    CITYSCAPES_IDS,
    CITYSCAPES_TRAIN_IDS,
    CLASS_MAPS,
    COCO,
    COCO_133,
    MAPILLARY,
    NUSCENES_LIDARSEG,
    SEMANTIC_KITTI,
    ClassMap,
)
from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.types import SemanticClass


class MaskEncoding(StrEnum):
    """How the numbers of a semantic mask are to be read; ids and trainids are those of Cityscapes."""

    IDS = "ids"
    TRAIN_IDS = "trainids"
    COCO = "coco"
    COCO_133 = "coco-133"
    ADE20K = "ade20k"
    ADE20K_150 = "ade20k-150"
    MAPILLARY = "mapillary"


_MASK_MAPS = {
    MaskEncoding.IDS: CITYSCAPES_IDS,
    MaskEncoding.TRAIN_IDS: CITYSCAPES_TRAIN_IDS,
    MaskEncoding.COCO: COCO,
    MaskEncoding.COCO_133: COCO_133,
    MaskEncoding.ADE20K: ADE20K,
    MaskEncoding.ADE20K_150: ADE20K_150,
    MaskEncoding.MAPILLARY: MAPILLARY,
}

_UNKNOWN = 254
"""Marks, inside a look-up table, a number that the data set does not define."""


def class_table(mapping: Mapping[int, SemanticClass], size: int) -> NDArray[np.uint8]:
    """(size,) class by number, 254 where the mapping has none."""
    table = np.full(size, _UNKNOWN, np.uint8)
    table[list(mapping)] = [int(c) for c in mapping.values()]
    return table


_SEMANTIC_KITTI_TABLE = class_table(SEMANTIC_KITTI.classes, 1 << 16)
_NUSCENES_TABLE = class_table(NUSCENES_LIDARSEG.classes, 256)
_MASK_TABLES = {
    encoding: class_table({255: SemanticClass.IGNORE, **one.classes}, 256)
    for encoding, one in _MASK_MAPS.items()
}


def look_up(
    table: NDArray[np.uint8], numbers: NDArray[Any], place: str | Path, expected: str
) -> NDArray[np.uint8]:
    """Classes of numbers by a :func:`class_table` that is long enough for all of them.

    Raises:
        DataError: a number that the table does not define.
    """
    # Twice as fast as an index.
    classes: NDArray[np.uint8] = table.take(numbers)
    unknown = classes == _UNKNOWN
    if unknown.any():
        values, counts = np.unique(numbers[unknown], return_counts=True)
        raise DataError(place, f"label {values[0]} ({count_of(counts[0], 'time')})", expected)
    return classes


def class_map(name: str) -> ClassMap:
    """The map of a name.

    Raises:
        ConfigError: no data set is called so.
    """
    if name not in CLASS_MAPS:
        raise ConfigError(f"class map {name!r:.60}: expected one of {', '.join(CLASS_MAPS)}")
    return CLASS_MAPS[name]


def class_of_name(name: str) -> SemanticClass | None:
    """Class of a label by its name in any of the data sets, driving ones first; None where none has it."""
    return _BY_NAME.get(_plain(name))


def map_of_names(names: Iterable[str]) -> ClassMap | None:
    """The data set whose labels 0, 1, ... are called so, or None."""
    plain = [_plain(name) for name in names]
    for one in CLASS_MAPS.values():
        if plain == [_plain(one.names[k]) for k in range(one.outputs) if k in one.names]:
            return one
    return None


def classes_of_points(
    labels: NDArray[np.uint32], place: str | Path = "labels"
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Canonical classes and instance numbers of SemanticKITTI labels.

    Args:
        labels: (n,) class in the low 16 bits, instance in the high 16 bits.
        place: named in errors.

    Returns:
        (n,) uint8 of :class:`SemanticClass` and (n,) uint16 instances (0: none).

    Raises:
        DataError: a class number that SemanticKITTI does not define.
    """
    numbers = (labels & np.uint32(0xFFFF)).astype(np.uint16)
    classes = look_up(_SEMANTIC_KITTI_TABLE, numbers, place, "a SemanticKITTI class number")
    return classes, (labels >> np.uint32(16)).astype(np.uint16)


def classes_of_lidarseg(labels: NDArray[np.uint8], place: str | Path = "labels") -> NDArray[np.uint8]:
    """Canonical classes (n,) uint8 of nuScenes-lidarseg labels (n,) uint8.

    Raises:
        DataError: an index that nuScenes-lidarseg does not define.
    """
    return look_up(_NUSCENES_TABLE, labels, place, "a nuScenes-lidarseg index (0 to 31)")


def classes_of_mask(
    mask: NDArray[np.uint8], encoding: MaskEncoding, place: str | Path = "mask"
) -> NDArray[np.uint8]:
    """Canonical classes (h, w) uint8 of a mask (h, w) uint8.

    Raises:
        DataError: a number that the encoding does not define.
    """
    cityscapes = encoding in (MaskEncoding.IDS, MaskEncoding.TRAIN_IDS)
    expected = f"a {'Cityscapes ' if cityscapes else ''}{encoding.value} number"
    return look_up(_MASK_TABLES[encoding], mask, place, expected)


def guess_mask_encoding(masks: Iterable[NDArray[np.uint8]], place: str | Path = "masks") -> MaskEncoding:
    """Whether masks (h, w) uint8 hold Cityscapes ids or trainIds, judged over all of them.

    Numbers 19..33 exist in ids only. Where none occurs, masks that hold nothing but 0 and 255 are ids
    (background), and so are those in which 7 (as an id: road) outnumbers 0 (as a trainId: road)
    and no number occurs that would be exotic as an id. All others are trainIds.

    Raises:
        DataError: a number that neither encoding defines.
    """
    counts = np.zeros(256, np.int64)
    for mask in masks:
        counts += np.bincount(mask.ravel(), minlength=256)
    present = {int(v) for v in np.flatnonzero(counts)} - {255}
    if not present <= CITYSCAPES_IDS.classes.keys():
        alien = min(present - CITYSCAPES_IDS.classes.keys())
        expected = "Cityscapes ids (0..33) or trainIds (0..18), 255: ignore; --label-encoding names others"
        raise DataError(place, f"label {alien}", expected)
    usual_ids = {0, 7, 8, 11, 12, 13, 17}
    if max(present, default=0) > 18 or present <= {0}:
        return MaskEncoding.IDS
    if present <= usual_ids and counts[7] > counts[0]:
        return MaskEncoding.IDS
    return MaskEncoding.TRAIN_IDS


def cityscapes_ids_of(classes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Cityscapes ids (...) of classes (...), as :func:`classes_of_mask` reads them back.

    Raises:
        DataError: a class that is in no data set (OBJECT), or none at all.
    """
    _check_stored(classes)
    return _CITYSCAPES_OF_CLASS[classes]


def semantic_kitti_of(classes: NDArray[np.uint8], instances: NDArray[np.uint16] | None) -> NDArray[np.uint32]:
    """SemanticKITTI labels (n,) of classes (n,), as :func:`classes_of_points` reads them back.

    SKY, which SemanticKITTI does not have, becomes other-object.

    Args:
        instances: (n,) for the high 16 bits, or None.

    Raises:
        DataError: a class that is in no data set (OBJECT), or none at all.
    """
    _check_stored(classes)
    labels = _SEMANTIC_KITTI_OF_CLASS[classes]
    return labels if instances is None else labels | (instances.astype(np.uint32) << np.uint32(16))


def _check_stored(classes: NDArray[np.uint8]) -> None:
    known = _HAS_NUMBER[classes]
    if not known.all():
        found = int(classes[~known][0])
        raise DataError("labels", f"class {found}", "one that Cityscapes and SemanticKITTI have a number for")


def _plain(name: str) -> str:
    """Lower case; what is between letters and digits is one blank."""
    return re.sub(r"[^a-z0-9]+", " ", name.split(",")[0].lower()).strip()


def _by_name() -> dict[str, SemanticClass]:
    found: dict[str, SemanticClass] = {}
    for one in CLASS_MAPS.values():
        for number, name in one.names.items():
            found.setdefault(_plain(name), one.classes[number])
    return found


_BY_NAME = _by_name()

_STORED = {
    SemanticClass.OTHER: (0, 99),
    SemanticClass.VEHICLE: (26, 10),
    SemanticClass.GROUND: (7, 40),
    SemanticClass.BUILDING: (11, 50),
    SemanticClass.VEGETATION: (21, 70),
    SemanticClass.POLE: (17, 80),
    SemanticClass.PERSON: (24, 30),
    SemanticClass.TWO_WHEELER: (33, 11),
    SemanticClass.SKY: (23, 99),
    SemanticClass.TERRAIN: (22, 72),
    SemanticClass.FENCE: (13, 51),
    SemanticClass.SIGN: (20, 81),
    SemanticClass.IGNORE: (255, 0),
}
"""Numbers of Cityscapes and of SemanticKITTI under which a class is stored."""
_CITYSCAPES_OF_CLASS = np.full(256, 255, np.uint8)
_SEMANTIC_KITTI_OF_CLASS = np.zeros(256, np.uint32)
_HAS_NUMBER = np.zeros(256, bool)
_HAS_NUMBER[[int(one) for one in _STORED]] = True
for _class, (_city, _kitti) in _STORED.items():
    _CITYSCAPES_OF_CLASS[_class], _SEMANTIC_KITTI_OF_CLASS[_class] = _city, _kitti
