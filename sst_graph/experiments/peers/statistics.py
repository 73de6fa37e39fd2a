"""Intensities of the returns against grey levels: mutual information, and what is made of it.

* NID: normalized information distance of direct_visual_lidar_calibration (Koide et al., ICRA 2023;
  github.com/koide3/direct_visual_lidar_calibration, ``visual_camera_calibration.cpp``,
  ``nid_cost.hpp``): 16 bins, B-spline weights over 4 x 4 pixels, hidden points removed by a depth buffer,
  inner optimization repeated until it moves less than 0.1 m and 0.5 deg. Left out: the initial guess by
  SuperGlue, dense clouds of many scans; gradients are numerical where the original's are automatic.
* MI: mutual information of Pandey et al. (AAAI 2012): 64 bins of either, smoothed by a Gaussian; here hidden
  points are removed too, and it is climbed by Nelder and Mead in place of gradient ascent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize

from sst_graph.errors import EstimationError
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, moved_by

FloatArray = NDArray[np.float64]

_NID_BINS, _OUTER = 16, 10
_INNER = 256
"""Iterations of Nelder and Mead: the original's."""
_STEP = 1e-3
"""First step of the simplex, and of numerical gradients [rad, m]: the original's simplex."""
_REACH_DEG, _REACH_M = 2.0, 0.2
"""The original's BFGS goes no farther than this from where it began [deg], [m]."""
_DONE_M, _DONE_RAD = 0.1, float(np.radians(0.5))
_MI_BINS, _MI_BLUR = 64, 1.5
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
        frame: whose picture they are compared with.
        lPs: (n, 3) [m]; values (n,) intensities, spread over 0 to 1.
    """

    frame: PeerFrame
    lPs: FloatArray
    values: FloatArray


def solve_nid(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """Refinement by BFGS and, where that stands still, by Nelder and Mead.

    Raises:
        EstimationError: the data tell no intensities.
    """
    _require(problem)
    cTl = start
    for _ in range(_OUTER):
        seen = [_visible(frame, cTl) for frame in problem.frames]

        def cost(step: FloatArray, seen: Sequence[_Seen] = seen, at: gtsam.Pose3 = cTl) -> float:
            pose = moved_by(at, step)
            return sum(nid(joint_by_spline(each, pose)) for each in seen)

        bounds = [(-np.radians(_REACH_DEG), np.radians(_REACH_DEG))] * 3 + [(-_REACH_M, _REACH_M)] * 3
        options = {"eps": _STEP, "maxiter": 30}
        by_gradient = minimize(cost, np.zeros(6), method="L-BFGS-B", bounds=bounds, options=options)
        step = _nelder_mead(cost, by_gradient.x, np.full(6, _STEP), _INNER)
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
    every = [_visible(frame, start) for frame in problem.frames]

    def cost(step: FloatArray) -> float:
        pose = moved_by(start, step)
        joint = np.sum([joint_by_pixel(each, pose) for each in every], axis=0)
        return -mutual_information(gaussian_filter(joint, _MI_BLUR, mode="constant"))

    # The first simplex is half as wide as the starts' error.
    steps = 0.5 * np.repeat([np.radians(max(problem.range_deg, 0.1)), max(problem.range_m, 0.01)], 3)
    return moved_by(start, _nelder_mead(cost, np.zeros(6), steps, 3 * _INNER))


def _require(problem: PeerProblem) -> None:
    if not problem.has_intensities:
        raise EstimationError("the data tell no intensities")


def _nelder_mead(
    cost: Callable[[FloatArray], float], first: FloatArray, steps: FloatArray, most: int
) -> FloatArray:
    simplex = np.vstack([first, first + np.diag(steps)])
    options = {"initial_simplex": simplex, "maxiter": most, "xatol": 1e-5, "fatol": 1e-8}
    return np.asarray(minimize(cost, first, method="Nelder-Mead", options=options).x)


def _equalized(intensities: FloatArray) -> FloatArray:
    """Intensities by their rank, 0 to 1: bins are filled evenly, as the original's preprocessing does."""
    ranks = np.argsort(np.argsort(intensities, kind="stable"), kind="stable")
    return np.asarray(ranks / max(1, len(ranks) - 1))


def _visible(frame: PeerFrame, cTl: gtsam.Pose3) -> _Seen:
    """The points of a frame that no nearer one hides at a pose."""
    inside, uvs = frame.pixels(cTl, frame.lPs)
    depth = np.linalg.norm(frame.lPs[inside], axis=1)
    columns = int(np.ceil(frame.camera.width / _CELL_PX)) + 1
    cells = (uvs[:, 1] / _CELL_PX).astype(np.intp) * columns + (uvs[:, 0] / _CELL_PX).astype(np.intp)
    nearest = np.full(int(cells.max()) + 1 if len(cells) else 1, np.inf)
    np.minimum.at(nearest, cells, depth)
    kept = inside[depth < _HIDDEN * nearest[cells]]
    kept = kept[:: max(1, -(-len(kept) // _POINTS))]
    assert frame.intensities is not None
    return _Seen(frame, frame.lPs[kept], _equalized(frame.intensities)[kept])


def joint_by_spline(seen: _Seen, cTl: gtsam.Pose3) -> FloatArray:
    """(bins, bins) joint histogram of grey levels and intensities, by B-spline weights over 4 x 4 pixels."""
    some, uvs = seen.frame.pixels(cTl, seen.lPs)
    level = np.minimum((seen.values[some] * _NID_BINS).astype(np.intp), _NID_BINS - 1)
    base = np.floor(uvs).astype(np.intp)
    powers = (uvs - base)[:, :, None] ** np.arange(4)
    weights = powers @ _KNOTS.T
    h, w = seen.frame.grey.shape
    around = np.arange(-1, 3)
    columns = np.clip(base[:, 0, None] + around, 0, w - 1)
    rows = np.clip(base[:, 1, None] + around, 0, h - 1)
    grey = (seen.frame.grey[rows[:, :, None], columns[:, None, :]].astype(np.intp) * _NID_BINS) >> 8
    cells = grey * _NID_BINS + level[:, None, None]
    weight = weights[:, 1, :, None] * weights[:, 0, None, :]
    histogram = np.bincount(cells.ravel(), weight.ravel(), _NID_BINS**2)
    return np.asarray(histogram.reshape(_NID_BINS, _NID_BINS), dtype=np.float64)


def joint_by_pixel(seen: _Seen, cTl: gtsam.Pose3) -> FloatArray:
    """(bins, bins) joint histogram of grey levels and intensities at the nearest pixels."""
    some, uvs = seen.frame.pixels(cTl, seen.lPs)
    level = np.minimum((seen.values[some] * _MI_BINS).astype(np.intp), _MI_BINS - 1)
    h, w = seen.frame.grey.shape
    row = np.clip((uvs[:, 1] + 0.5).astype(np.intp), 0, h - 1)
    column = np.clip((uvs[:, 0] + 0.5).astype(np.intp), 0, w - 1)
    grey = (seen.frame.grey[row, column].astype(np.intp) * _MI_BINS) >> 8
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
