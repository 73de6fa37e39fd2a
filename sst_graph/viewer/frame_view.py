"""What a viewer shows of a frame, taken from the window of the tracker's latest scans and images."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors import residuals
from sst_graph.fit import MatchedFrame
from sst_graph.graph.matching import PairMatches
from sst_graph.report.drawn_frame import DrawnFrame
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.types import CameraImage, FloatArray, Frame, Scan, SemanticClass

_PICTURES = 24
"""Latest images that are kept until their scan is shown."""
_WAITING = 3
"""Scans that may come after one whose image is not there yet."""


@dataclass(frozen=True)
class MatchView:
    """The matches of a frame under a calibration.

    Attributes:
        boundary: (n, 2) pixels of the scan's boundary points, moved to the image's instant [px].
        contour: (n, 2) matched pixels of the masks' contours [px].
        residuals_px: (n,) signed distances across the contours [px].
    """

    boundary: FloatArray
    contour: FloatArray
    residuals_px: FloatArray


@dataclass(frozen=True)
class FrameView:
    """A frame as it is shown.

    Attributes:
        number: of the frame.
        scan: of it.
        oTl: pose of the LiDAR in that of the first scan, by odometry.
        cTl: pose of the LiDAR in the camera.
        image: the image that shows the scan's instant best; None where none is near.
        uvs: (m, 2) pixels of the points that fall on the image [px].
        depths_m: (m,) their depths [m].
        seen: (m,) their positions in the scan.
        matches: boundary points with their contours; None without any.
        tracks: class and centre (3,) [m], in the first scan's LiDAR frame, of each tracked object of the
            scan, by its track's number.
    """

    number: int
    scan: Scan
    oTl: gtsam.Pose3
    cTl: gtsam.Pose3
    image: CameraImage | None
    uvs: FloatArray
    depths_m: FloatArray
    seen: NDArray[np.intp]
    matches: MatchView | None
    tracks: Mapping[int, tuple[SemanticClass, FloatArray]]


@dataclass(frozen=True)
class _Waiting:
    """A scan that is still to be shown."""

    number: int
    frame: int
    scan: Scan
    oTl: gtsam.Pose3
    l_twist: FloatArray | None
    tracks: Mapping[int, tuple[SemanticClass, FloatArray]]


class FrameViews:
    """Views of the frames that a window takes in; a scan is shown when its image is there."""

    def __init__(self, matcher: WindowMatcher) -> None:
        self._matcher, self._window = matcher, matcher.window
        self._images: dict[int, CameraImage] = {}
        self._waiting: deque[_Waiting] = deque()

    def taken(self, frame: Frame, before: tuple[int, int], point: Point) -> Iterator[FrameView]:
        """Views that can be made after the window was given a frame.

        Args:
            before: numbers of the next image and scan of the window before that (``Window.place``): what was
                refused has none.
            point: the calibration.
        """
        window = self._window
        if frame.image is not None and window.next_image > before[0]:
            self._images[window.next_image - 1] = frame.image
            for old in sorted(self._images)[:-_PICTURES]:
                del self._images[old]
        if frame.scan is not None and window.next_scan > before[1]:
            self._waiting.append(self._newest(frame.index, frame.scan))
        yield from self._ready(point, _WAITING)

    def rest(self, point: Point) -> Iterator[FrameView]:
        """Views of all scans that still wait for an image."""
        yield from self._ready(point, 0)

    def _newest(self, frame: int, scan: Scan) -> _Waiting:
        window, number = self._window, self._window.next_scan - 1
        motion = window.motions[-1] if window.motions else None
        known = motion is not None and motion.ok and motion.to_ns == scan.stamp_ns
        seen = set(window.tracks.get(number, {}).values())
        tracks = {track: one for track, one in window.objects.live.items() if track in seen}
        l_twist = motion.mean_twist if motion is not None and known else None
        return _Waiting(number, frame, scan, window.wTl, l_twist, tracks)

    def _ready(self, point: Point, most: int) -> Iterator[FrameView]:
        while self._waiting:
            pair = self._pair(self._waiting[0].number, point)
            if pair is None and len(self._waiting) <= most:
                return
            yield self._view(self._waiting.popleft(), pair, point)

    def _pair(self, number: int, point: Point) -> PairMatches | None:
        """Matches of a scan of the window; None without any."""
        if not self._window.first_scan <= number:
            return None
        pair = self._matcher.pairs_at(point, {number}, self._matcher.kernel).get(number)
        return pair if pair is not None and len(pair) else None

    def _view(self, waiting: _Waiting, pair: PairMatches | None, point: Point) -> FrameView:
        scan, image = waiting.scan, self._image(waiting.scan, pair, point)
        none = np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.intp)
        uvs, depths, seen = none
        matches = None
        if image is not None:
            drawn = self._drawn(waiting, image, pair, point)
            uvs, depths = drawn.projected(point.cTl, point.time_offset_s)
            seen = np.flatnonzero(drawn.camera.in_image(uvs))
            uvs, depths = uvs[seen], depths[seen]
            matches = None if pair is None else _matches(drawn, pair, point)
        return FrameView(
            waiting.frame, scan, waiting.oTl, point.cTl, image, uvs, depths, seen, matches, waiting.tracks
        )

    def _image(self, scan: Scan, pair: PairMatches | None, point: Point) -> CameraImage | None:
        """The image of a pair, or the one closest in true time."""
        if pair is not None:
            return self._images.get(self._window.images[pair.pair.image].index)
        instant_ns = scan.stamp_ns - round(1e9 * point.time_offset_s)
        return min(self._images.values(), key=lambda one: abs(one.stamp_ns - instant_ns), default=None)

    def _drawn(
        self, waiting: _Waiting, image: CameraImage, pair: PairMatches | None, point: Point
    ) -> DrawnFrame:
        base_tau_s = 1e-9 * (image.stamp_ns - waiting.scan.stamp_ns)
        c_twist, c_acceleration = np.zeros(6), np.zeros(6)
        if pair is not None:
            c_twist, c_acceleration = pair.motion.c_twist, pair.motion.c_acceleration
        elif waiting.l_twist is not None:
            c_twist = np.asarray(point.cTl.AdjointMap() @ waiting.l_twist)
        frame = MatchedFrame("", waiting.frame, waiting.frame, base_tau_s, c_twist, c_acceleration)
        return DrawnFrame(frame, waiting.scan, image, self._window.camera)


def _matches(drawn: DrawnFrame, pair: PairMatches, point: Point) -> MatchView | None:
    parts = []
    for found in pair.matches.values():
        alignment = found.alignment
        if alignment.normals is None or not len(alignment.lPs):
            continue
        taus_s = point.time_offset_s + np.broadcast_to(alignment.base_taus_s, len(alignment.lPs))
        lPs = alignment.lPs
        if alignment.l_velocities is not None:
            lPs = lPs + taus_s[:, None] * alignment.l_velocities
        uvs, _ = drawn.placed(lPs, taus_s, point.cTl)
        r, _ = residuals(alignment, point.cTl, point.time_offset_s, pair.motion.c_twist, jacobians=False)
        parts.append((uvs, alignment.pixels, r))
    if not parts:
        return None
    uvs, pixels, r = (np.concatenate(column) for column in zip(*parts, strict=True))
    shown = np.isfinite(uvs).all(axis=1)
    return MatchView(uvs[shown], pixels[shown], r[shown])
