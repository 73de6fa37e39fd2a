"""Label numbers of public data sets as :class:`~sst_graph.types.SemanticClass`, each list with its source.

The numbers are in ``data_sets.csv``. The canonical classes are chosen so that the two sensors' conventions
agree: SemanticKITTI's "bicyclist" holds the person and the bicycle, hence Cityscapes' rider counts as
TWO_WHEELER; its "fence" holds small walls and barriers; its "vegetation" is mapped together with trunks, as
in Cityscapes; its moving classes fold into their static ones. What nuScenes calls "manmade" are buildings,
walls, poles and signs alike. What one data set calls by a name that may be either of two classes (the walls
of COCO and ADE20K) is IGNORE.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType

from sst_graph.types import SemanticClass

_IGNORED = 255
"""The number of pixels without a label in 8-bit masks."""


@dataclass(frozen=True)
class ClassMap:
    """What the label numbers of a data set mean.

    Attributes:
        name: by which it is asked for.
        classes: canonical class by number.
        names: the data set's own name by number.
        source: where the numbers are published.
    """

    name: str
    classes: Mapping[int, SemanticClass]
    names: Mapping[int, str]
    source: str

    @property
    def outputs(self) -> int:
        """Outputs of a network trained on these numbers: the largest of them, 255 aside, plus 1."""
        return max(number for number in self.classes if number != _IGNORED) + 1


def _class_map(name: str, source: str, rows: Iterable[tuple[int, str, SemanticClass]]) -> ClassMap:
    numbers, names, classes = zip(*rows, strict=True)
    by_number = dict(zip(numbers, classes, strict=True))
    return ClassMap(
        name, MappingProxyType(by_number), MappingProxyType(dict(zip(numbers, names, strict=True))), source
    )


def _listed(name: str, source: str) -> ClassMap:
    """What the table has of a data set."""
    table = files("sst_graph.classes").joinpath("data_sets.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(table.splitlines()) if row["data_set"] == name]
    entries = ((int(row["number"]), row["name"], SemanticClass[row["class"].upper()]) for row in rows)
    return _class_map(name, source, entries)


def _renumbered(
    name: str, source: str, other: ClassMap, numbers: Iterable[int], ignored: bool = True
) -> ClassMap:
    """Entries of another map, in the order of its ``numbers``, as 0, 1, ...; and 255 to be ignored."""
    rows = [(k, other.names[n], other.classes[n]) for k, n in enumerate(numbers)]
    return _class_map(
        name, source, [*rows, (_IGNORED, "unlabeled", SemanticClass.IGNORE)] if ignored else rows
    )


SEMANTIC_KITTI = _listed(
    "semantickitti",
    "config/semantic-kitti.yaml of PRBonn/semantic-kitti-api (labels); low 16 bits of a label",
)
_KITTI_TRAINED = (10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81)
SEMANTIC_KITTI_20 = _renumbered(
    "semantickitti-20",
    "config/semantic-kitti.yaml of PRBonn/semantic-kitti-api (learning_map_inv): 0 unlabeled, 1 car ... 19",
    SEMANTIC_KITTI,
    (0, *_KITTI_TRAINED),
    ignored=False,
)
SEMANTIC_KITTI_19 = _renumbered(
    "semantickitti-19",
    "as semantickitti-20 without its 0: 0 car ... 18 traffic-sign (mmdetection3d)",
    SEMANTIC_KITTI,
    _KITTI_TRAINED,
)

CITYSCAPES_IDS = _listed(
    "cityscapes-ids", "cityscapesscripts/helpers/labels.py of mcordts/cityscapesScripts (id)"
)
CITYSCAPES_TRAIN_IDS = _renumbered(
    "cityscapes-trainids",
    "cityscapesscripts/helpers/labels.py of mcordts/cityscapesScripts (trainId): 0 road ... 18 bicycle",
    CITYSCAPES_IDS,
    (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33),
)

NUSCENES_LIDARSEG = _listed(
    "nuscenes-lidarseg",
    "the category table of nuScenes-lidarseg (docs/instructions_lidarseg.md of nutonomy/nuscenes-devkit)",
)
NUSCENES_17 = _listed(
    "nuscenes-17",
    "the lidarseg challenge (eval/lidarseg of nutonomy/nuscenes-devkit): 0 void, 1 barrier ... 16",
)
NUSCENES_16 = _renumbered(
    "nuscenes-16", "as nuscenes-17 without its 0: 0 barrier ... 15 (mmdetection3d)", NUSCENES_17, range(1, 17)
)

COCO = _listed(
    "coco",
    "panoptic_coco_categories.json of cocodataset/panopticapi: 1 ... 90 things, 92 ... 200 stuff, 0 void",
)
COCO_80 = _renumbered(
    "coco-80",
    "the things of coco in their order: 0 person ... 79 toothbrush",
    COCO,
    (number for number in COCO.names if 1 <= number <= 90),
)
COCO_133 = _renumbered(
    "coco-133",
    "all of coco in its order: 0 person ... 132 rug-merged",
    COCO,
    (number for number in COCO.names if number >= 1),
)

ADE20K = _listed("ade20k", "objectInfo150.txt of CSAILVision/sceneparsing: 1 wall ... 150 flag, 0 other")
ADE20K_150 = _renumbered(
    "ade20k-150", "as ade20k without its 0: 0 wall ... 149 flag (networks)", ADE20K, range(1, 151)
)

MAPILLARY = _listed(
    "mapillary",
    "Mapillary Vistas 1.2 (config.json; mmseg/datasets/mapillary.py of open-mmlab/mmsegmentation): 0 ... 65",
)

CLASS_MAPS: Mapping[str, ClassMap] = MappingProxyType(
    {
        one.name: one
        for one in (
            CITYSCAPES_IDS,
            CITYSCAPES_TRAIN_IDS,
            MAPILLARY,
            SEMANTIC_KITTI,
            SEMANTIC_KITTI_19,
            SEMANTIC_KITTI_20,
            NUSCENES_LIDARSEG,
            NUSCENES_16,
            NUSCENES_17,
            COCO,
            COCO_80,
            COCO_133,
            ADE20K,
            ADE20K_150,
        )
    }
)
"""All of them by name."""
