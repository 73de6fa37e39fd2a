"""Labels of pictures and scans from networks: what runs them, and drives that carry their labels.

``segmenter`` has the protocols, ``model_files`` opens networks, ``labelled`` is the view of a drive and
``store`` keeps labels on disk.
"""

from __future__ import annotations

from sst_graph.segmentation.labelled import LabelledSource, Labelling, segment_drive, with_labels
from sst_graph.segmentation.model_files import open_image_segmenter, open_scan_segmenter
from sst_graph.segmentation.segmenter import ImageLabels, ImageSegmenter, PointLabels, ScanSegmenter
from sst_graph.segmentation.store import LabelStore, cache_folder

__all__ = [
    "ImageLabels",
    "ImageSegmenter",
    "LabelStore",
    "LabelledSource",
    "Labelling",
    "PointLabels",
    "ScanSegmenter",
    "cache_folder",
    "open_image_segmenter",
    "open_scan_segmenter",
    "segment_drive",
    "with_labels",
]
