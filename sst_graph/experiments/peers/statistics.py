"""Intensities of the returns against grey levels: mutual information, and what is made of it.

* NID: normalized information distance of direct_visual_lidar_calibration (Koide et al., ICRA 2023;
  github.com/koide3/direct_visual_lidar_calibration, ``visual_camera_calibration.cpp``,
  ``nid_cost.hpp``, ``preprocess.cpp``): histograms of picture and intensities equalized, 16 bins, B-spline
  weights over 4 x 4 pixels, hidden points removed by a depth buffer, BFGS with exact gradients within 0.2 m
  and 2 deg, repeated until it moves less than 0.1 m and 0.5 deg. Left out: the initial guess by SuperGlue,
  dense clouds of many scans. The depth buffer has cells of 4 pixels, for one scan leaves most pixels empty.
* MI: mutual information of Pandey et al. (AAAI 2012): 64 bins of either, smoothed by a Gaussian; here hidden
  points are removed too, and it is climbed by Nelder and Mead in place of gradient ascent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize

from sst_graph.errors import EstimationError
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, moved_by
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray

_NID_BINS, _OUTER = 16, 10
_INNER = 50
"""Iterations of BFGS: Ceres's default, which the original leaves as it is."""
_REACH_DEG, _REACH_M = 2.0, 0.2
"""The original's BFGS goes no farther than this from where it began [deg], [m]."""
_DONE_M, _DONE_RAD = 0.1, float(np.radians(0.5))
_MI_BINS, _MI_BLUR = 64, 1.5
_MI_ITERATIONS = 768
_POINTS = 10_000
"""Most points of a frame, evenly: more cost time."""
_CELL_PX = 4.0
"""Cells of the depth buffer [px]."""
_HIDDEN = 1.05
"""A point this many times as far as the nearest of its cell is hidden."""
_KNOTS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
_OUT_OF_SIGHT = 2.0
"""Cost where no point is in the image: NID is at most 1."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame's points that are not hidden.

    Attributes:
        frame: where they are seen.
        grey: (h, w) uint8 picture that they are compared with.
        lPs: (n, 3) [m]; values (n,) intensities, spread over 0 to 1.
    """

    frame: PeerFrame
    grey: NDArray[np.uint8]
    lPs: FloatArray
    values: FloatArray


