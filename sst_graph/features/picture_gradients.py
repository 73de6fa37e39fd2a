"""Edges of a picture in any direction, for boundary points of objects that nobody labelled.

The change of colour across a direction, relative to what is usual nearby: a weak edge on a plain road tells
as much as a strong one in foliage. It is bounded, so that no single edge decides, and its local mean is taken
off, so that texture as such is worth nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.features.image_edges import FloatMap, Picture
from sst_graph.features.mask_contour import ContourFeet, well_inside
from sst_graph.features.sampling import SAMPLED_ROWS, sampled
from sst_graph.files.array_store import ArrayStore, shape_of, storable
from sst_graph.types import FloatArray

EdgePlace = Literal["centre", "peak", "strongest"]
"""What a point is compared with: the centre of mass of the strengths nearby, their peak by a step of Newton's
method, or the place of the greatest strength."""

DIRECTIONS = 8
"""Directions of which strengths are kept, evenly over half a turn: an edge half way between two of them, 11
deg off, still has 98 % of its strength."""
_BLUR_PX = 1.0
"""Gaussian blur of the picture before differences are taken [px]."""
_AROUND_PX = 40
"""Width of the surroundings in which a change of colour is judged [px]."""
_FLOOR = 1.5
"""Change of colour [grey levels a pixel] below which surroundings count as plain: noise and compression."""
_MOST = 4.0
"""Largest strength, in units of the mean of the surroundings."""
UNIT = 255.0 / _MOST
"""Stored value of a strength of 1."""
STEP_PX = 0.5
"""Between the places across an edge at which strengths are read [px]."""
_LEAST_MASS = 0.5
"""Least sum of strengths above the usual, times pixels, that makes an edge."""
_LEAST_STIFFNESS = 0.3
"""An edge's peak is taken for no farther than the centre of mass over this share."""
_EDGE_WIDTH_PX, _CENTRE_STEPS = 1.2, 4
"""Sigma of an edge in the strengths [px], and steps of the mean shift to its centre."""
_LEAST_STRENGTH = 1.0
"""Least strength above the usual of an edge that is looked for by its strength: as much again as the mean of
the surroundings."""


