"""A street whose points are labelled by the masks, as some pose projects them."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from stored import simulated

from sst_graph.data.kept_drive import KeptDrive
from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Frame, SemanticClass


def street(frames: int, label_noise: float) -> KeptDrive:
    """With labels that were made apart."""
    config = SimulationConfig(
        seed=741,
        frames=frames,
        width=621,
        height=188,
        azimuth_step_deg=0.3,
        azimuth_limit_deg=60.0,
        vehicle_density=0.2,
        motion="no_stop",
        time_offset_s=0.0,
        label_noise=label_noise,
    )
    return KeptDrive.of(simulated(config), sweep="auto")


def labelled_by_mask(
    frame: Frame, camera: PinholeCamera, cTl: gtsam.Pose3, round_down: bool = False
) -> Frame:
    """The frame with each point's class read from the mask at its pixel."""
    assert frame.scan is not None and frame.image is not None
    cPs = frame.scan.points @ cTl.rotation().matrix().T + cTl.translation()
    uvs = cPs[:, :2] / cPs[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    u, v = np.floor(uvs + (0.0 if round_down else 0.5)).astype(np.intp).T
    seen = (cPs[:, 2] > 0.5) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    classes = np.full(len(u), SemanticClass.IGNORE, np.uint8)
    classes[seen] = frame.image.mask[v[seen], u[seen]]
    return replace(frame, scan=replace(frame.scan, classes=classes, instances=None))
