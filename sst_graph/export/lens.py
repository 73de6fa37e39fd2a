"""The lens that an exported pose belongs to: that of the data, with what ``--estimate`` found of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.factors import FactorError, PinholeCamera
from sst_graph.result import CalibrationResult

_PARAMETERS = ("focal", "cx", "cy", "k1", "k2")


@dataclass(frozen=True)
class Lens:
    """A pinhole with radial distortion: uv = c + f (x, y) (1 + k1 r^2 + k2 r^4), r^2 = x^2 + y^2, as OpenCV.

    Attributes:
        camera: its pinhole.
        k1, k2: its distortion.
        estimated: names of the parameters that were estimated with the pose.
    """

    camera: PinholeCamera
    k1: float = 0.0
    k2: float = 0.0
    estimated: tuple[str, ...] = ()

    @classmethod
    def of(cls, result: CalibrationResult) -> Lens:
        """The lens of a result: its assumptions' parameters (:mod:`sst_graph.assumptions.of_camera`) in the
        terms of OpenCV."""
        values = _estimated(result.diagnostics.get("estimated"))
        camera, larger = result.camera, 1.0 + values.get("focal", 0.0)
        try:
            camera = replace(
                camera,
                fx=camera.fx * larger,
                fy=camera.fy * larger,
                cx=camera.cx + values.get("cx", 0.0),
                cy=camera.cy + values.get("cy", 0.0),
            )
        except FactorError:  # A file may hold what no estimate is.
            return cls(result.camera)
        # Both act on f: (f larger) (1 + k) = f (larger + k larger).
        k1, k2 = (values.get(name, 0.0) / larger for name in ("k1", "k2"))
        return cls(camera, k1, k2, tuple(values))

    @property
    def distorts(self) -> bool:
        """Whether it is more than a pinhole."""
        return bool(self.k1 or self.k2)

    @property
    def sentences(self) -> list[str]:
        """What a file says of a lens that was estimated with the pose; nothing of one that was given."""
        if not self.estimated:
            return []
        camera = self.camera
        return [
            f"the pose belongs to the lens estimated with it ({', '.join(self.estimated)}): "
            f"fx {camera.fx:.6g}, fy {camera.fy:.6g}, cx {camera.cx:.6g}, cy {camera.cy:.6g} px, "
            f"k1 {self.k1:.6g}, k2 {self.k2:.6g}"
        ]


def _estimated(found: object) -> dict[str, float]:
    """Values of the lens's parameters among those that were estimated; a file may hold anything."""
    values = {}
    for name in _PARAMETERS:
        entry = found.get(name) if isinstance(found, Mapping) else None
        value = entry.get("value") if isinstance(entry, Mapping) else None
        if isinstance(value, float) and np.isfinite(value):
            values[name] = value
    return values
