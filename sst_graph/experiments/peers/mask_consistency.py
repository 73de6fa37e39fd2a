"""Consistency of the points in each mask: CalibAnything (Luo et al., 2023).

Source: github.com/OpenCalib/CalibAnything, ``calibration.cpp``. A pose is good where the points in a mask
have like normals (0.3), like intensities (0.2) and are of one segment (0.5). It is sought by rounds of random
search about the best pose, the first as wide as the starts' error plus 0.5 deg and 5 cm, each next half
as wide in rotation and 1.5 times less in translation, until 0.3 deg.

Masks are those of the data (an object, a class or the background each) in place of Segment Anything's, and
do not overlap. Segments are clusters of the points above the ground, and the ground, in place of RANSAC
planes and Euclidean clusters. Normals are compared by 256 directions, which all pairs of a mask's points then
share. Without intensities their term is constant, as where all returns are equal. The original takes
search ranges of 10 deg and 1 m at most.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sst_graph.errors import EstimationError
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, moved_by
from sst_graph.odometry.lidar import GROUND_CLASSES
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, IntArray

_NORMALS_OF = 40
"""Neighbours of a normal: the original's."""
_POINTS = 6000
"""Most points of a frame, evenly; the original keeps one a voxel of 0.1 m."""
_CLUSTER_M, _CLUSTER_POINTS = 0.25, 50
"""Tolerance [m] and least size of a cluster: the original's."""
_DIRECTIONS = 256
"""Of normals."""
_STOP_DEG = 0.3


