"""SemAlign (Liu et al., IROS 2021) as a baseline: many sampled starts, then points to nearest pixels.

Spatial only. Each start is scored by the mean truncated distance of its class points to the mask; the best
one is refined by least squares on point-to-pixel matches, found again at every step.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.ndimage import distance_transform_edt

from sst_graph.baselines.nearest_pixel_frames import MatchFrame, frozen_covariance, step_once
from sst_graph.baselines.sst_calib import NearestSolution, PaperProblem, still_frames
from sst_graph.factors import PinholeCamera
from sst_graph.sampling import step_for
from sst_graph.types import Calibration, FloatArray

BOX_DEG, BOX_M = 10.0, 0.1
"""Half widths of the samples about the guess, by axis [deg], [m]: the starts of the paper's experiments."""
TRUNCATION_PX = 50.0
"""Distances count no more than this [px]: of points whose object has no mask."""
_STARTS = 5000
"""Poses that are sampled around the guess."""
_POINTS = 200
"""Most points of a class and frame in the scoring: more cost time."""
_ITERATIONS = 60
"""Matchings of the refinement, one step each, as in the paper's static stage."""
_CHUNK = 100
"""Poses that are scored at once: bounds the memory."""


def solve_semalign(problem: PaperProblem, guess: Calibration) -> NearestSolution:
    """The best sampled start, refined; on the frames of the static stage, the time offset at the guess.

    Raises:
        EstimationError: no frame shows a class to both sensors, or no point falls on any image.
    """
    still = still_frames(problem, guess)
    poses = sampled_poses(guess.cTl, problem.config.seed)
    scores, progress = np.zeros(len(poses)), problem.progress
    for done, frame in enumerate(still.frames, start=1):
        scores += truncated_distances(frame, poses)
        if progress is not None:
            progress("sampled starts", done, len(still.frames))
    at = Calibration(poses[int(scores.argmin())], guess.time_offset_s)
    remaining = np.zeros(7)
    for iteration in range(_ITERATIONS):
        last, at = at, step_once(still.frames, at, 0.0, max_px=TRUNCATION_PX)
        remaining = _ITERATIONS * last.local_coordinates(at)
        if progress is not None:
            progress("points to pixels", iteration + 1, _ITERATIONS)
    covariance = frozen_covariance(still.frames, at, 0.0, TRUNCATION_PX)
    best = float(scores.min()) / len(still.frames)
    numbers: dict[str, object] = {"frames": len(still.frames), "best_start_px": best}
    return NearestSolution(at, covariance, remaining, still.frames, still.reasons, numbers)


def sampled_poses(guess: gtsam.Pose3, seed: int) -> list[gtsam.Pose3]:
    """The guess, then poses with rotation vectors (camera side) and translations uniform in the box."""
    rng = np.random.default_rng(seed)
    turns = np.radians(rng.uniform(-BOX_DEG, BOX_DEG, (_STARTS, 3)))
    shifts = rng.uniform(-BOX_M, BOX_M, (_STARTS, 3))
    turns[0] = shifts[0] = 0.0
    R, t = guess.rotation(), np.asarray(guess.translation())
    return [gtsam.Pose3(gtsam.Rot3.Expmap(w) * R, t + d) for w, d in zip(turns, shifts, strict=True)]


def truncated_distances(
    frame: MatchFrame, poses: Sequence[gtsam.Pose3], truncation_px: float = TRUNCATION_PX
) -> FloatArray:
    """(m,) mean over classes and points of min(distance to the mask, truncation) [px] at each pose.

    A point off the image counts as truncated.
    """
    total = np.zeros(len(poses))
    R = np.stack([pose.rotation().matrix() for pose in poses])
    t = np.stack([pose.translation() for pose in poses])
    for view in frame.views:
        lPs = view.lPs[:: step_for(len(view.lPs), _POINTS)]
        h, w = view.nearest.index.shape
        on_class = view.nearest.index == np.arange(h * w).reshape(h, w)
        distance = np.minimum(distance_transform_edt(~on_class), truncation_px)
        for start in range(0, len(poses), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            cPs = lPs @ R[chunk].transpose(0, 2, 1) + t[chunk, None, :]
            total[chunk] += _looked_up(distance, cPs, view.camera, truncation_px)
    return total / len(frame.views)


def _looked_up(
    distance: FloatArray, cPs: FloatArray, camera: PinholeCamera, truncation_px: float
) -> FloatArray:
    """(m,) mean distance of points cPs (m, n, 3) at their pixels."""
    m, n, _ = cPs.shape
    flat = cPs.reshape(-1, 3)
    uvs = camera.project(flat)
    inside = camera.in_front(flat) & camera.in_image(uvs)
    found = np.full(m * n, truncation_px)
    cells = (uvs[inside] + 0.5).astype(np.intp)
    found[inside] = distance[cells[:, 1], cells[:, 0]]
    return np.asarray(found.reshape(m, n).mean(axis=1))
