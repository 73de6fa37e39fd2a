"""Depth discontinuities on the edges of the picture: Levinson and Thrun (RSS 2013), "Automatic online
calibration of cameras and lasers".

Points score the square root of their jump of range (beyond the slope of the surface, which the paper leaves
in), times the inverse distance transform of the edge image, blended with it (alpha 1/3, gamma 0.98, as
printed). The 729 neighbours of a pose in a grid are scored, the best one is taken, and the grid is refined
where the middle is best: a batch reading of the paper's tracking, which takes one such step a frame. Left
out: its test of whether the calibration is right (the share of worse neighbours).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from sst_graph.errors import EstimationError
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, moved_by
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray

_ALPHA, _GAMMA = 1.0 / 3.0, 0.98
_LEAST_JUMP_M = 0.3
"""Smaller jumps are not counted [m]: the paper's."""
_POINTS = 2000
"""Most points of a frame, evenly among all: more cost time."""
_AT_ONCE = 81
"""Poses that are scored together: more cost memory."""
_FINEST_RAD = float(np.radians(0.05))
_REACH = 1.2
"""Poses farther from the start than this many half widths of its error, by axis, are not considered: the sum
of scores grows with the points in view."""
_MOVES = 40
"""Most moves on one grid."""
_NEIGHBOURS = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=6)))


@dataclass(frozen=True, eq=False)
class _EdgeFrame:
    """Points on discontinuities (n, 3) [m], their weights (n,), and the picture's map of edges (h, w)."""

    frame: PeerFrame
    lPs: FloatArray
    weights: FloatArray
    edges: NDArray[np.float32]

    @classmethod
    def of(cls, frame: PeerFrame) -> _EdgeFrame:
        found = np.flatnonzero(frame.jumps > _LEAST_JUMP_M)
        found = found[:: step_for(len(found), _POINTS)]
        return cls(frame, frame.lPs[found], np.sqrt(frame.jumps[found]), edge_map(frame.grey))

    def scores(self, poses: FloatArray) -> FloatArray:
        """(k,) of poses (k, 3, 4), [R | t]."""
        camera, (h, w) = self.frame.camera, self.edges.shape
        found = []
        for some in np.split(poses, range(_AT_ONCE, len(poses), _AT_ONCE)):
            cPs = (self.lPs @ some[:, :, :3].transpose(0, 2, 1) + some[:, None, :, 3]).reshape(-1, 3)
            uvs = camera.project(cPs)
            # Pixels of points behind the camera are NaN, which lies in no image.
            inside = camera.in_image(uvs)
            column, row = (uvs[inside] + 0.5).astype(np.intp).T
            seen = np.zeros(len(cPs), dtype=np.float32)
            seen[inside] = self.edges[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
            found.append(seen.reshape(len(some), -1) @ self.weights)
        return np.concatenate(found)


def edge_map(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) D of the paper: the largest change to any of eight neighbours, blended with the same decayed
    by gamma for each pixel of (chessboard) distance."""
    near = cv2.dilate(grey, np.ones((3, 3), np.uint8)).astype(np.float32) - grey
    far = grey - cv2.erode(grey, np.ones((3, 3), np.uint8)).astype(np.float32)
    edges = np.maximum(near, far)
    decayed = np.zeros_like(edges)
    # max over pixels of E gamma^distance: for each level of E the distance to the nearest pixel above it.
    for level in np.linspace(8.0, 248.0, 31, dtype=np.float32):
        above = edges >= level
        if above.any():
            away = distance_transform_cdt(~above, metric="chessboard").astype(np.float32)
            decayed = np.maximum(decayed, level * np.float32(_GAMMA) ** away)
    return np.asarray(_ALPHA * edges + (1.0 - _ALPHA) * decayed, dtype=np.float32)


def solve_depth_edges(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """The best pose found by grids from half the starts' range down to 0.05 deg.

    Raises:
        EstimationError: the scans show no discontinuity.
    """
    frames = [_EdgeFrame.of(frame) for frame in problem.frames]
    if not any(len(frame.lPs) for frame in frames):
        raise EstimationError("no discontinuity of depth in any scan")
    half = np.repeat([max(np.radians(problem.range_deg), _FINEST_RAD), max(problem.range_m, 1e-3)], 3)
    cTl, step = start, max(_FINEST_RAD, half[0] / 2.0)
    while True:
        grid = _NEIGHBOURS * (step / half[0] * half)
        for _ in range(_MOVES):
            poses = [moved_by(cTl, one) for one in grid]
            near = np.array([(np.abs(start.localCoordinates(one)) <= _REACH * half).all() for one in poses])
            scores = np.full(len(poses), -np.inf)
            some = np.array([one.matrix()[:3] for one, is_near in zip(poses, near, strict=True) if is_near])
            scores[near] = np.sum([frame.scores(some) for frame in frames], axis=0)
            best = int(np.argmax(scores))
            if scores[best] <= scores[len(grid) // 2]:
                break
            cTl = poses[best]
        if step <= _FINEST_RAD:
            return cTl
        step = max(_FINEST_RAD, step / 2.0)
