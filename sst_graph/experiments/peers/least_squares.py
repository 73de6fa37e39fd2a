"""The paper's residuals in ``scipy.optimize.least_squares``, as a short script would have them.

SST-Calib, eq. 2 to 4: each labelled point to the nearest pixel of its class, each sampled pixel of the mask
to the nearest projected point, matched anew at every evaluation; Huber loss of 5 px, bounds of 1.5 times
the starts' error by axis. Left out: the paper's schedule of weights, and its joint stage (the time offset is
given).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from sst_graph.association.nearest import sample_pixels
from sst_graph.errors import EstimationError
from sst_graph.experiments.peers.frames import PeerFrame, PeerProblem, moved_by
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, SemanticClass

_POINTS, _PIXEL_SHARE = 800, 0.02
"""Most points of a frame; share of the mask's pixels: the paper's."""
_HUBER_PX = 5.0
_OFF_IMAGE_PX = 50.0
"""Residual of a point off the image, and the largest of any [px]: so that their number stays the same."""
_STEP = 1e-3
"""Of numerical derivatives [rad, m]: several pixels, for distances to whole pixels have steps."""
_EVALUATIONS = 60
_REACH = 1.5
"""Bounds, in half widths of the starts' error by axis: without them it drifts away."""


@dataclass(frozen=True, eq=False)
class _ClassFrame:
    """Vehicle points (n, 3) [m], their distance map (h, w) and a sample of the mask's pixels (m, 2) [px]."""

    frame: PeerFrame
    lPs: FloatArray
    distances: FloatArray
    pixels: FloatArray

    def residuals(self, cTl: gtsam.Pose3) -> FloatArray:
        """(n + m,) distances [px]."""
        forward = np.full(len(self.lPs), _OFF_IMAGE_PX)
        backward = np.full(len(self.pixels), _OFF_IMAGE_PX)
        inside, uvs = self.frame.pixels(cTl, self.lPs)
        if len(inside):
            h, w = self.distances.shape
            row = np.clip((uvs[:, 1] + 0.5).astype(np.intp), 0, h - 1)
            column = np.clip((uvs[:, 0] + 0.5).astype(np.intp), 0, w - 1)
            forward[inside] = self.distances[row, column]
            backward = cKDTree(uvs).query(self.pixels)[0]
        ratio = np.sqrt(len(self.lPs) / max(1, len(self.pixels)))
        return np.asarray(np.minimum(np.concatenate([forward, ratio * backward]), _OFF_IMAGE_PX))


def solve_least_squares(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """The local optimum from the start.

    Raises:
        EstimationError: no frame shows a vehicle to both sensors.
    """
    rng = np.random.default_rng(problem.seed)
    found = (_class_frame(frame, rng) for frame in problem.frames)
    frames = [frame for frame in found if frame is not None]
    if not frames:
        raise EstimationError("no frame in which LiDAR and camera both show vehicle")

    def residuals(step: FloatArray) -> FloatArray:
        pose = moved_by(start, step)
        return np.concatenate([frame.residuals(pose) for frame in frames])

    def jacobian(step: FloatArray) -> FloatArray:
        # scipy's own steps are relative to the variables, which begin at 0.
        columns = [residuals(step + _STEP * e) - residuals(step - _STEP * e) for e in np.eye(6)]
        return np.stack(columns, axis=1) / (2.0 * _STEP)

    half = np.repeat([np.radians(max(problem.range_deg, 0.1)), max(problem.range_m, 0.01)], 3)
    settings: dict[str, Any] = {"loss": "huber", "f_scale": _HUBER_PX, "max_nfev": _EVALUATIONS}
    settings["bounds"] = (-_REACH * half, _REACH * half)
    return moved_by(start, least_squares(residuals, np.zeros(6), jacobian, **settings).x)


def _class_frame(frame: PeerFrame, rng: np.random.Generator) -> _ClassFrame | None:
    lPs = frame.lPs[frame.classes == SemanticClass.VEHICLE]
    shown = frame.mask == SemanticClass.VEHICLE
    if len(lPs) == 0 or not shown.any():
        return None
    lPs = lPs[:: step_for(len(lPs), _POINTS)]
    return _ClassFrame(frame, lPs, distance_transform_edt(~shown), sample_pixels(shown, _PIXEL_SHARE, rng))
