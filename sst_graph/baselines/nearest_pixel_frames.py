"""Frames for the nearest-pixel methods: matched again at every step, one Levenberg-Marquardt step a match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.association.nearest import ClassView, match_nearest
from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.errors import EstimationError
from sst_graph.factors import frame_factor, time_offset_prior
from sst_graph.factors.matches import Alignment
from sst_graph.graph.linear import information_inverse, ordering_of
from sst_graph.graph.state import EXTRINSIC, time_offset_key
from sst_graph.result import FrameId
from sst_graph.types import Calibration, FloatArray, SemanticClass

TIME_OFFSET = time_offset_key(0)

TIME_OFFSET_SIGMA_S = 1.0
"""Prior deviation of the time offset where nothing measures it [s]."""
REST_SIGMAS = np.repeat([1.0, 3.0], 3)
"""Deviations [rad, m] that only keep the covariance of an unseen direction finite."""


@dataclass(frozen=True)
class FramePair:
    """A scan and the image of the same frame.

    Attributes:
        drive: number of the drive.
        image_position: of the image in its drive.
        scan, image: what is kept of them.
    """

    drive: int
    image_position: int
    scan: ScanFeatures
    image: ImageFeatures

    @property
    def base_tau_s(self) -> float:
        """Image stamp minus scan stamp [s]."""
        return (self.image.stamp_ns - self.scan.stamp_ns) * 1e-9


def frame_pairs(drives: Sequence[Drive]) -> list[FramePair]:
    """Scans and images of the same frame: pairs by equal stamps, as SST-Calib has them."""
    pairs = []
    for number, drive in enumerate(drives):
        scans = {scan.index: scan for scan in drive.scans}
        for position, image in enumerate(drive.images):
            if image.index in scans:
                pairs.append(FramePair(number, position, scans[image.index], image))
    return pairs


@dataclass(frozen=True)
class MatchFrame:
    """A pair that is matched again and again.

    Attributes:
        pair: scan and image.
        drive_name: name of its drive.
        views: one for each class that both show.
        c_twist: (6,) camera twist that the pair's interval is bridged with [rad/s, m/s].
    """

    pair: FramePair
    drive_name: str
    views: tuple[ClassView, ...]
    c_twist: FloatArray

    @property
    def id(self) -> FrameId:
        return FrameId(self.drive_name, self.pair.image.index)

    def moving_at(self, c_velocity: FloatArray) -> MatchFrame:
        """The frame with a camera velocity (3,) [m/s]."""
        return replace(self, c_twist=np.concatenate([np.zeros(3), c_velocity]))


def match_frames(
    pairs: Sequence[FramePair],
    drives: Sequence[Drive],
    classes: Sequence[SemanticClass],
    pixel_share: float,
    seed: int,
) -> list[MatchFrame]:
    """Frames, at rest, of those pairs in which scan and mask both show a class."""
    frames = []
    for pair in pairs:
        rng = np.random.default_rng([seed, pair.drive, pair.image.index])
        drive, views = drives[pair.drive], []
        for c in classes:
            lPs = pair.scan.lPs[pair.scan.classes == c]
            view = ClassView.of(drive.camera, lPs, pair.base_tau_s, pair.image.mask == c, pixel_share, rng)
            if view is not None:
                views.append(view)
        if views:
            frames.append(MatchFrame(pair, drive.name, tuple(views), np.zeros(6)))
    return frames


def frame_alignments(
    frames: Sequence[MatchFrame], at: Calibration, pixel_weight: float, max_px: float
) -> list[tuple[MatchFrame, list[Alignment]]]:
    """Fresh matches of every frame that has any.

    Raises:
        EstimationError: no point of any frame falls on its image.
    """
    found = []
    for frame in frames:
        matches = [
            match_nearest(view, at.cTl, at.time_offset_s, frame.c_twist, pixel_weight, max_px=max_px)
            for view in frame.views
        ]
        alignments = [a for match in matches if match is not None for a in match.alignments]
        if alignments:
            found.append((frame, alignments))
    if not found:
        raise EstimationError("no labelled point of any frame falls on its image")
    return found


def step_once(
    frames: Sequence[MatchFrame],
    at: Calibration,
    pixel_weight: float,
    beta: gtsam.CustomFactor | None = None,
    *,
    offset_free: bool = False,
    max_px: float = np.inf,
) -> Calibration:
    """Match at ``at``, then one Levenberg-Marquardt step.

    Args:
        beta: regularizer of the extrinsic (key :data:`EXTRINSIC`).
        offset_free: whether the time offset moves too.
        max_px: points farther than this from their pixel are left out [px].

    Raises:
        EstimationError: no point of any frame falls on its image.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for frame, alignments in frame_alignments(frames, at, pixel_weight, max_px):
        graph.add(
            frame_factor(
                alignments, EXTRINSIC, TIME_OFFSET if offset_free else at.time_offset_s, frame.c_twist
            )
        )
    values.insert(EXTRINSIC, at.cTl)
    if beta is not None:
        graph.add(beta)
    if offset_free:
        graph.add(time_offset_prior(TIME_OFFSET, at.time_offset_s, TIME_OFFSET_SIGMA_S))
        values.insert(TIME_OFFSET, np.array([at.time_offset_s]))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, _single_step())
    optimizer.iterate()
    moved = optimizer.values()
    return Calibration(
        moved.atPose3(EXTRINSIC), float(moved.atVector(TIME_OFFSET)[0]) if offset_free else at.time_offset_s
    )


def _single_step() -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setlambdaInitial(1e-6)
    return params


def frozen_covariance(
    frames: Sequence[MatchFrame], at: Calibration, pixel_weight: float, max_px: float = np.inf
) -> FloatArray:
    """(7, 7) covariance as if the matches were certain and independent, scaled by their mean square.

    Too small: neighbouring matches err together, and interior points claim half a pixel.

    Raises:
        EstimationError: no point of any frame falls on its image.
    """
    matched = frame_alignments(frames, at, pixel_weight, max_px)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(EXTRINSIC, at.cTl)
    values.insert(TIME_OFFSET, np.array([at.time_offset_s]))
    fitted = gtsam.NonlinearFactorGraph()
    for frame, alignments in matched:
        fitted.add(frame_factor(alignments, EXTRINSIC, TIME_OFFSET, frame.c_twist))
    rows = sum(2.0 * float(np.sum(a.weights)) for _, alignments in matched for a in alignments)
    mean_square = max(2.0 * fitted.error(values) / rows, 1e-6)
    for frame, alignments in matched:
        scaled = [replace(a, weights=np.asarray(a.weights) / mean_square) for a in alignments]
        graph.add(frame_factor(scaled, EXTRINSIC, TIME_OFFSET, frame.c_twist))
    graph.add(time_offset_prior(TIME_OFFSET, at.time_offset_s, TIME_OFFSET_SIGMA_S))
    rest = gtsam.noiseModel.Diagonal.Sigmas(REST_SIGMAS)
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, at.cTl, rest))
    ordering = ordering_of((EXTRINSIC, TIME_OFFSET))
    return information_inverse(graph.linearize(values).hessian(ordering)[0])
