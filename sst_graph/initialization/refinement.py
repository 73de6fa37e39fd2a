"""Candidates of a start solved side by side: matched, one Gauss-Newton step each, under narrowing kernels.

No graph is built: a graph for each candidate took a second where this takes a tenth. What the graph holds
beside pose, offset and one mask bias a class is fixed (twists) or left out (biases by object), so
the winner is only a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.time_pairing import nearest_images
from sst_graph.drive.preparation import Drive
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import GraphConfig, Tracks
from sst_graph.initialization.global_search import rotation_matrices
from sst_graph.initialization.many_poses import Outlines, Poses, Steps, Views
from sst_graph.stepwise import Stepwise, whole
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_LONGEST_RAD, _LONGEST_M, _LONGEST_S, _LONGEST_PX = 0.1, 0.3, 0.1, 3.0
"""Longest step of one iteration."""
_NEAR_NS = 4_000_000
"""Twists this close in time are one [ns]."""
_POINTS_A_STEP = 32_000
"""Boundary points, times poses, that are matched in one step."""
_DAMPING = 1e-3
"""Of a Gauss-Newton step, as a share of the diagonal of the normal equations."""


@dataclass(frozen=True)
class _Part:
    """One drive of a field."""

    number: int
    drive: Drive
    outlines: Outlines


class Field:
    """Some drives, ready to be compared with many poses at once."""

    def __init__(self, parts: Sequence[_Part], tracks: Tracks, config: GraphConfig) -> None:
        self._parts, self._tracks, self.config = parts, tracks, config
        self.biases = sum(len(part.outlines.classes) for part in parts)

    @classmethod
    def of(
        cls, drives: Sequence[Drive], tracks: Tracks, classes: Sequence[SemanticClass], config: GraphConfig
    ) -> Field:
        """All boundary points and contours of the drives."""
        parts = []
        for number, drive in enumerate(drives):
            scans = [scan.boundaries for scan in drive.scans]
            images = [image.contours for image in drive.images]
            parts.append(_Part(number, drive, Outlines.gather(scans, images, classes, drive.camera)))
        return cls(parts, tracks, config)

    def thinned(self, points: int) -> Field:
        """The same with about so many boundary points in all."""
        total = max(1, sum(len(part.outlines) for part in self._parts))
        parts = [
            replace(part, outlines=part.outlines.thinned(max(1, points * len(part.outlines) // total)))
            for part in self._parts
        ]
        return Field(parts, self._tracks, self.config)

    def steps(self, poses: Poses, scale_px: float) -> Steps:
        """All steps of :meth:`stepping`."""
        return whole(self.stepping(poses, scale_px))

    def stepping(self, poses: Poses, scale_px: float) -> Stepwise[Steps]:
        """Normal equations of all drives, one mask bias for each class in each drive; some poses a step."""
        points = max(1, sum(len(part.outlines) for part in self._parts))
        some = max(1, _POINTS_A_STEP // points)
        parts = []
        for start in range(0, len(poses), some):
            parts.append(self._steps(poses.take(np.arange(start, min(start + some, len(poses)))), scale_px))
            yield 3
        names = [field.name for field in fields(Steps)]
        return Steps(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _steps(self, poses: Poses, scale_px: float) -> Steps:
        kernel = RobustKernel("geman_mcclure", scale_px)
        m, k = len(poses), 7 + self.biases
        H, g, support, seen = np.zeros((m, k, k)), np.zeros((m, k)), np.zeros(m), np.zeros(m)
        first = 7
        for part in self._parts:
            columns = [*range(7), *range(first, first + len(part.outlines.classes))]
            first = columns[-1] + 1
            own = replace(poses, biases=poses.biases[:, [column - 7 for column in columns[7:]]])
            steps = part.outlines.steps(own, self._views(part, poses.offsets), kernel, self.config.match)
            H[np.ix_(range(m), columns, columns)] += steps.H
            g[:, columns] += steps.g
            support += steps.support
            seen += steps.seen
        return Steps(H, g, support, seen)

    def _views(self, part: _Part, offsets: FloatArray) -> Views:
        """The image of each scan under each offset, and the LiDAR's motion then."""
        drive, limit = part.drive, self.config.max_interval_periods * part.drive.image_period_s
        stamps = np.array(drive.image_stamps_ns)
        images, taus = nearest_images(drive.scan_stamps_ns, drive.image_stamps_ns, offsets, limit)
        seen = images >= 0
        # Twists that are near enough in time are one.
        shifts = np.rint(1e9 * offsets).astype(np.int64)[:, None]
        near, which = np.unique((stamps[images] + shifts)[seen] // _NEAR_NS, return_inverse=True)
        samples = self._tracks.at_all(part.number, (near * _NEAR_NS + _NEAR_NS // 2).tolist())
        if samples is None or not samples.twists.any():
            return Views(images, taus, None, None)
        twists, accelerations = np.zeros((2, *images.shape, 6))
        twists[seen] = samples.twists[which.reshape(-1)]
        accelerations[seen] = samples.accelerations[which.reshape(-1)]
        return Views(images, taus, twists, accelerations)


def hold_heat(field: Field, poses: Poses, centres: Poses, kernels_px: Sequence[float]) -> Poses:
    """All steps of :func:`holding_heat`."""
    return whole(holding_heat(field, poses, centres, kernels_px))


def holding_heat(field: Field, poses: Poses, centres: Poses, kernels_px: Sequence[float]) -> Stepwise[Poses]:
    """The poses after one step under each kernel.

    Args:
        centres: what the weak priors of each pose are centred on.
        kernels_px: scales of the robust kernel, step by step [px].
    """
    for scale_px in kernels_px:
        steps = yield from field.stepping(poses, scale_px)
        poses = _stepped(poses, centres, steps, field.config)
    return poses


def _stepped(poses: Poses, centres: Poses, steps: Steps, config: GraphConfig) -> Poses:
    """One damped Gauss-Newton step, with the weak priors of the graph."""
    k = steps.g.shape[1]
    diagonal = range(k)
    rad, m, s, px = config.rest_sigma_rad, config.rest_sigma_m, config.delay_sigma_s, config.bias_sigma_px
    information = _of_each(k, rad, m, s, px) ** -2.0
    away = [
        _rotation_vectors(poses.rotations @ np.swapaxes(centres.rotations, 1, 2)),
        poses.translations - centres.translations,
        (poses.offsets - centres.offsets)[:, None],
        poses.biases,
    ]
    H, g = steps.H.copy(), steps.g + information * np.concatenate(away, axis=1)
    H[:, diagonal, diagonal] = (1.0 + _DAMPING) * (H[:, diagonal, diagonal] + information)
    x = np.asarray(-np.linalg.solve(H, g[:, :, None])[:, :, 0], np.float64)
    longest = _of_each(k, _LONGEST_RAD, _LONGEST_M, _LONGEST_S, _LONGEST_PX)
    x /= np.maximum(1.0, np.abs(x / longest).max(axis=1))[:, None]
    turns = rotation_matrices(x[:, :3])
    return Poses(
        turns @ poses.rotations,
        (turns @ poses.translations[:, :, None])[:, :, 0] + x[:, 3:6],
        poses.offsets + x[:, 6],
        poses.biases + x[:, 7:],
    )


def _of_each(k: int, rad: float, m: float, s: float, px: float) -> FloatArray:
    """(k,) a number for each of the unknowns: rotation, translation, offset, biases."""
    return np.array([rad] * 3 + [m] * 3 + [s] + [px] * (k - 7))


def _rotation_vectors(rotations: FloatArray) -> FloatArray:
    """(m, 3) logarithms of rotations (m, 3, 3) [rad]."""
    return np.stack([gtsam.Rot3.Logmap(gtsam.Rot3.ClosestTo(R)) for R in rotations])
