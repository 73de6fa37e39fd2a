"""Frozen matches between the points of a scan and the pixels of an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arguments import FloatArray, as_numbers, checked_array, checked_number_or_array, checked_type, described
from .camera import PinholeCamera
from .errors import FactorError, count_of
from .motion import MotionModel, checked_model
from .robust import RobustKernel


@dataclass(frozen=True, eq=False)
class Alignment:
    """Matches (lP_i, q_i) of one image, frozen for an inner optimisation.

    One alignment may hold the matches of many images of one camera, each match with its ``c_acceleration``;
    :func:`sst_graph.factors.residuals` then takes a twist for each. A factor has the matches of one image.

    Shapes are checked and arrays copied (read-only) once, here. No match at all (n = 0) is allowed.

    Attributes:
        camera: the camera of the image.
        lPs: (n, 3) points in the LiDAR frame [m].
        base_taus_s: (n,) or one number: t_image_stamp - t_point [s]; tau = offset + base_tau.
        pixels: (n, 2) matched pixels q [px].
        sigmas_px: (n,) or one number: standard deviation of a match, by axis [px].
        normals: (n, 2) unit normals of the contour at the pixels, towards the outside of the mask (the
            side on which the signed distance is positive), or None for point-to-pixel matches.
        kernel: robust kernel on each match's whitened residual (its 2-norm where it has two rows).
        c_acceleration: (6,) twist's rate of change, or (n, 6) of each match's image [rad/s^2, m/s^2].
        motion_model: "se3" or the first-order "translation" (see :mod:`sst_graph.factors.motion`).
        weights: (n,) or one number: factor on the cost of each match (after the kernel).
        l_velocities: (n, 3) velocity over ground of the object that each point lies on, in the LiDAR frame
            [m/s], or None where all are static.
        stretches: (n,) pixels of the image for one of those in which distances across the contour, their
            sigmas and the mask's bias count, or None: they count in the image's own. An image that was
            rectified is enlarged here and there, and the mask's errors with it.
    """

    camera: PinholeCamera
    lPs: FloatArray
    base_taus_s: FloatArray
    pixels: FloatArray
    sigmas_px: FloatArray
    normals: FloatArray | None = None
    kernel: RobustKernel = field(default_factory=RobustKernel)
    c_acceleration: FloatArray = field(default_factory=lambda: np.zeros(6))
    motion_model: MotionModel = "se3"
    weights: FloatArray = field(default_factory=lambda: np.ones(()))
    l_velocities: FloatArray | None = None
    stretches: FloatArray | None = None

    def __post_init__(self) -> None:
        store = object.__setattr__
        checked_type("camera of an alignment", self.camera, PinholeCamera, "sst_graph.factors.PinholeCamera")
        checked_type("kernel of an alignment", self.kernel, RobustKernel, "sst_graph.factors.RobustKernel")
        store(self, "lPs", checked_array("lPs of an alignment", self.lPs, (None, 3)))
        n = len(self.lPs)
        for name in ("base_taus_s", "sigmas_px", "weights"):
            what = f"{name} of an alignment"
            value = checked_number_or_array(what, getattr(self, name), (n,))
            if isinstance(value, float):
                value = checked_array(what, np.full(n, value), (n,))
            store(self, name, value)
        store(self, "pixels", checked_array("pixels of an alignment", self.pixels, (n, 2)))
        if (self.sigmas_px <= 0.0).any():
            raise FactorError("sigmas_px of an alignment", f"{self.sigmas_px.min():.3g}", "values above 0")
        if self.normals is not None:
            store(self, "normals", checked_array("normals of an alignment", self.normals, (n, 2)))
            lengths = np.sqrt(np.vecdot(self.normals, self.normals))
            if n and float(np.abs(lengths - 1.0).max()) > 1e-3:
                worst = lengths[np.abs(lengths - 1.0).argmax()]
                raise FactorError("normals of an alignment", f"one of length {worst:.3g}", "unit vectors")
        if self.l_velocities is not None:
            velocities = checked_array("l_velocities of an alignment", self.l_velocities, (n, 3))
            store(self, "l_velocities", velocities)
        if self.stretches is not None:
            stretches = checked_array("stretches of an alignment", self.stretches, (n,))
            store(self, "stretches", stretches)
            if self.normals is None or (stretches <= 0.0).any():
                found = "no normals" if self.normals is None else f"{stretches.min():.3g}"
                raise FactorError("stretches of an alignment", found, "normals, and values above 0")
        acceleration = as_numbers("c_acceleration of an alignment", self.c_acceleration, "(6,) or (n, 6)")
        shape = (n, 6) if acceleration.ndim == 2 else (6,)
        acceleration = checked_array("c_acceleration of an alignment", acceleration, shape)
        store(self, "c_acceleration", acceleration)
        checked_model(self.motion_model)
        if (np.asarray(self.weights) <= 0.0).any():
            raise FactorError("weights of an alignment", f"{np.min(self.weights):.3g}", "values above 0")

    def __len__(self) -> int:
        return len(self.lPs)

    def take(self, index: NDArray[np.intp]) -> Alignment:
        """Some of the matches, by position.

        Raises:
            FactorError: positions that are none.
        """
        each = self.c_acceleration
        try:
            if np.ndim(index) == 1:
                return self._some(index, each if each.ndim == 1 else _taken(each, index))
        except IndexError:
            pass
        expected = f"positions of some of {count_of(len(self), 'match', 'matches')}"
        raise FactorError("index of take", described(index), expected)

    def of_one_image(self, index: slice | NDArray[np.intp], c_acceleration: FloatArray) -> Alignment:
        """Some of the matches of many images, which belong to one.

        Args:
            c_acceleration: (6,) of that image's twist [rad/s^2, m/s^2].
        """
        some = self._some(index, checked_array("c_acceleration of an alignment", c_acceleration, (6,)))
        if some.l_velocities is not None and not some.l_velocities.any():
            object.__setattr__(some, "l_velocities", None)
        return some

    def _some(self, index: slice | NDArray[np.intp], c_acceleration: FloatArray) -> Alignment:
        """Some of the matches, not checked again: a check takes longer than all else here."""
        names = [field.name for field in fields(self)]
        values = {name: getattr(self, name) for name in names} | {"c_acceleration": c_acceleration}
        for name in _OF_EACH_MATCH:
            values[name] = None if values[name] is None else _taken(values[name], index)
        some = object.__new__(Alignment)
        vars(some).update(values)
        return some

    @property
    def rows_per_match(self) -> int:
        """2 for point-to-pixel matches, 1 for silhouettes."""
        return 2 if self.normals is None else 1

    @cached_property
    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """lPs (3, n), pixels (2, n), normals over stretches (2, n), contiguous by row, for the hot path."""
        normals = None if self.normals is None else np.ascontiguousarray(self.normals.T)
        if normals is not None and self.stretches is not None:
            normals = normals / self.stretches
        return np.ascontiguousarray(self.lPs.T), np.ascontiguousarray(self.pixels.T), normals

    @cached_property
    def centred(self) -> FloatArray:
        """(2, n) pixels from the principal point [px]."""
        return np.asarray(self.columns[1] - np.array([[self.camera.cx], [self.camera.cy]]))

    @cached_property
    def slopes(self) -> FloatArray:
        """(2, k, n or 1) derivatives of the k residuals of a match by X/Z and Y/Z of its point [px]."""
        focal, normals = np.array([self.camera.fx, self.camera.fy]), self.columns[2]
        return np.diag(focal)[:, :, None] if normals is None else (focal[:, None] * normals)[:, None, :]

    @cached_property
    def row_scales(self) -> FloatArray:
        """(n,) factor on the rows of a match: sqrt(weight) / sigma [1/px]."""
        return np.asarray(np.sqrt(self.weights) / self.sigmas_px)

    @cached_property
    def velocity_columns(self) -> FloatArray | None:
        """l_velocities (3, n), contiguous by row, for the hot path."""
        return None if self.l_velocities is None else np.ascontiguousarray(self.l_velocities.T)

    @cached_property
    def common_tau_s(self) -> float | None:
        """The base tau of all points where they share one [s], else None."""
        taus = self.base_taus_s
        return float(taus[0]) if len(taus) and bool((taus == taus[0]).all()) else None

    def taus_s(self, time_offset_s: float) -> FloatArray | float:
        """Intervals at a time offset: one float where all points share one, else (n,) [s]."""
        if self.common_tau_s is not None:
            return time_offset_s + self.common_tau_s
        return np.asarray(time_offset_s + self.base_taus_s)


_OF_EACH_MATCH = (
    "lPs",
    "base_taus_s",
    "pixels",
    "sigmas_px",
    "normals",
    "weights",
    "l_velocities",
    "stretches",
)
"""The arrays that have a row for each match."""


def _taken(rows: FloatArray, index: slice | NDArray[np.intp]) -> FloatArray:
    """A read-only copy of some rows of (n, ...): a part of an array would keep all of it."""
    if isinstance(index, np.ndarray) and index.dtype.kind == "i":
        taken = rows.take(index, axis=0)  # many times faster than by an index
    else:
        taken = np.array(rows[index])
    taken.flags.writeable = False
    return taken


def joined(alignments: Sequence[Alignment], c_acceleration: FloatArray | None = None) -> Alignment:
    """Matches of some images of one camera as one alignment, each with the acceleration (6,) of its image, or
    all with the one given."""
    counts = [len(each) for each in alignments]
    if c_acceleration is None:
        c_acceleration = np.repeat([each.c_acceleration for each in alignments], counts, axis=0)
    rows: dict[str, Any] = {"c_acceleration": c_acceleration}
    for name in _OF_EACH_MATCH:
        own = [getattr(each, name) for each in alignments]
        if any(each is not None for each in own):
            # Objects without a velocity stand, and images that were not rectified are not stretched.
            usual = np.zeros(3) if name == "l_velocities" else np.ones(())
            parts = zip(own, counts, strict=True)
            rows[name] = np.concatenate(
                [np.full((n, *usual.shape), usual) if each is None else each for each, n in parts]
            )
    return replace(alignments[0], **rows)


def joined_points(alignments: Sequence[Alignment]) -> Sequence[Alignment]:
    """Point-to-pixel matches of one image as one alignment, where they differ in nothing but their matches:
    with the few thousand of a frame, the calls for a second one would cost as much as its work."""
    first = alignments[0]
    alike = all(
        (each.camera, each.kernel, each.motion_model) == (first.camera, first.kernel, first.motion_model)
        and np.array_equal(each.c_acceleration, first.c_acceleration)
        and each.normals is None
        and each.l_velocities is None
        for each in alignments
    )
    if len(alignments) == 1 or not alike:
        return alignments
    return [joined(alignments, first.c_acceleration)]
