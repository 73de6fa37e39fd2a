"""The code in the documentation runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from factors import FactorError, check_jacobians

DOCS = Path(__file__).resolve().parent.parent / "docs"


def code_of(name: str) -> str:
    """The Python blocks of a page."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    return "\n".join(blocks)


def test_a_factor_of_your_own() -> None:
    found: dict[str, Any] = {}
    exec(compile(code_of("extending.md"), "extending.md", "exec"), found)
    assert found["report"].ok and found["report"].error < 1e-6
    E, values, factor = found["E"], found["values"], found["factor"]
    # by hand: 8 m ahead, 1 m left, 0.5 m down, seen by an unturned camera
    by_hand = gtsam.Values()
    by_hand.insert(E, gtsam.Pose3(found["forward"], np.zeros(3)))
    expected = [600.0 - 700.0 / 8.0 - 520.0, 180.0 + 350.0 / 8.0 - 240.0]
    np.testing.assert_allclose(factor.unwhitenedError(by_hand), expected)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.PriorFactorPose3(E, values.atPose3(E), noise))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert np.abs(factor.unwhitenedError(solved)).max() < 0.5 < np.abs(factor.unwhitenedError(values)).max()


def test_the_checker_finds_the_mistake_that_the_page_warns_of() -> None:
    wrong = code_of("extending.md").replace("-gtsam.Rot3.Hat(lP)", "gtsam.Rot3.Hat(lP)")
    with pytest.raises(FactorError, match="by E0"):
        exec(compile(wrong, "extending.md", "exec"), {"check_jacobians": check_jacobians})


def test_links_between_pages_lead_somewhere() -> None:
    for page in DOCS.glob("*.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
