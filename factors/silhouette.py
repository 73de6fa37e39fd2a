"""Silhouette factor: boundary points of objects against the contours of their masks."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from .alignment import frame_factor
from .errors import FactorError
from .matches import Alignment

FloatArray = NDArray[np.float64]


def silhouette_factor(
    alignment: Alignment,
    cTl: int | gtsam.Pose3,
    offset_s: int | float = 0.0,
    c_twist: int | FloatArray | None = None,
    bias_px: int | float | None = None,
    *,
    condensed: bool = True,
) -> gtsam.CustomFactor:
    """r_i = n_i . (uv(cP_i) - q_i) + bias: signed distance to the true outline [px].

    q_i is the contour's point nearest to the predicted pixel and n_i its outward unit normal; frozen,
    they are the contour's tangent line. ``bias_px`` is how far a class's masks reach outside the true
    outline (dilation positive): the outline lies that far inside the contour. The arguments are those of
    :func:`sst_graph.factors.frame_factor`.

    Raises:
        FactorError: the alignment has no normals.
    """
    if alignment.normals is None:
        raise FactorError("alignment of a silhouette", "no normals", "unit normals (n, 2)")
    return frame_factor([alignment], cTl, offset_s, c_twist, bias_px, condensed=condensed)
