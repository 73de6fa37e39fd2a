"""How a calibration fits its data, point by point: what a report draws.

It stays in memory beside the result (:attr:`sst_graph.result.CalibrationResult.fit`); of it, only
:class:`FitQuality` is written to calibration.json. Its size is bounded (:data:`MOST_POINTS`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import ByValue, Calibration, FloatArray, IntArray, SemanticClass

CLOSE_PX = 1.5
"""A boundary point closer to its contour than this counts as close [px].

Errors of good masks are about 1 px, and 0.3 deg are 3.8 px with KITTI's camera: at 1.5 px most points are
close under the right calibration, and few under one that is 0.3 deg off."""

MOST_POINTS = 30_000
"""Most boundary points that are kept; with more, every second, third, ... is."""

MASK_BIAS, EDGE_BIAS = "mask_bias_px", "edge_bias_px"
"""Entries of a result's diagnostics, by drive and class."""
QUALITY, EDGES_QUALITY = "fit_quality", "fit_quality_of_edges"
"""Entries of a result's diagnostics: of its fit, and of that of the edges where there are labels beside."""


@dataclass(frozen=True)
class FitQuality:
    """Shares of the boundary points that lie within :data:`CLOSE_PX` of their contour, or of the strongest
    edge of the picture nearby.

    Attributes:
        points: boundary points in view that have a contour of their class, or an edge, nearby.
        share: of them, under the calibration.
        share_at_start: under the calibration that the estimation started from; None without one.
        attainable: what a perfect calibration would give with labels, or edges, like these.
        by_chance: mean under random rotations away from the calibration, of edges of pictures; None of
            contours.
    """

    points: int
    share: float
    share_at_start: float | None
    attainable: float
    by_chance: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As an entry of the diagnostics."""
        return {"within_px": CLOSE_PX, **asdict(self)}

    @classmethod
    def from_diagnostics(cls, diagnostics: Mapping[str, Any], name: str = QUALITY) -> FitQuality | None:
        """An entry of a result's diagnostics; None where there is none, or none that can be read."""
        entry = diagnostics.get(name)
        if not isinstance(entry, Mapping):
            return None
        points, optional = entry.get("points"), [entry.get(name) for name in ("share_at_start", "by_chance")]
        share, attainable = (_share(entry.get(name)) for name in ("share", "attainable"))
        if not isinstance(points, int) or isinstance(points, bool) or not 0 < points < 10**12:
            return None
        if share is None or attainable is None:
            return None
        if any(value is not None and _share(value) is None for value in optional):
            return None
        start, by_chance = map(_share, optional)
        return cls(points, share, start, attainable, by_chance)


@dataclass(frozen=True)
class MeasuredFit:
    """How a calibration fits a drive at its own pose and time offset.

    Attributes:
        drive: its name.
        labels: shares by contours of labels; None where the drive has none of its classes in view.
        edges: shares by edges of the pictures; None without pictures, or objects in view.
        bias_px: by class, how far its masks are drawn too large [px]; it is taken off.
    """

    drive: str
    labels: FitQuality | None
    edges: FitQuality | None
    bias_px: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        parts = {"labels": self.labels, "edges": self.edges}
        return {
            "drive": self.drive,
            "mask_bias_px": dict(self.bias_px),
            **{name: None if one is None else one.to_dict() for name, one in parts.items()},
        }


def bias_entry(
    drives: Sequence[str], biases_px: Mapping[tuple[int, SemanticClass], float]
) -> dict[str, float]:
    """Biases by (number of the drive, class) [px] as an entry of the diagnostics."""
    return {f"{drives[d]}:{c.name.lower()}": bias for (d, c), bias in biases_px.items()}


def mask_biases_px(
    diagnostics: Mapping[str, Any], drive: str, name: str = MASK_BIAS
) -> dict[SemanticClass, float]:
    """How far masks of each class are drawn too large by a result, in a drive of its own [px]; empty for
    another drive. With :data:`EDGE_BIAS`: how far edges of pictures lie outside of the objects."""
    found, biases = diagnostics.get(name), {}
    for semantic_class in SemanticClass:
        value = found.get(f"{drive}:{semantic_class.name.lower()}") if isinstance(found, Mapping) else None
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            biases[semantic_class] = float(value)
    return biases


