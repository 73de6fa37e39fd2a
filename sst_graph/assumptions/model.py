"""What a calibration assumes, as parameters: an assumption is that its parameter is zero.

A nuisance parameter theta acts on a match in at most four ways: it moves the point (a range that is too
long), changes the interval from the point to its image (a sweep that is not compensated), moves the pixel
(lens distortion), or changes the LiDAR's measured motion. Each is linear in theta, so a match's residual
has the closed-form column

    dr/dtheta = r_H_lP . l_shift + r_H_tau time_s + n . pixel_shift + r_H_twist . Ad(cTl) twist_shift

beside the factor's own Jacobian. Signs and frames are those of :mod:`factors`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class Scene:
    """All that the effects of assumptions depend on but the points: of one scan and one image, or of several.

    Attributes:
        camera: the ideal camera.
        l_twist: (6,) the LiDAR's twist at the image's instant [rad/s, m/s], or (k, 6) of several images or
            of each point; zeros where it is not known.
        image_s: stamp of the image minus that of the drive's first image, or (n,) of each point's [s].
        period_s: time between two scans of the LiDAR, also where some of them are used only [s].
    """

    camera: PinholeCamera
    l_twist: FloatArray
    image_s: float | FloatArray
    period_s: float

    @property
    def centre(self) -> FloatArray:
        """(2,) the principal point [px]."""
        return np.array([self.camera.cx, self.camera.cy])

    def view(self, lPs: FloatArray, offsets_s: FloatArray, uvs: FloatArray) -> View:
        """Points of the scan as the image sees them; arguments as in :class:`View`."""
        return View(self.camera, self.l_twist, self.image_s, self.period_s, lPs, offsets_s, uvs)


@dataclass(frozen=True)
class View(Scene):
    """Points of one scan as one image sees them, or of several of one drive.

    Attributes:
        lPs: (n, 3) points in the LiDAR frame [m].
        offsets_s: (n,) time of each point relative to its scan's stamp [s].
        uvs: (n, 2) their pixels by the ideal camera; NaN behind it [px].
    """

    lPs: FloatArray
    offsets_s: FloatArray
    uvs: FloatArray

    @property
    def rays(self) -> FloatArray:
        """(n, 2) x = X/Z and y = Y/Z of the points in the ideal camera."""
        return np.asarray((self.uvs - self.centre) / np.array([self.camera.fx, self.camera.fy]))


@dataclass(frozen=True)
class Effect:
    """What one unit of a parameter does to the points of a view; None where it does nothing.

    Attributes:
        l_shift: (n, 3) moves the points, in the LiDAR frame [m].
        time_s: (n,) is added to the interval tau from the point to its image [s].
        pixel_shift: (n, 2) moves their pixels [px].
        twist_shift: (6,) or (k, 6) is added to the LiDAR's measured twists [rad/s, m/s].
    """

    l_shift: FloatArray | None = None
    time_s: FloatArray | None = None
    pixel_shift: FloatArray | None = None
    twist_shift: FloatArray | None = None


@dataclass(frozen=True)
class Assumption:
    """One parameter that is held at zero.

    Attributes:
        name: in settings and results.
        unit: of the parameter; empty where it has none.
        effect: what one unit of it does.
        sigma: deviation that a careful set-up leaves: considered in the covariance.
        source: where ``sigma`` comes from.
        span: deviation when nothing is known of it: the prior of a test, or where it is estimated.
        prevalence: probability beforehand that a set-up breaks the assumption; a judgement: about one camera
            matrix in fifty belongs to another lens, crop or image size.
        violation: what it means that the data contradict it; begins the sentence that reports it.
        remedy: what to do about it.
        by_matches: whether the matches can test it. They cannot test the sweep: at constant speed it looks
            like a shift.
        by_edges: whether edges test it, which estimate all such parameters together
            (:mod:`sst_graph.batch.by_edges.lens`).
        of_lidar: whether it is about the LiDAR: all cameras on it then have its error in common.
        motion_step: (7,) step of the calibration by motion alone by one unit of the parameter [rad, m, s], at
            an extrinsic: motion takes the parameter for zero. None where it hardly follows it.
        misleads_motion: whether it does follow it, by a step that is not known beforehand.
    """

    name: str
    unit: str
    effect: Callable[[View], Effect]
    sigma: float
    source: str
    span: float
    violation: str
    remedy: str
    prevalence: float = 0.02
    by_matches: bool = True
    by_edges: bool = False
    of_lidar: bool = False
    motion_step: Callable[[PinholeCamera, gtsam.Pose3], FloatArray] | None = None
    misleads_motion: bool = False

    def contradicted_by(self, value: float, sigma: float, threshold: float) -> bool:
        """Whether an estimate with its deviation is so many deviations from zero.

        Never where the span itself would not be: no value that may be is told from zero then, and one that
        seems to be is the sign of another error.
        """
        return abs(value) > threshold * sigma and threshold * sigma < self.span

    def figure(self, value: float, sigma: float) -> str:
        """The parameter's estimate with deviation and unit, as text."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} = {value:.3g} ± {sigma:.2g}{unit}"


def combined(effects: Sequence[tuple[float, Effect]]) -> Effect:
    """The sum of effects, each multiplied by its parameter: (value, effect)."""

    def total(name: str) -> FloatArray | None:
        parts = [theta * part for theta, effect in effects if (part := getattr(effect, name)) is not None]
        return np.asarray(sum(parts[1:], parts[0])) if parts else None

    return Effect(total("l_shift"), total("time_s"), total("pixel_shift"), total("twist_shift"))
