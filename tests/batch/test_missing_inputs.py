"""A calibration of a drive that lacks a mask, a picture, labels and some points: done, and said so."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from checks.fuzz import STREET
from sst_graph.cli import main
from sst_graph.simulator import simulate, write_drive


@pytest.mark.slow
def test_a_drive_with_gaps_is_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_drive(simulate(STREET), tmp_path / "street")
    (folder / "semantic_2/000001.png").unlink()
    (folder / "image_2/000002.png").unlink()
    (folder / "labels/000000.label").unlink()
    cloud = np.fromfile(folder / "velodyne/000003.bin", "<f4").reshape(-1, 4)
    cloud[::50, :3] = np.nan
    cloud.tofile(folder / "velodyne/000003.bin")
    out = tmp_path / "out"
    assert main(["calibrate", str(tmp_path / "street"), "--out", str(out)]) == 3
    lines = capsys.readouterr().err.splitlines()
    warnings = [line for line in lines if "left out" in line]
    assert len(warnings) == 1 and "1 image without mask, 1 image without picture" in warnings[0]
    document = json.loads((out / "calibration.json").read_text())
    assert document["diagnostics"]["left_out"] == {
        "street/00": {
            "points": len(cloud[::50]),
            "scans_with_such_points": 1,
            "scans_without_labels": 1,
            "images_without_mask": 1,
            "images_without_picture": 1,
        }
    }
    used = {used["frame"] for used in document["frames_used"]}
    assert used and 0 not in used
    assert list(out.glob("overlay_*.png"))
