"""How well two sets of labels agree under a pose: a check that no estimator minimises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """Counts of points on known pixels, summed over frames and classes.

    Attributes:
        hits, members: points of a class on a pixel of it, and on any.
        intruders, others: points of no such class on a pixel of it, and on any.
    """

    hits: int = 0
    members: int = 0
    intruders: int = 0
    others: int = 0

    def __add__(self, other: Agreement) -> Agreement:
        return Agreement(
            self.hits + other.hits,
            self.members + other.members,
            self.intruders + other.intruders,
            self.others + other.others,
        )

    @property
    def score(self) -> float:
        """P(pixel of the class | point of it) - P(pixel of the class | other point): 1 perfect, 0 chance."""
        if self.members == 0 or self.others == 0:
            return 0.0
        return self.hits / self.members - self.intruders / self.others


def label_agreement(
    uvs: FloatArray,
    point_classes: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    classes: Sequence[SemanticClass],
) -> Agreement:
    """Agreement of points that project to uvs (n, 2) [px] with a mask (h, w).

    Points off the image (NaN: behind the camera) and points on pixels to be ignored do not count; whether
    a pose gains by looking away shows in ``members``.
    """
    h, w = mask.shape
    with np.errstate(invalid="ignore"):
        inside = (uvs[:, 0] >= -0.5) & (uvs[:, 0] < w - 0.5) & (uvs[:, 1] >= -0.5) & (uvs[:, 1] < h - 0.5)
    cells = np.where(inside[:, None], uvs + 0.5, 0.0).astype(np.intp)
    seen = np.where(inside, mask[cells[:, 1], cells[:, 0]], SemanticClass.OTHER)
    known = inside & (seen != SemanticClass.IGNORE)
    total = Agreement()
    for c in classes:
        member, on_class = known & (point_classes == c), seen == c
        other = known & (point_classes != c)
        total += Agreement(
            int(np.count_nonzero(member & on_class)),
            int(np.count_nonzero(member)),
            int(np.count_nonzero(other & on_class)),
            int(np.count_nonzero(other)),
        )
    return total
