"""What docs/reference/marginal.md says of marginals of drives that disagree, on one pair."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "studies" / "marginal_disagreement.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("marginal_disagreement", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_marginals_miss_by_more_the_more_drives_disagree(script: ModuleType) -> None:
    near, far = script.pair(0, 0.0), script.pair(0, 8.0)
    assert near[0] < 4.0 < 7.0 < far[0]
    assert near[1][0] < 0.15 < 0.3 < far[1][0]


@pytest.mark.parametrize("apart", [0.0, 8.0])
def test_rounds_converge_to_the_joint_estimate(script: ModuleType, apart: float) -> None:
    _, misses = script.pair(1, apart)
    assert misses == sorted(misses, reverse=True)
    assert misses[-1] < 0.005
