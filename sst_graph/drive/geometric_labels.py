"""A drive whose scans are labelled by geometry: what stands on the ground, of no known class."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sst_graph.data.frame_parts import frame_at, scan_at
from sst_graph.data.source_view import SourceView
from sst_graph.features.compact_objects import find_compact_objects
from sst_graph.features.ground import on_ground
from sst_graph.types import Frame, Scan, SemanticClass, Source
from sst_graph.validation import checked_position

_NEAREST_M = 1.5
"""Nearer points may be of the own vehicle [m]."""


class GeometricallyLabelled(SourceView):
    """A source whose points have the class OBJECT, GROUND or OTHER by geometry (satisfies
    :class:`sst_graph.types.Source`); stored labels are not used."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def __getitem__(self, position: int) -> Frame:
        """Frame at a position; errors as :func:`~sst_graph.validation.checked_position`, and its own."""
        position = checked_position(position, len(self))
        frame = frame_at(self.source, position)
        return frame if frame.scan is None else replace(frame, scan=labelled_by_geometry(frame.scan))

    def read_scan(self, position: int) -> Scan | None:
        """Scan of the frame at a position."""
        scan = scan_at(self.source, position)
        return None if scan is None else labelled_by_geometry(scan)


def labelled_by_geometry(scan: Scan) -> Scan:
    """The scan with classes and instances by geometry instead of its labels."""
    points = scan.points.astype(np.float64)
    found = find_compact_objects(points, scan.rings)
    near = np.einsum("ij,ij->i", points, points) < _NEAREST_M**2
    classes = np.full(len(points), SemanticClass.OTHER, np.uint8)
    classes[on_ground(found.heights_m)] = SemanticClass.GROUND
    classes[found.numbers > 0] = SemanticClass.OBJECT
    classes[near] = SemanticClass.IGNORE
    return replace(scan, classes=classes, instances=found.numbers.astype(np.uint16))
