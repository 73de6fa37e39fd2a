"""The focal length is the one given."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _effect(view: View) -> Effect:
    """u - cx and v - cy grow by the same share."""
    camera = view.camera
    return Effect(pixel_shift=view.uvs - np.array([camera.cx, camera.cy]))


FOCAL = Assumption(
    name="focal",
    unit="",
    effect=_effect,
    sigma=5e-4,
    source="spread of repeated target calibrations: 0.3 px of 700 px",
    span=0.05,
    violation="the focal length does not fit the pictures (share by which it is too short)",
    remedy="check that the camera matrix belongs to this camera, lens setting and image size",
    by_edges=True,
)
