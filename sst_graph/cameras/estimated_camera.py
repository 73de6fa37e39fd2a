"""The camera that a pose belongs to: that of the data, with what ``--estimate`` found of its lens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sst_graph.factors import FactorError, PinholeCamera
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

_PARAMETERS = ("focal", "cx", "cy", "k1", "k2")
_IN_VIEW = 1.5
"""Points farther from the axis than this many times the image's corners are not distorted further: out there
a polynomial turns round, and would lay points from beside the image into it."""


def squared_radius(camera: PinholeCamera, rays: FloatArray) -> FloatArray:
    """(n, 1) x^2 + y^2 of rays (n, 2) as distortion takes it: no larger than a little beside the image."""
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    corner = np.maximum(centre, np.array([camera.width, camera.height]) - 1.0 - centre) / focal
    return np.asarray(np.minimum((rays**2).sum(axis=1, keepdims=True), _IN_VIEW**2 * (corner**2).sum()))


@dataclass(frozen=True)
class EstimatedCamera(PinholeCamera):
    """A pinhole with radial distortion: uv = c + f (x, y) (1 + k1 r^2 + k2 r^4), r^2 = x^2 + y^2, as OpenCV.

    Attributes:
        k1, k2: its distortion.
        estimated: names of the parameters that were estimated with the pose.
    """

    k1: float = 0.0
    k2: float = 0.0
    estimated: tuple[str, ...] = ()

    @classmethod
    def of(cls, result: CalibrationResult) -> EstimatedCamera:
        """The camera of a result, with the parameters of its assumptions in the terms of OpenCV."""
        given, values = result.camera, estimated_values(result, _PARAMETERS)
        size, larger = (given.width, given.height), 1.0 + values.get("focal", 0.0)
        cx, cy = given.cx + values.get("cx", 0.0), given.cy + values.get("cy", 0.0)
        try:
            # Distortion and focal length both act on f: (f larger) (1 + k / larger) = f (larger + k).
            k1, k2 = (values.get(name, 0.0) / (larger or 1.0) for name in ("k1", "k2"))
            return cls(given.fx * larger, given.fy * larger, cx, cy, *size, k1, k2, tuple(values))
        except FactorError:  # A file may hold what no estimate is.
            return cls(given.fx, given.fy, given.cx, given.cy, *size)

    def project(self, cPs: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points cPs (n, 3) [m]; NaN behind the camera."""
        uvs = super().project(cPs)
        if not self.distorts:
            return uvs
        centre = np.array([self.cx, self.cy])
        square = squared_radius(self, (uvs - centre) / np.array([self.fx, self.fy]))
        return np.asarray(uvs + (uvs - centre) * (self.k1 * square + self.k2 * square**2))

    @property
    def distorts(self) -> bool:
        """Whether it is more than a pinhole."""
        return bool(self.k1 or self.k2)

    @property
    def sentences(self) -> list[str]:
        """What a file says of a lens that was estimated with the pose; nothing of one that was given."""
        if not self.estimated:
            return []
        return [
            f"the pose belongs to the lens estimated with it ({', '.join(self.estimated)}): "
            f"fx {self.fx:.6g}, fy {self.fy:.6g}, cx {self.cx:.6g}, cy {self.cy:.6g} px, "
            f"k1 {self.k1:.6g}, k2 {self.k2:.6g}"
        ]


def estimated_values(result: CalibrationResult, names: Iterable[str]) -> dict[str, float]:
    """Values of those of the parameters that were estimated with the pose; a file may hold anything."""
    found, values = result.diagnostics.get("estimated"), {}
    for name in names:
        entry = found.get(name) if isinstance(found, Mapping) else None
        value = entry.get("value") if isinstance(entry, Mapping) else None
        if isinstance(value, float) and np.isfinite(value):
            values[name] = value
    return values
