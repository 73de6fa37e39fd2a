"""Values between the pixels of a field or a picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_REMAP_LIMIT = 30_000
"""OpenCV takes fewer than 32,768 columns."""
SAMPLED_ROWS = 32_767
"""A field has fewer rows, and columns, than this: OpenCV's limit."""


def sampled(
    field: NDArray[np.float32] | NDArray[np.uint8],
    u: NDArray[np.floating[Any]] | NDArray[np.intp],
    v: NDArray[np.floating[Any]] | NDArray[np.intp],
) -> NDArray[Any]:
    """Bilinear values of a field (h, w) or (h, w, k) at columns u and rows v (a, b): (a, b) or (a, b, k).

    The border is extended.
    """
    columns, rows = np.ascontiguousarray(u, np.float32), np.ascontiguousarray(v, np.float32)
    parts = []
    for start in range(0, u.shape[1], _REMAP_LIMIT):
        some = slice(start, start + _REMAP_LIMIT)
        parts.append(
            cv2.remap(
                field, columns[:, some], rows[:, some], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        )
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