def _share(value: Any) -> float | None:
    """The number if it is a share, 0 to 1."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value <= 1.0
    return float(value) if good else None


@dataclass(frozen=True, eq=False)
class MatchedFrame(ByValue):
    """A scan, its image, and the motion between them.

    Attributes:
        drive: name of the drive.
        scan, image: index of the frame that each comes from.
        base_tau_s: stamp of the image minus that of the scan [s].
        c_twist, c_acceleration: (6,) of the camera at the image [rad/s, m/s], and its rate of change.
    """

    drive: str
    scan: int
    image: int
    base_tau_s: float
    c_twist: FloatArray
    c_acceleration: FloatArray


@dataclass(frozen=True, eq=False)
class PointResiduals(ByValue):
    """Boundary points, their contours (or edges of the picture) and their residuals under the calibration.

    Attributes:
        frames: (n,) position of each point's frame in :attr:`Fit.frames`.
        classes: (n,) of :class:`~sst_graph.types.SemanticClass`.
        tracks: (n,) number of the object; the same in all frames of a drive, and in no other drive.
        sides: (n,) 0 left, 1 right, 2 top, 3 bottom of the object.
        lPs: (n, 3) in the LiDAR frame [m].
        base_taus_s: (n,) stamp of the image minus the time of the point [s].
        l_velocities: (n, 3) velocity over ground of the object, LiDAR frame [m/s].
        pixels, normals: (n, 2) nearest point of the contour, or the edge's [px], and its outward unit normal.
        residuals_px: (n,) signed distance to the contour, the mask bias of the class taken off [px].
        sigmas_px: (n,) its standard deviation by mask and beam step [px].
        weights: (n,) robust weight, 0 to 1; of an edge of the picture, times how clear it is.
        J: (n, 7) derivative of the residual by extrinsic and time offset [px/rad, px/m, px/s].
    """

    frames: IntArray
    classes: NDArray[np.uint8]
    tracks: IntArray
    sides: IntArray
    lPs: FloatArray
    base_taus_s: FloatArray
    l_velocities: FloatArray
    pixels: FloatArray
    normals: FloatArray
    residuals_px: FloatArray
    sigmas_px: FloatArray
    weights: FloatArray
    J: FloatArray

    def __len__(self) -> int:
        return len(self.frames)

    def take(self, index: IntArray | NDArray[np.bool_] | slice) -> PointResiduals:
        """Some of the points, by position."""
        return PointResiduals(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class OuterIteration(Calibration):
    """One outer iteration of the solution: the extrinsic and the (first) time offset after it.

    Attributes:
        kernel_px: scale of the robust kernel [px]; None of motions.
        matches: number of matches, or of pairs of motions.
    """

    kernel_px: float | None = field(kw_only=True)
    matches: int = field(kw_only=True)


@dataclass(frozen=True, eq=False)
class Profile(ByValue):
    """Profile likelihood along one unknown: the frozen matches' cost, all other unknowns optimised again.

    By edges of pictures the cost is what their score loses, and the other unknowns follow linearly.

    Attributes:
        unknown: its number in the order of the covariance.
        steps: (k,) from the estimate, rising, 0 among them [rad, m or s].
        costs: (k,) beyond the least of them.
        sigma: of the Gaussian whose cost, step^2 / (2 sigma^2), is nearest to these.
        best_score: that the costs are taken off from; None where they are those of matches.
    """

    unknown: int
    steps: FloatArray
    costs: FloatArray
    sigma: float
    best_score: float | None = None


@dataclass(frozen=True, eq=False)
class Fit(ByValue):
    """How a calibration fits its data.

    Attributes:
        frames: that have points.
        points: with their residuals; a sample where there are more than :data:`MOST_POINTS`.
        quality: shares of all points.
        iterations: how the estimate was reached.
        profiles: along each of the seven unknowns.
    """

    frames: tuple[MatchedFrame, ...]
    points: PointResiduals
    quality: FitQuality
    iterations: tuple[OuterIteration, ...] = ()
    profiles: tuple[Profile, ...] = ()

    @property
    def by_edges(self) -> bool:
        """Whether points are compared with edges of pictures, not with contours of labels."""
        return self.quality.by_chance is not None
