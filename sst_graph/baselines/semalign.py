"""SemAlign (Liu et al., IROS 2021) as a baseline: many sampled starts, then points to nearest pixels.

Spatial only. Each start is scored by the mean truncated distance of its class points to the mask; the best
one is refined by least squares on point-to-pixel matches, found anew at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from sst_graph.baselines.nearest_pixel_frames import Calibration, MatchFrame, frozen_covariance, step_once
from sst_graph.baselines.sst_calib import NearestSolution, PaperConfig, still_frames
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.factors import PinholeCamera
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]

_CHUNK = 100


@dataclass(frozen=True)
class SemAlignConfig(Settings):
    """Sampled starts and their refinement.

    Attributes:
        starts: poses sampled around the guess, the guess itself among them.
        box_deg, box_m: half widths of the samples, by axis [deg], [m].
        truncation_px: distances count no more than this [px].
        points: most points of a class and frame in the scoring.
        iterations: re-matches of the refinement, one step each.
        seed: of the samples.
    """

    starts: int = setting(5000, at_least=1, at_most=100_000)
    box_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    box_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    truncation_px: float = setting(50.0, at_least=1.0, at_most=10_000.0)
    points: int = setting(200, at_least=1, at_most=10_000)
    iterations: int = setting(60, at_least=1, at_most=1000)
    seed: int = setting(0, at_least=0, at_most=10**15)


def solve_semalign(
    drives: Sequence[Drive],
    guess: Calibration,
    classes: Sequence[SemanticClass],
    config: SemAlignConfig,
    paper: PaperConfig,
    progress: Progress | None = None,
) -> NearestSolution:
    """The best sampled start, refined; on the frames of the static stage, the time offset at the guess.

    Raises:
        EstimationError: no frame shows a class to both sensors, or no point falls on any image.
    """
    still = still_frames(drives, guess, classes, paper)
    poses = sampled_poses(guess.cTl, config)
    scores = np.zeros(len(poses))
    for done, frame in enumerate(still.frames, start=1):
        scores += truncated_distances(frame, poses, config)
        if progress is not None:
            progress("sampled starts", done, len(still.frames))
    at = Calibration(poses[int(scores.argmin())], guess.offset_s)
    creep = np.zeros(7)
    for iteration in range(config.iterations):
        last, at = at, step_once(still.frames, at, 0.0, max_px=config.truncation_px)
        creep = config.iterations * last.to(at)
        if progress is not None:
            progress("points to pixels", iteration + 1, config.iterations)
    covariance = frozen_covariance(still.frames, at, 0.0, config.truncation_px)
    best = float(scores.min()) / len(still.frames)
    numbers: dict[str, object] = {"frames": len(still.frames), "best_start_px": best}
    return NearestSolution(at, covariance, creep, still.frames, still.reasons, numbers)


def sampled_poses(guess: gtsam.Pose3, config: SemAlignConfig) -> list[gtsam.Pose3]:
    """The guess, then poses with rotation vectors (camera side) and translations uniform in the box."""
    rng = np.random.default_rng(config.seed)
    turns = np.radians(rng.uniform(-config.box_deg, config.box_deg, (config.starts, 3)))
    shifts = rng.uniform(-config.box_m, config.box_m, (config.starts, 3))
    turns[0] = shifts[0] = 0.0
    R, t = guess.rotation(), np.asarray(guess.translation())
    return [gtsam.Pose3(gtsam.Rot3.Expmap(w) * R, t + d) for w, d in zip(turns, shifts, strict=True)]


def truncated_distances(
    frame: MatchFrame, poses: Sequence[gtsam.Pose3], config: SemAlignConfig
) -> FloatArray:
    """(m,) mean over classes and points of min(distance to the mask, truncation) [px] at each pose.

    A point off the image counts as truncated.
    """
    total = np.zeros(len(poses))
    R = np.stack([pose.rotation().matrix() for pose in poses])
    t = np.stack([pose.translation() for pose in poses])
    for view in frame.views:
        lPs = view.lPs[:: max(1, -(-len(view.lPs) // config.points))]
        h, w = view.nearest.index.shape
        on_class = view.nearest.index == np.arange(h * w).reshape(h, w)
        distance = np.minimum(distance_transform_edt(~on_class), config.truncation_px)
        for start in range(0, len(poses), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            cPs = lPs @ R[chunk].transpose(0, 2, 1) + t[chunk, None, :]
            total[chunk] += _looked_up(distance, cPs, view.camera, config.truncation_px)
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
