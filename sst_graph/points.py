"""Points in other frames."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.types import FloatArray


def transformed_points(aTb: gtsam.Pose3, bPs: FloatArray) -> FloatArray:
    """(n, 3) points of frame b in frame a; ``transformFrom`` flattens a batch of one."""
    return np.asarray(bPs @ aTb.rotation().matrix().T + aTb.translation())


def transformed_by(aTb: FloatArray, bPs: FloatArray) -> FloatArray:
    """:func:`transformed_points` by a (4, 4) matrix."""
    return np.asarray(bPs @ aTb[:3, :3].T + aTb[:3, 3])