@dataclass(frozen=True, eq=False)
class _MaskFrame:
    """Points of a frame with what is compared.

    Attributes:
        frame: where they are seen.
        lPs: (n, 3) [m].
        directions: (n,) number of the normal's direction.
        intensities: (n,) 0 to 1; 0 where the data tell none.
        segments: (n,) number of the segment, from 1, or 0 for none.
        masks: (h, w) number of the mask, from 1; sizes (m + 1,) pixels of each.
        points_a_pixel: points on the image at the start, to a pixel of its lower half.
    """

    frame: PeerFrame
    lPs: FloatArray
    directions: IntArray
    intensities: FloatArray
    segments: IntArray
    masks: IntArray
    sizes: IntArray
    points_a_pixel: float

    def cost(self, cTl: gtsam.Pose3) -> float:
        """2 - 0.3 normals - 0.2 intensities - 0.5 segments - 0.0001 masks, or 2 where too little is seen."""
        camera = self.frame.camera
        inside, uvs = self.frame.pixels(cTl, self.lPs)
        row = np.clip((uvs[:, 1] + 0.5).astype(np.intp), 0, camera.height - 1)
        column = np.clip((uvs[:, 0] + 0.5).astype(np.intp), 0, camera.width - 1)
        bottom = np.count_nonzero(row > 0.9 * camera.height)
        if bottom < 0.1 * self.points_a_pixel * 0.1 * camera.height * camera.width:
            return 2.0
        mask, masks = self.masks[row, column], len(self.sizes)
        count = np.bincount(mask, minlength=masks).astype(np.float64)
        least = min(camera.height * camera.width // 1200, 2000)
        enough = np.maximum(10.0, 0.1 * self.sizes * self.points_a_pixel)
        used = np.flatnonzero((self.sizes >= least) & (count >= enough))
        segments = _table(mask, self.segments[inside], masks)[used, 1:]
        in_segments = segments.sum(axis=1)
        if in_segments.sum() == 0.0:
            return 2.0
        count = count[used]
        weight = count / count.sum()
        directions = _table(mask, self.directions[inside], masks, _DIRECTIONS)[used]
        normal = np.einsum("mi,mi->m", directions @ _SIMILARITY, directions) / count**2
        intensity = 1.0 - _deviations(self.intensities[inside], mask, masks)[used]
        # The largest segment of a mask counts once, the next one half, and so on.
        ordered = -np.sort(-segments, axis=1)
        by_segment = float((ordered @ 0.5 ** np.arange(ordered.shape[1])).sum() / in_segments.sum())
        return float(
            2.0 - 0.3 * normal @ weight - 0.2 * intensity @ weight - 0.5 * by_segment - 1e-4 * len(used)
        )


def _table(rows: IntArray, columns: IntArray, height: int, width: int | None = None) -> FloatArray:
    """(height, width) how often each pair occurs."""
    wide = int(columns.max(initial=0)) + 1 if width is None else width
    return (
        np.bincount(rows * wide + columns, minlength=height * wide).reshape(height, wide).astype(np.float64)
    )


def _deviations(values: FloatArray, group: IntArray, groups: int) -> FloatArray:
    """(groups,) standard deviation of the values of each; 0 of an empty one."""
    count = np.maximum(1, np.bincount(group, minlength=groups))
    mean = np.bincount(group, values, groups) / count
    return np.asarray(np.sqrt(np.bincount(group, (values - mean[group]) ** 2, groups) / count))


def _even_directions(count: int) -> FloatArray:
    """(count, 3) unit vectors, evenly over half of the sphere (a golden spiral): a normal has no sign."""
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


_AXES = _even_directions(_DIRECTIONS)
_SIMILARITY = np.abs(_AXES @ _AXES.T)


def solve_mask_consistency(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """The best pose of the random search.

    Raises:
        EstimationError: no frame has more than one mask.
    """
    frames = [_mask_frame(frame, start) for frame in problem.frames]
    if all(np.count_nonzero(frame.sizes) < 2 for frame in frames):
        raise EstimationError("the data hold no masks of images")
    rng = np.random.default_rng(problem.seed)
    width_deg, width_m = problem.range_deg + 0.5, problem.range_m + 0.05

    def cost(pose: gtsam.Pose3) -> float:
        return sum(frame.cost(pose) for frame in frames)

    cTl, best = start, cost(start)
    while width_deg > _STOP_DEG:
        widths = np.repeat([np.radians(width_deg), width_m], 3)
        centre = cTl
        for _ in range(problem.samples):
            pose = moved_by(centre, widths * rng.uniform(-1.0, 1.0, 6))
            value = cost(pose)
            if value < best:
                cTl, best = pose, value
        width_deg, width_m = width_deg / 2.0, width_m / 1.5
    return cTl


def _mask_frame(frame: PeerFrame, start: gtsam.Pose3) -> _MaskFrame:
    some, lPs, directions, segments = _segmented(frame)
    masks, sizes = masks_of(frame)
    _, uvs = frame.pixels(start, lPs)
    lower = np.count_nonzero(uvs[:, 1] > 0.5 * frame.camera.height)
    share = lower / (0.5 * frame.camera.height * frame.camera.width)
    intensities = np.zeros(len(some)) if frame.intensities is None else frame.intensities[some]
    return _MaskFrame(frame, lPs, directions, intensities, segments, masks, sizes, share)


@functools.lru_cache(maxsize=64)
def _segmented(frame: PeerFrame) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Points that are kept (m,), where they are (m, 3) [m], directions of their normals, segments (m,)."""
    ahead = np.flatnonzero(frame.lPs[:, 0] > 0.0)
    tree = cKDTree(frame.lPs[ahead])
    some = ahead[:: step_for(len(ahead), _POINTS)]
    lPs = frame.lPs[some]
    around = frame.lPs[ahead][tree.query(lPs, min(_NORMALS_OF, len(ahead)))[1]]
    off = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(off.transpose(0, 2, 1) @ off)[1][:, :, 0]
    directions = np.argmax(np.abs(normals @ _AXES.T), axis=1)
    # The ground, and clusters of all points that are not on it.
    standing = np.flatnonzero(~np.isin(frame.classes[ahead], GROUND_CLASSES))
    segments = np.zeros(len(frame.lPs), dtype=np.intp)
    if len(standing):
        pairs = cKDTree(frame.lPs[ahead[standing]]).query_pairs(_CLUSTER_M, output_type="ndarray")
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(standing),) * 2)
        labels = connected_components(links, directed=False)[1]
        large = np.bincount(labels)[labels] >= _CLUSTER_POINTS
        segments[ahead[standing]] = np.where(large, labels + 2, 0)
    ground = np.isin(frame.classes, GROUND_CLASSES)
    segments[ground] = 1
    used, numbers = np.unique(segments[some], return_inverse=True)
    # Numbered without gaps: most clusters are too small to count.
    return some, lPs, directions, numbers + (0 if 0 in used else 1)


def masks_of(frame: PeerFrame) -> tuple[IntArray, IntArray]:
    """(h, w) number of the mask that each pixel lies in, from 1, and (m + 1,) pixels of each.

    An object with an instance number is a mask, what is left of each class another one, the background too.
    """
    instances = np.zeros_like(frame.mask, dtype=np.int64) if frame.instances is None else frame.instances
    both = frame.mask.astype(np.int64) * 65536 + instances
    numbers, masks = np.unique(both, return_inverse=True)
    masks = masks.reshape(both.shape).astype(np.intp) + 1
    return masks, np.bincount(masks.ravel(), minlength=len(numbers) + 1)