@storable("strengths", "usual")
@dataclass(frozen=True)
class PictureGradients:
    """Strength of the edges across :data:`DIRECTIONS` directions in one picture.

    Attributes:
        strengths: (DIRECTIONS * h, w) uint8, one direction's below the other's; see :data:`UNIT`.
        usual: (DIRECTIONS * ceil(h / 4), ceil(w / 4)) uint8, mean of the surroundings of every fourth pixel.
        width, height: of the picture.
    """

    strengths: NDArray[np.uint8]
    usual: NDArray[np.uint8]
    width: int
    height: int

    @classmethod
    def of(cls, picture: Picture, valid: NDArray[np.bool_] | None = None) -> PictureGradients:
        """The gradients of a picture (h, w, 3).

        Args:
            valid: (h, w) where the lens shows anything; there is no edge beside pixels where it does not.
        """
        smooth = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
        gx, gy = (cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1.0 / 32.0) for axis in ((1, 0), (0, 1)))
        # The structure tensor, summed over the colours, holds the change across every direction: the square
        # across the angle a is mean + half cos 2a + xy sin 2a, with half the difference of xx and yy.
        xx, xy, yy = (cv2.transform(a * b, np.ones((1, 3))) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
        if valid is not None:
            seen = 1 - cv2.dilate((~valid).view(np.uint8), np.ones((7, 7), np.uint8))
            xx, xy, yy = (each * seen for each in (xx, xy, yy))
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        changes = []
        for c, s in zip(*_double_angles(), strict=True):
            square = np.add(cv2.addWeighted(half, c, xy, s, 0.0), mean)
            changes.append(cv2.sqrt(np.maximum(square, 0.0, out=square)))
        around = (2 * (_AROUND_PX // 2) + 1,) * 2
        usual_change = cv2.blur(sum(changes[1:], changes[0]), around) / np.float32(DIRECTIONS)
        per_mean = np.float32(UNIT) / (usual_change + np.float32(_FLOOR))
        height, width = picture.shape[:2]
        quarter, nearby = (-(-width // 4), -(-height // 4)), (2 * (_AROUND_PX // 8) + 1,) * 2
        strengths = [cv2.multiply(change, per_mean, dtype=cv2.CV_8U) for change in changes]
        usual = [
            cv2.blur(cv2.resize(strength, quarter, interpolation=cv2.INTER_AREA), nearby)
            for strength in strengths
        ]
        return cls(np.concatenate(strengths), np.concatenate(usual), width, height)

    def stored_in(self, store: ArrayStore) -> PictureGradients:
        """The gradients with their fields in an array store."""
        return replace(self, strengths=store.put(self.strengths), usual=store.put(self.usual))

    def blurred(self, sigma_px: float, every: int) -> FloatMap:
        """(DIRECTIONS, h / every, w / every) strengths above the usual, blurred, of every so many pixels;
        both sizes rounded up."""
        width, height = -(-self.width // every), -(-self.height // every)
        # Padded to whole cells: no pixel is shared by two, and the means are ten times as fast.
        border = (0, height * every - self.height, 0, width * every - self.width)
        fields = []
        for strength, mean in zip(
            np.split(self.strengths, DIRECTIONS), np.split(self.usual, DIRECTIONS), strict=True
        ):
            whole = cv2.copyMakeBorder(strength, *border, cv2.BORDER_REPLICATE)
            small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
            small -= cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
            fields.append(cv2.GaussianBlur(small, (0, 0), sigma_px / every) / np.float32(UNIT))
        return np.stack(fields)

    def strengths_at(self, u: FloatMap, v: FloatMap, number: NDArray[np.intp]) -> NDArray[np.uint8]:
        """(m, n) strengths at columns u and rows v (m, n) across the directions of numbers (n,)."""
        if DIRECTIONS * self.height < SAMPLED_ROWS:
            rows = v + (number * self.height).astype(np.float32)
            return np.asarray(sampled(self.strengths, u, rows), np.uint8)
        found = np.empty(u.shape, np.uint8)
        for direction, strengths in enumerate(np.split(self.strengths, DIRECTIONS)):
            if len(some := np.flatnonzero(number == direction)):
                found[:, some] = sampled(strengths, u[:, some], v[:, some])
        return found

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the strengths, which are not read for it."""
        return shape_of(self, "strengths")


def _double_angles() -> tuple[list[float], list[float]]:
    """Cosines and sines of twice the directions' angles."""
    angles = 2.0 * np.pi / DIRECTIONS * np.arange(DIRECTIONS)
    return np.cos(angles).tolist(), np.sin(angles).tolist()


def direction_numbers(directions: FloatArray) -> NDArray[np.intp]:
    """(n,) number of the kept direction nearest to unit vectors (n, 2)."""
    angles = np.arctan2(directions[:, 1], directions[:, 0])
    return np.asarray(np.rint(angles * DIRECTIONS / np.pi).astype(np.intp) % DIRECTIONS)


def profiles(
    gradients: Sequence[PictureGradients],
    spans: Sequence[tuple[int, int]],
    uvs: FloatArray,
    outward: FloatArray,
    ts: FloatArray,
) -> FloatMap:
    """(m, n) strengths above the usual at m distances ``ts`` outward from pixels uvs (n, 2) of several
    pictures.

    Args:
        spans: where the pixels of each picture begin and end, one after the other.
        outward: (n, 2) unit vectors.
    """
    found, usual = np.zeros((len(ts), len(uvs)), np.float32), np.zeros(len(uvs), np.float32)
    number = direction_numbers(outward)
    # 1. Where to look, for all pictures at once.
    sizes = np.array([(each.width, each.height) for each in gradients], np.intp).reshape(-1, 2)
    width, height = np.repeat(sizes, [b - a for a, b in spans], axis=0).T
    distances, (u, v) = ts.astype(np.float32)[:, None], uvs.T.astype(np.float32)
    across, down = outward.T.astype(np.float32)
    u, v = u + distances * across, v + distances * down
    # The fields of the directions stand one below the other: rows are kept within their own field. Columns
    # need no limit, the border is repeated there.
    np.maximum(v, np.float32(0.0), out=v)
    np.minimum(v, (height - 1).astype(np.float32), out=v)
    column, row = np.maximum((uvs / 4.0).astype(np.intp).T, 0)
    columns, rows = -(-width // 4), -(-height // 4)
    places = (np.minimum(row, rows - 1) + number * rows) * columns + np.minimum(column, columns - 1)
    # 2. Strengths there, less what is usual nearby.
    for each, (a, b) in zip(gradients, spans, strict=True):
        if b > a:
            found[:, a:b] = each.strengths_at(u[:, a:b], v[:, a:b], number[a:b])
            usual[a:b] = each.usual.take(places[a:b])
    found -= usual
    found /= np.float32(UNIT)
    return found


@dataclass(frozen=True)
class GradientFeet(ContourFeet):
    """Edges of pictures near pixels, as :class:`ContourFeet`; and (n,) how strong each is, 0 to 1."""

    shares: FloatArray


def nearest_edges(
    gradients: Sequence[PictureGradients],
    spans: Sequence[tuple[int, int]],
    uvs: FloatArray,
    outward: FloatArray,
    scale_px: float,
    place: EdgePlace = "centre",
) -> GradientFeet:
    """Edges across the outward directions near pixels uvs (n, 2): their centres of mass under a Gaussian.

    To match these again and again, and to minimise squared distances in between, climbs the sum of the
    strengths under that Gaussian (mean shift; Comaniciu and Meer, PAMI 2002).

    The centre m follows the pixel x: dm/dx = V / scale^2, V the variance of the strengths under the Gaussian.
    So the distance x - m grows with the stiffness 1 - V / scale^2 of x alone. The peak, where it is 0, is the
    step of Newton's method, (m - x) / stiffness away, and the information is that of the distance to the
    peak times the stiffness.

    Args:
        outward: (n, 2) unit vectors.
        scale_px: sigma of the Gaussian [px].
        place: peaks instead of the centres, shares times the stiffness; or where the strength under the
            Gaussian is greatest: one edge of several, which does not follow the pixel. It tells how far off
            a pose is.
    """
    n = len(uvs)
    if n == 0:
        return GradientFeet(np.zeros(0), uvs, uvs, np.zeros(0, np.bool_), np.zeros(0))
    step = max(STEP_PX, scale_px / 6.0)
    ts = np.arange(-3.0 * scale_px, 3.0 * scale_px + 1e-9, step)
    sizes = [(each.width, each.height) for each in gradients]
    width, height = np.repeat(np.array(sizes).reshape(-1, 2), [b - a for a, b in spans], axis=0).T
    valid = well_inside(uvs[:, 0], uvs[:, 1], width, height)
    safe = np.where(valid[:, None], uvs, 5.0)
    mass = profiles(gradients, spans, safe, outward, ts)
    np.maximum(mass, 0.0, out=mass)
    window = np.exp(-0.5 * (ts / scale_px) ** 2)
    if place == "strongest":
        centre, strengths = _strongest(mass, ts, window)
        valid &= strengths > _LEAST_STRENGTH
        return GradientFeet(-centre, outward, safe + centre[:, None] * outward, valid, strengths / _MOST)
    moments = (np.stack([np.ones_like(ts), ts, ts**2]) * window).astype(np.float32)
    total, first, second = (moments @ mass).astype(np.float64)
    centre = first / np.maximum(total, 1e-9)
    valid &= total * step > _LEAST_MASS
    shares = np.minimum(total * step / (_MOST * 2.0), 1.0)
    if place == "peak":
        variance = second / np.maximum(total, 1e-9) - centre**2
        stiffness = 1.0 - variance / scale_px**2
        centre = centre / np.maximum(stiffness, _LEAST_STIFFNESS)
        shares = shares * np.maximum(stiffness, 0.0)
    return GradientFeet(-centre, outward, safe + centre[:, None] * outward, valid, shares)


def _strongest(strengths: FloatMap, ts: FloatArray, window: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) distances of the edges of strengths (m, n) with the greatest mass under the window (m,) [px], and
    (n,) their strengths, both without it: strong edges are bounded, so that it would move them along their
    flat tops."""
    ts = ts.astype(np.float32)
    best = (strengths * window.astype(np.float32)[:, None]).argmax(axis=0)
    place = ts[best]
    for _ in range(_CENTRE_STEPS):
        near = strengths * np.exp(np.float32(-0.5 / _EDGE_WIDTH_PX**2) * (ts[:, None] - place) ** 2)
        place = ts @ near / np.maximum(near.sum(axis=0), np.float32(1e-9))
    return place.astype(np.float64), strengths[best, np.arange(len(best))].astype(np.float64)
