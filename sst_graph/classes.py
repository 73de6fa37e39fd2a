"""Semantic classes: label numbers of public data sets mapped to :class:`~sst_graph.types.SemanticClass`.

The canonical classes are chosen so that the two sensors' conventions agree: SemanticKITTI's "bicyclist"
holds the person and the bicycle, hence Cityscapes' rider counts as TWO_WHEELER; its "fence" holds small
walls and barriers; its "vegetation" is mapped together with trunks, as in Cityscapes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.types import SemanticClass

_C = SemanticClass

SEMANTIC_KITTI: Mapping[int, SemanticClass] = {
    0: _C.IGNORE,  # unlabeled
    1: _C.IGNORE,  # outlier
    10: _C.VEHICLE,  # car
    11: _C.TWO_WHEELER,  # bicycle
    13: _C.VEHICLE,  # bus
    15: _C.TWO_WHEELER,  # motorcycle
    16: _C.VEHICLE,  # on-rails
    18: _C.VEHICLE,  # truck
    20: _C.VEHICLE,  # other-vehicle
    30: _C.PERSON,
    31: _C.TWO_WHEELER,  # bicyclist
    32: _C.TWO_WHEELER,  # motorcyclist
    40: _C.GROUND,  # road
    44: _C.GROUND,  # parking
    48: _C.GROUND,  # sidewalk
    49: _C.GROUND,  # other-ground
    50: _C.BUILDING,
    51: _C.FENCE,
    52: _C.OTHER,  # other-structure
    60: _C.GROUND,  # lane-marking
    70: _C.VEGETATION,
    71: _C.VEGETATION,  # trunk
    72: _C.TERRAIN,
    80: _C.POLE,
    81: _C.SIGN,
    99: _C.OTHER,  # other-object
    252: _C.VEHICLE,  # moving-car
    253: _C.TWO_WHEELER,  # moving-bicyclist
    254: _C.PERSON,  # moving-person
    255: _C.TWO_WHEELER,  # moving-motorcyclist
    256: _C.VEHICLE,  # moving-on-rails
    257: _C.VEHICLE,  # moving-bus
    258: _C.VEHICLE,  # moving-truck
    259: _C.VEHICLE,  # moving-other-vehicle
}
"""Low 16 bits of a SemanticKITTI label; the moving classes fold into their static ones."""

CITYSCAPES_IDS: Mapping[int, SemanticClass] = {
    0: _C.OTHER,  # unlabeled: background
    1: _C.IGNORE,  # ego vehicle
    2: _C.IGNORE,  # rectification border
    3: _C.IGNORE,  # out of roi
    4: _C.OTHER,  # static
    5: _C.OTHER,  # dynamic
    6: _C.GROUND,
    7: _C.GROUND,  # road
    8: _C.GROUND,  # sidewalk
    9: _C.GROUND,  # parking
    10: _C.GROUND,  # rail track
    11: _C.BUILDING,
    12: _C.FENCE,  # wall
    13: _C.FENCE,
    14: _C.FENCE,  # guard rail
    15: _C.OTHER,  # bridge
    16: _C.OTHER,  # tunnel
    17: _C.POLE,
    18: _C.POLE,  # polegroup
    19: _C.OTHER,  # traffic light
    20: _C.SIGN,
    21: _C.VEGETATION,
    22: _C.TERRAIN,
    23: _C.SKY,
    24: _C.PERSON,
    25: _C.TWO_WHEELER,  # rider
    26: _C.VEHICLE,  # car
    27: _C.VEHICLE,  # truck
    28: _C.VEHICLE,  # bus
    29: _C.VEHICLE,  # caravan
    30: _C.VEHICLE,  # trailer
    31: _C.VEHICLE,  # train
    32: _C.TWO_WHEELER,  # motorcycle
    33: _C.TWO_WHEELER,  # bicycle
    255: _C.IGNORE,
}
"""Cityscapes label ids (``labelIds``), 8 bits."""

_TRAIN_ID_TO_ID = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)

CITYSCAPES_TRAIN_IDS: Mapping[int, SemanticClass] = {
    **{train_id: CITYSCAPES_IDS[label] for train_id, label in enumerate(_TRAIN_ID_TO_ID)},
    255: _C.IGNORE,
}
"""Cityscapes ``trainIds``: 0 road ... 13 car ... 18 bicycle."""


NUSCENES_LIDARSEG: Mapping[int, SemanticClass] = {
    0: _C.IGNORE,  # noise
    1: _C.OTHER,  # animal
    **dict.fromkeys(range(2, 9), _C.PERSON),  # human.pedestrian.*
    9: _C.FENCE,  # movable_object.barrier
    10: _C.OTHER,  # movable_object.debris
    11: _C.OTHER,  # movable_object.pushable_pullable
    12: _C.OTHER,  # movable_object.trafficcone
    13: _C.OTHER,  # static_object.bicycle_rack
    14: _C.TWO_WHEELER,  # vehicle.bicycle
    **dict.fromkeys(range(15, 21), _C.VEHICLE),  # bus.bendy, bus.rigid, car, construction, ambulance, police
    21: _C.TWO_WHEELER,  # vehicle.motorcycle
    22: _C.VEHICLE,  # vehicle.trailer
    23: _C.VEHICLE,  # vehicle.truck
    24: _C.GROUND,  # flat.driveable_surface
    25: _C.GROUND,  # flat.other
    26: _C.GROUND,  # flat.sidewalk
    27: _C.TERRAIN,  # flat.terrain
    28: _C.BUILDING,  # static.manmade: buildings, walls, poles and signs alike
    29: _C.OTHER,  # static.other
    30: _C.VEGETATION,  # static.vegetation
    31: _C.IGNORE,  # vehicle.ego
}
"""nuScenes-lidarseg indices, 8 bits."""


class MaskEncoding(StrEnum):
    """How the numbers of a semantic mask are to be read."""

    IDS = "ids"
    TRAIN_IDS = "trainids"


_UNKNOWN = 254
"""Marks, inside a look-up table, a number that the data set does not define."""

_MASK_MAPS = {MaskEncoding.IDS: CITYSCAPES_IDS, MaskEncoding.TRAIN_IDS: CITYSCAPES_TRAIN_IDS}


def _table(mapping: Mapping[int, SemanticClass], size: int) -> NDArray[np.uint8]:
    table = np.full(size, _UNKNOWN, np.uint8)
    table[list(mapping)] = [int(c) for c in mapping.values()]
    return table


_SEMANTIC_KITTI_TABLE = _table(SEMANTIC_KITTI, 1 << 16)
_NUSCENES_TABLE = _table(NUSCENES_LIDARSEG, 256)
_MASK_TABLES = {encoding: _table(mapping, 256) for encoding, mapping in _MASK_MAPS.items()}


def _look_up(
    table: NDArray[np.uint8], numbers: NDArray[Any], place: str | Path, expected: str
) -> NDArray[np.uint8]:
    classes: NDArray[np.uint8] = table[numbers]
    unknown = classes == _UNKNOWN
    if unknown.any():
        values, counts = np.unique(numbers[unknown], return_counts=True)
        raise DataError(place, f"label {values[0]} ({counts[0]} times)", expected)
    return classes


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
    classes = _look_up(_SEMANTIC_KITTI_TABLE, numbers, place, "a SemanticKITTI class number")
    return classes, (labels >> np.uint32(16)).astype(np.uint16)


def classes_of_lidarseg(labels: NDArray[np.uint8], place: str | Path = "labels") -> NDArray[np.uint8]:
    """Canonical classes (n,) uint8 of nuScenes-lidarseg labels (n,) uint8.

    Raises:
        DataError: an index that nuScenes-lidarseg does not define.
    """
    return _look_up(_NUSCENES_TABLE, labels, place, "a nuScenes-lidarseg index (0 to 31)")


def classes_of_mask(
    mask: NDArray[np.uint8], encoding: MaskEncoding, place: str | Path = "mask"
) -> NDArray[np.uint8]:
    """Canonical classes (h, w) uint8 of a Cityscapes mask (h, w) uint8.

    Raises:
        DataError: a number that the encoding does not define.
    """
    expected = f"a Cityscapes {encoding.value} number"
    return _look_up(_MASK_TABLES[encoding], mask, place, expected)


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
    if not present <= CITYSCAPES_IDS.keys():
        alien = min(present - CITYSCAPES_IDS.keys())
        raise DataError(place, f"label {alien}", "Cityscapes ids (0..33) or trainIds (0..18), 255: ignore")
    usual_ids = {0, 7, 8, 11, 12, 13, 17}
    if max(present, default=0) > 18 or present <= {0}:
        return MaskEncoding.IDS
    if present <= usual_ids and counts[7] > counts[0]:
        return MaskEncoding.IDS
    return MaskEncoding.TRAIN_IDS
