"""Cameras whose pictures are not rectified."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sst_graph.errors import DataError

_NOTHING = 1e-12
"""Coefficients up to this size bend no ray by a hundredth of a pixel."""


def require_rectified(model: str, coefficients: Sequence[float], place: str | Path) -> None:
    """Require pictures without lens distortion.

    Args:
        model: name of the distortion model, as in the file.
        coefficients: of the model; all zero, or none, for rectified pictures.
        place: named in errors.

    Raises:
        DataError: a coefficient is not zero.
    """
    if any(abs(value) > _NOTHING for value in coefficients):
        found = f"{model} distortion {[float(f'{value:.6g}') for value in coefficients]}"
        raise DataError(place, found, "rectified pictures (all coefficients 0)")
