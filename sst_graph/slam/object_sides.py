"""Sides of objects, known again from image to image by their place in the world.

An outline that differs from its mask does so in every image that shows it: what errs together is one
cluster. Objects are followed by the centre of their matched points, near where it was last seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.slam.align import FrameAlignments
from sst_graph.types import FloatArray, SemanticClass

SAME_OBJECT_M = 1.5
"""Centres of an object's matched points in consecutive images lie nearer than this [m]: parked vehicles
stand at least a vehicle's width apart, and what is seen of one moves by decimetres from image to image."""

_Cell = tuple[SemanticClass, int, int, int]
"""A class, and a cube of the world with edges of :data:`SAME_OBJECT_M`, by number along each axis."""
_NEIGHBOURS = tuple(itertools.product((-1, 0, 1), repeat=3))


@dataclass
class _Track:
    """One object: its class, and where it was seen last, in the world [m]."""

    semantic_class: SemanticClass
    place: FloatArray


class ObjectSides:
    """Numbers for the sides of objects, the same in every image."""

    def __init__(self) -> None:
        self._origin: FloatArray | None = None
        self._tracks: list[_Track] = []
        self._cells: dict[_Cell, set[int]] = {}
        self._names: dict[tuple[int, SemanticClass], dict[int, int]] = {}

    def of(self, scan_ns: int, found: FrameAlignments, wTl: gtsam.Pose3) -> list[NDArray[np.intp]]:
        """For each alignment, (n,) number of the side that each match lies on.

        Args:
            scan_ns: stamp of the scan, which names its objects.
            found: matches of the scan.
            wTl: pose of the LiDAR at the scan.
        """
        numbers = []
        for c, alignment, objects, sides in zip(
            found.classes, found.alignments, found.objects, found.sides, strict=True
        ):
            tracks = np.zeros(len(objects), dtype=np.intp)
            for number in np.unique(objects):
                own = objects == number
                centre = np.asarray(wTl.transformFrom(alignment.lPs[own].mean(axis=0)))
                tracks[own] = self._track((scan_ns, c, int(number)), centre)
            numbers.append(tracks * SIDES + sides)
        return numbers

    def near(self, wTl: gtsam.Pose3) -> gtsam.Pose3:
        """The pose in axes that begin where the first one is: sums of squares of places near it are exact,
        wherever the world begins."""
        if self._origin is None:
            self._origin = np.asarray(wTl.translation())
        return gtsam.Pose3(wTl.rotation(), wTl.translation() - self._origin)

    def _track(self, name: tuple[int, SemanticClass, int], centre: FloatArray) -> int:
        """The track of an object of a scan: the nearest of its class that the scan has not named yet."""
        scan_ns, semantic_class, number = name
        names = self._names.setdefault((scan_ns, semantic_class), {})
        if number not in names:
            names[number] = self._nearest(semantic_class, centre, names.values())
        self._move(names[number], centre)
        return names[number]

    def _nearest(self, semantic_class: SemanticClass, centre: FloatArray, taken: Collection[int]) -> int:
        """The track nearest to a place, of a class and not taken; a new one where none is near.

        Only the cells around the place are looked at: a drive passes objects without end.
        """
        _, i, j, k = _cell(semantic_class, centre)
        near = [
            (float(np.linalg.norm(self._tracks[track].place - centre)), track)
            for a, b, c in _NEIGHBOURS
            for track in self._cells.get((semantic_class, i + a, j + b, k + c), ())
            if track not in taken
        ]
        distance, nearest = min(near, default=(np.inf, -1))
        if distance <= SAME_OBJECT_M:
            return nearest
        self._tracks.append(_Track(semantic_class, centre))
        return len(self._tracks) - 1

    def _move(self, track: int, centre: FloatArray) -> None:
        """The track was seen at a place."""
        semantic_class, place = self._tracks[track].semantic_class, self._tracks[track].place
        self._cells.get(_cell(semantic_class, place), set()).discard(track)
        self._cells.setdefault(_cell(semantic_class, centre), set()).add(track)
        self._tracks[track].place = centre


def _cell(semantic_class: SemanticClass, place: FloatArray) -> _Cell:
    i, j, k = (int(number) for number in np.floor(place / SAME_OBJECT_M))
    return semantic_class, i, j, k
