"""A drive and its calibration, for the commands that show one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stored import written
from streets import TRACKED_STREET

from sst_graph.data import open_source
from sst_graph.result import CalibrationResult


@pytest.fixture(scope="session")
def street() -> Path:
    """A drive on disk."""
    return written(TRACKED_STREET)


@pytest.fixture(scope="session")
def result(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of the street's true calibration, started from its nominal one."""
    source = open_source(street)
    truth = source.truth
    assert truth is not None and truth.time_offset_s is not None
    path = tmp_path_factory.mktemp("result") / "calibration.json"
    calibration = CalibrationResult(
        truth.cTl, truth.time_offset_s, 1e-6 * np.eye(7), "ok", source.camera, initial=source.nominal
    )
    path.write_text(calibration.to_json())
    return path
