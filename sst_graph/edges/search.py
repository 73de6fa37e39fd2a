"""Starts for calibration without labels: rotations on a grid, scored by blurred edges, the best refined.

A grid around what is known beforehand is scored under a wide blur; the best of it again on finer grids, under
a narrower one. What motion alone says of rotation rules out poses that contradict it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sst_graph.edges.agreement import BlurredScore
from sst_graph.graph.matching import DriveEdges
from sst_graph.graph.state import State
from sst_graph.metrics import turn_rad
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import Stepwise
from sst_graph.types import FloatArray

FloatMap = NDArray[np.float32]

_STAGES = ((14.0, 1.0, 100), (8.0, 0.5, 40), (6.0, 0.25, 30))
"""Blur [px] at an image width of 1242, step of the grid in units of the first one's, and how many poses go
on."""
GRID_DEG = 1.2
"""Step of the first grid: with KITTI's camera, as many pixels as the first blur has [deg]."""
_SCANS, _POINTS = 100, 4000
"""Scans, and boundary points in all, that the poses are compared on."""
_WIDTH_PX = 1242
"""Image width for which the blurs are given."""
MODES = 6
"""Most starts that are returned."""
APART_DEG, APART_S = 0.8, 0.05
"""Starts are farther apart than one of these: nearer ones lead to one estimate [deg], [s]."""
_POSES, _POSES_WORK, _FIELD_WORK = 240, 8, 2
"""Poses that are scored in one step, and in units of work what that and the fields of an image cost."""
_GATE_CHI2 = 25.0
"""Chi-squared, of 3, of the difference from motion's rotation beyond which a pose is not tried."""
MOTION_FLOOR_DEG = 0.7
"""Added to the sigmas of motion's rotation: its covariance leaves out what biases odometry [deg]."""


@dataclass(frozen=True)
class KnownRotation:
    """A rotation cRl known beforehand, with the (3, 3) covariance of its right perturbation [rad^2]."""

    cRl: gtsam.Rot3
    covariance: FloatArray

    def chi2(self, rotations: FloatArray) -> FloatArray:
        """(m,) of 3, of rotations (m, 3, 3)."""
        floor = np.radians(MOTION_FLOOR_DEG) ** 2 * np.eye(3)
        steps = Rotation.from_matrix(self.cRl.matrix().T @ rotations).as_rotvec()
        return np.asarray((steps @ np.linalg.inv(self.covariance + floor) * steps).sum(axis=1))


@dataclass(frozen=True)
class SearchRegion:
    """Where starts are searched.

    Attributes:
        cTl: the pose in the middle.
        time_offsets_s: time offsets that are tried [s].
        half_deg: half widths (3,) of the rotations about the camera's axes [deg].
        motion: what motion alone says, where it says something.
    """

    cTl: gtsam.Pose3
    time_offsets_s: tuple[float, ...]
    half_deg: tuple[float, float, float]
    motion: KnownRotation | None = None


def edge_starts_steps(edges: DriveEdges, region: SearchRegion) -> Stepwise[list[State]]:
    """The best poses that are :data:`APART_DEG` or :data:`APART_S` apart, best first; none where nothing is
    in view."""
    edges = _of_some_scans(edges).thinned(_POINTS)
    first = _gated(_grid(region), region)
    candidates = [(number, first) for number in range(len(region.time_offsets_s))]
    found: list[tuple[float, int, FloatArray]] = []
    for stage, (blur_px, step, kept) in enumerate(_STAGES):
        found, fields = [], dict[int, FloatMap]()
        for number, rotations in candidates:
            if stage:
                rotations = _gated(_around(rotations, step * GRID_DEG), region)
            scored = yield from _scored(edges, region, number, rotations, (blur_px, fields))
            found += scored[:kept]
        found = sorted(found, key=lambda one: -one[0])[:kept]
        candidates = [
            (number, np.stack([R for _, own, R in found if own == number]))
            for number in sorted({own for _, own, _ in found})
        ]
    starts: list[State] = []
    for _, number, R in found:
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(R), region.cTl.translation())
        start = State(pose, (region.time_offsets_s[number],))
        if all(_apart(start, other) for other in starts):
            starts.append(start)
    return starts[:MODES]


def _of_some_scans(edges: DriveEdges) -> DriveEdges:
    """The points of scans that are spread over the drive: the fields of each image take memory."""
    some = evenly_spread(sorted(set(edges.scans)), _SCANS)
    chosen = np.isin(edges.scans, some)
    return edges if chosen.all() else edges.take(np.flatnonzero(chosen[edges.group_of]))


def _scored(
    edges: DriveEdges,
    region: SearchRegion,
    number: int,
    rotations: FloatArray,
    blur: tuple[float, dict[int, FloatMap]],
) -> Stepwise[list[tuple[float, int, FloatArray]]]:
    """(score, number of the time offset, rotation (3, 3)) of rotations (m, 3, 3), best first.

    Args:
        blur: its sigma [px], and the fields that are known under it.
    """
    blur_px, fields = blur[0] * edges.drive.camera.width / _WIDTH_PX, blur[1]
    before = len(fields)
    state = State(region.cTl, (region.time_offsets_s[number],))
    blurred = BlurredScore.of(edges, state, blur_px, fields)
    if blurred is None:
        return []
    yield _FIELD_WORK * (len(fields) - before) + 1
    scores = np.zeros(0)
    for a in range(0, len(rotations), _POSES):
        some = rotations[a : a + _POSES]
        scores = np.append(scores, blurred.scores(some, np.tile(region.cTl.translation(), (len(some), 1))))
        yield _POSES_WORK
    return [(float(scores[k]), number, rotations[k]) for k in np.argsort(-scores).tolist()]


def _apart(a: State, b: State) -> bool:
    far = float(np.degrees(turn_rad(a.cTl, b.cTl))) > APART_DEG
    return far or abs(a.time_offsets_s[0] - b.time_offsets_s[0]) > APART_S


def turned(cTl: gtsam.Pose3, turns_rad: FloatArray) -> FloatArray:
    """(m, 3, 3) rotations Exp(turn) cRl, about the camera's axes, of turns (m, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(turns_rad).as_matrix() @ cTl.rotation().matrix())


def _grid(region: SearchRegion) -> FloatArray:
    """(m, 3, 3) rotations around the middle of a region."""
    axes = [
        np.arange(-np.ceil(half / GRID_DEG), np.ceil(half / GRID_DEG) + 1.0) * GRID_DEG
        for half in region.half_deg
    ]
    turns = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return turned(region.cTl, np.radians(turns))


def _around(rotations: FloatArray, step_deg: float) -> FloatArray:
    """(27 m, 3, 3) each rotation (m, 3, 3) and its neighbours on a grid of that step."""
    axis = np.radians(step_deg) * np.array([-1.0, 0.0, 1.0])
    turns = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    steps = Rotation.from_rotvec(turns).as_matrix()
    return np.asarray((steps[None] @ rotations[:, None]).reshape(-1, 3, 3))


def _gated(rotations: FloatArray, region: SearchRegion) -> FloatArray:
    """Rotations (k, 3, 3) that motion's rotation does not contradict; all, where it contradicts all."""
    if region.motion is None:
        return rotations
    allowed = region.motion.chi2(rotations) < _GATE_CHI2
    return rotations[allowed] if allowed.any() else rotations
