"""What is said of a solution that explains the labels badly."""

from __future__ import annotations

import pytest

from sst_graph.graph.outer_loop import poor_fit

BOUNDARY, CLOSE = "of the boundary points in view meet a contour", "of the matches are close ones"


@pytest.mark.parametrize(
    ("explained", "concentration", "observable", "reasons"),
    [
        (0.6, 0.8, True, []),
        (0.3, 0.8, True, []),
        (0.3, 0.8, False, [BOUNDARY]),  # with the rotation open, more must be explained
        (0.5, 0.8, False, []),
        (0.1, 0.8, True, [BOUNDARY]),
        (0.6, 0.5, True, [CLOSE]),
        (0.1, 0.5, False, [BOUNDARY, CLOSE]),
    ],
)
def test_reasons_by_hand(
    explained: float, concentration: float, observable: bool, reasons: list[str]
) -> None:
    found = poor_fit(explained, concentration, observable)
    assert len(found) == len(reasons)
    assert all(reason in sentence for reason, sentence in zip(reasons, found, strict=True))
