"""Semantic classes: label numbers of public data sets mapped to :class:`~sst_graph.types.SemanticClass`.

``data_sets`` lists the numbers with their sources; ``lookup`` turns labels into classes.
"""

from __future__ import annotations

from sst_graph.classes.data_sets import CLASS_MAPS, ClassMap
from sst_graph.classes.lookup import (
    MaskEncoding,
    cityscapes_ids_of,
    class_map,
    class_of_name,
    class_table,
    classes_of_lidarseg,
    classes_of_mask,
    classes_of_points,
    guess_mask_encoding,
    look_up,
    map_of_names,
    semantic_kitti_of,
)

__all__ = [
    "CLASS_MAPS",
    "ClassMap",
    "MaskEncoding",
    "cityscapes_ids_of",
    "class_map",
    "class_of_name",
    "class_table",
    "classes_of_lidarseg",
    "classes_of_mask",
    "classes_of_points",
    "guess_mask_encoding",
    "look_up",
    "map_of_names",
    "semantic_kitti_of",
]