def solve_nid(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """Refinement by BFGS, hidden points found anew after each.

    Raises:
        EstimationError: the data tell no intensities.
    """
    _require(problem)
    pictures = [np.asarray(cv2.equalizeHist(frame.grey), dtype=np.uint8) for frame in problem.frames]
    bounds = [(-np.radians(_REACH_DEG), np.radians(_REACH_DEG))] * 3 + [(-_REACH_M, _REACH_M)] * 3
    cTl = start
    for _ in range(_OUTER):
        seen = [_visible(*each, cTl) for each in zip(problem.frames, pictures, strict=True)]

        def cost(
            step: FloatArray, seen: Sequence[_Seen] = seen, at: gtsam.Pose3 = cTl
        ) -> tuple[float, FloatArray]:
            values, gradients = zip(*(nid_by_spline(each, moved_by(at, step)) for each in seen), strict=True)
            by_step = gtsam.Pose3.ExpmapDerivative(step).T @ np.sum(gradients, axis=0)
            return float(np.sum(values)), np.asarray(by_step)

        options = {"maxiter": _INNER}
        step = minimize(cost, np.zeros(6), jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
        cTl = moved_by(cTl, step)
        if np.linalg.norm(step[3:]) < _DONE_M and np.linalg.norm(step[:3]) < _DONE_RAD:
            break
    return cTl


def solve_mutual_information(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """The pose of largest mutual information over all frames together.

    Raises:
        EstimationError: the data tell no intensities.
    """
    _require(problem)
    every = [_visible(frame, frame.grey, start) for frame in problem.frames]

    def cost(step: FloatArray) -> float:
        pose = moved_by(start, step)
        joint = np.sum([joint_by_pixel(each, pose) for each in every], axis=0)
        return -mutual_information(gaussian_filter(joint, _MI_BLUR, mode="constant"))

    # The first simplex is half as wide as the starts' error.
    steps = 0.5 * np.repeat([np.radians(max(problem.range_deg, 0.1)), max(problem.range_m, 0.01)], 3)
    simplex = np.vstack([np.zeros(6), np.diag(steps)])
    options = {"initial_simplex": simplex, "maxiter": _MI_ITERATIONS, "xatol": 1e-5, "fatol": 1e-8}
    return moved_by(start, minimize(cost, np.zeros(6), method="Nelder-Mead", options=options).x)


def _require(problem: PeerProblem) -> None:
    if any(frame.intensities is None for frame in problem.frames):
        raise EstimationError("the data tell no intensities")


def _equalized(intensities: FloatArray) -> FloatArray:
    """Intensities by their rank, 0 to 1: bins are filled evenly, as the original's preprocessing does."""
    ranks = np.argsort(np.argsort(intensities, kind="stable"), kind="stable")
    return np.asarray(ranks / max(1, len(ranks) - 1))


def _visible(frame: PeerFrame, grey: NDArray[np.uint8], cTl: gtsam.Pose3) -> _Seen:
    """The points of a frame that no nearer one hides at a pose."""
    inside, uvs = frame.pixels(cTl, frame.lPs)
    depth = np.linalg.norm(frame.lPs[inside], axis=1)
    columns = int(np.ceil(frame.camera.width / _CELL_PX)) + 1
    cells = (uvs[:, 1] / _CELL_PX).astype(np.intp) * columns + (uvs[:, 0] / _CELL_PX).astype(np.intp)
    nearest = np.full(int(cells.max()) + 1 if len(cells) else 1, np.inf)
    np.minimum.at(nearest, cells, depth)
    kept = inside[depth < _HIDDEN * nearest[cells]]
    kept = kept[:: step_for(len(kept), _POINTS)]
    assert frame.intensities is not None
    return _Seen(frame, grey, frame.lPs[kept], _equalized(frame.intensities)[kept])


@dataclass(frozen=True, eq=False)
class _Knots:
    """The 4 x 4 pixels around each of m points in the image.

    Attributes:
        some: (m,) which points.
        cells: (m, 4, 4) of the joint histogram, flat.
        rows, columns: (m, 4) weights; rows_by_v, columns_by_u (m, 4) their derivatives [1/px].
    """

    some: NDArray[np.intp]
    cells: NDArray[np.intp]
    rows: FloatArray
    columns: FloatArray
    rows_by_v: FloatArray
    columns_by_u: FloatArray

    @classmethod
    def of(cls, seen: _Seen, cTl: gtsam.Pose3) -> _Knots:
        some, uvs = seen.frame.pixels(cTl, seen.lPs)
        level = np.minimum((seen.values[some] * _NID_BINS).astype(np.intp), _NID_BINS - 1)
        base = np.floor(uvs).astype(np.intp)
        s = (uvs - base)[:, :, None]
        weights = s ** np.arange(4) @ _KNOTS.T
        slopes = np.concatenate([np.zeros_like(s), np.ones_like(s), 2.0 * s, 3.0 * s**2], axis=2) @ _KNOTS.T
        h, w = seen.grey.shape
        around = np.arange(-1, 3)
        columns = np.clip(base[:, 0, None] + around, 0, w - 1)
        rows = np.clip(base[:, 1, None] + around, 0, h - 1)
        grey = (seen.grey[rows[:, :, None], columns[:, None, :]].astype(np.intp) * _NID_BINS) >> 8
        cells = grey * _NID_BINS + level[:, None, None]
        return cls(some, cells, weights[:, 1], weights[:, 0], slopes[:, 1], slopes[:, 0])

    def joint(self) -> FloatArray:
        """(bins, bins) joint histogram of grey levels and intensities, weighted over 4 x 4 pixels."""
        weight = self.rows[:, :, None] * self.columns[:, None, :]
        histogram = np.bincount(self.cells.ravel(), weight.ravel(), _NID_BINS**2)
        return np.asarray(histogram.reshape(_NID_BINS, _NID_BINS), dtype=np.float64)


def nid_by_spline(seen: _Seen, cTl: gtsam.Pose3) -> tuple[float, FloatArray]:
    """NID of a frame, and its derivative (6,) by the pose in its tangent space [1/rad, 1/m].

    NID = 2 - (H(x) + H(y)) / H(x, y), of which H(y) of the points does not depend on the pose.
    """
    knots = _Knots.of(seen, cTl)
    joint = knots.joint()
    value, n = nid(joint), len(knots.some)
    if value == _OUT_OF_SIGHT:
        return value, np.zeros(6)
    p = joint / n
    of_grey = p.sum(axis=1, keepdims=True)
    both, alone = _entropy(p), _entropy(of_grey) + _entropy(p.sum(axis=0))
    # A cell that holds nothing is not read.
    logs, logs_grey = np.log(np.where(p > 0.0, p, 1.0)), np.log(np.where(of_grey > 0.0, of_grey, 1.0))
    by_cell = (((logs_grey + 1.0) - (logs + 1.0) * alone / both) / both / n).ravel()[knots.cells]
    by_u = np.einsum("nij,ni,nj->n", by_cell, knots.rows, knots.columns_by_u)
    by_v = np.einsum("nij,ni,nj->n", by_cell, knots.rows_by_v, knots.columns)
    # uv -> point in the camera -> point in the LiDAR frame -> pose.
    lPs, R = seen.lPs[knots.some], cTl.rotation().matrix()
    uv_H_cP = seen.frame.camera.uv_H_cP(lPs @ R.T + cTl.translation())
    by_point = np.einsum("nk,nkd->nd", np.stack([by_u, by_v], axis=1), uv_H_cP) @ R
    return value, np.concatenate([np.cross(lPs, by_point).sum(axis=0), by_point.sum(axis=0)])


def joint_by_pixel(seen: _Seen, cTl: gtsam.Pose3) -> FloatArray:
    """(bins, bins) joint histogram of grey levels and intensities at the nearest pixels."""
    some, uvs = seen.frame.pixels(cTl, seen.lPs)
    level = np.minimum((seen.values[some] * _MI_BINS).astype(np.intp), _MI_BINS - 1)
    h, w = seen.grey.shape
    row = np.clip((uvs[:, 1] + 0.5).astype(np.intp), 0, h - 1)
    column = np.clip((uvs[:, 0] + 0.5).astype(np.intp), 0, w - 1)
    grey = (seen.grey[row, column].astype(np.intp) * _MI_BINS) >> 8
    counts = np.bincount(grey * _MI_BINS + level, minlength=_MI_BINS**2)
    return counts.reshape(_MI_BINS, _MI_BINS).astype(np.float64)


def mutual_information(joint: FloatArray) -> float:
    """H(x) + H(y) - H(x, y) of a joint histogram [nat]; 0 of an empty one."""
    total = joint.sum()
    if total <= 0.0:
        return 0.0
    p = joint / total
    return _entropy(p.sum(axis=0)) + _entropy(p.sum(axis=1)) - _entropy(p)


def nid(joint: FloatArray) -> float:
    """Normalized information distance (H(x, y) - I(x; y)) / H(x, y) of a joint histogram, 0 to 1."""
    total = joint.sum()
    both = _entropy(joint / total) if total > 0.0 else 0.0
    return 1.0 - mutual_information(joint) / both if both > 0.0 else _OUT_OF_SIGHT


def _entropy(p: FloatArray) -> float:
    positive = p[p > 0.0]
    return float(-(positive * np.log(positive)).sum())
