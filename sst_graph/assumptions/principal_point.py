"""The principal point is the one given."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _right(view: View) -> Effect:
    return Effect(pixel_shift=np.broadcast_to(np.array([1.0, 0.0]), view.uvs.shape))


def _down(view: View) -> Effect:
    return Effect(pixel_shift=np.broadcast_to(np.array([0.0, 1.0]), view.uvs.shape))


_SOURCE = "spread of repeated target calibrations: 0.2 to 0.5 px"
_PREVALENCE = 0.1
"""A judgement: pictures are cropped, and matrices taken from another day or camera, about that often."""
_REMEDY = "check that the camera matrix belongs to this image size and crop"

CX = Assumption(
    name="cx",
    unit="px",
    effect=_right,
    sigma=0.3,
    source=_SOURCE,
    span=30.0,
    violation="the pictures lie beside the principal point cx",
    remedy=_REMEDY,
    prevalence=_PREVALENCE,
    by_edges=True,
)
CY = Assumption(
    name="cy",
    unit="px",
    effect=_down,
    sigma=0.3,
    source=_SOURCE,
    span=30.0,
    violation="the pictures lie beside the principal point cy",
    remedy=_REMEDY,
    prevalence=_PREVALENCE,
    by_edges=True,
)
