"""Residuals of all boundary points that have a contour nearby, under a state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.association.edge_matching import SIDES
from sst_graph.factors import residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.fit import MatchedFrame, PointResiduals
from sst_graph.graph.matching import DriveEdges, DriveMatches, match_all
from sst_graph.graph.outer_loop import KERNELS_PX
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId
from sst_graph.types import IntArray

WIDE_PX = 5.0
"""Kernel scale under which contours are nearby: up to 15 px away, three times as far as for an estimate
[px]."""


@dataclass(frozen=True)
class Measured:
    """Boundary points with their residuals under a state.

    Attributes:
        frames: that have points.
        points: of all drives.
        keys: (n, 2) drive and number of each point among those of the drive, the same under every state; a
            point that several images show is there as often.
    """

    frames: tuple[MatchedFrame, ...]
    points: PointResiduals
    keys: IntArray

    @property
    def side_numbers(self) -> IntArray:
        """(n,) number of the object's side of each point."""
        return np.asarray(self.points.tracks * SIDES + self.points.sides)


def measure_points(
    edges: Sequence[DriveEdges], objects: Sequence[dict[ObjectId, int]], state: State
) -> Measured | None:
    """All boundary points in view that have a contour, or an edge of the picture, nearby; None without any.

    Args:
        objects: tracks of the objects of each drive.
    """
    found = match_all(edges, state, RobustKernel("geman_mcclure", WIDE_PX))
    if not found:
        return None
    frames: list[MatchedFrame] = []
    parts, keys = [], []
    first_track = 0
    for own in found:
        parts.append(_points(own, state, objects[own.number], len(frames), first_track))
        frames += [_frame(own, p) for p in own.paired]
        keys.append(np.stack([np.full(len(own), own.number), own.points], axis=1))
        first_track += 1 + max(objects[own.number].values(), default=0)
    names = PointResiduals.__dataclass_fields__
    points = PointResiduals(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    return Measured(tuple(frames), points, np.concatenate(keys))


def _frame(own: DriveMatches, p: int) -> MatchedFrame:
    pair, motion, drive = own.pairs[p], own.motions.of_images(p), own.edges.drive
    return MatchedFrame(
        drive.name,
        drive.scans[pair.scan].index,
        drive.images[pair.image].index,
        pair.base_tau_s,
        motion.c_twist,
        motion.c_acceleration,
    )


def _points(
    own: DriveMatches, state: State, objects: dict[ObjectId, int], first_frame: int, first_track: int
) -> PointResiduals:
    alignment, counts = own.alignment, own.counts
    classes = np.repeat([int(c) for c in own.group_classes], counts)
    biases = [state.biases_px.get((own.number, c), 0.0) for c in own.group_classes]
    twists = own.c_twists[own.pair_of].T
    bias_px = np.repeat(biases, counts)
    r, J = residuals(alignment, state.cTl, state.time_offset_s(own.number), twists, bias_px)
    scans = np.array([own.pairs[p].scan for p in own.group_pairs.tolist()])
    numbers = own.edges.points.objects[own.points]
    identities = zip(np.repeat(scans, counts).tolist(), classes.tolist(), numbers.tolist(), strict=True)
    velocities = alignment.l_velocities
    assert alignment.normals is not None
    return PointResiduals(
        first_frame + np.searchsorted(own.paired, own.pair_of),
        classes.astype(np.uint8),
        first_track + np.array([objects[key] for key in identities], np.intp),
        own.found.sides,
        alignment.lPs,
        alignment.base_taus_s,
        np.zeros_like(alignment.lPs) if velocities is None else velocities,
        alignment.pixels,
        alignment.normals,
        r,
        alignment.sigmas_px,
        own.found.shares * RobustKernel("geman_mcclure", KERNELS_PX[-1]).weight(r / alignment.sigmas_px),
        J[:, :7],
    )
