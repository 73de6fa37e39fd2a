"""Starts and truths read from files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.reference import load_initial, read_reference
from sst_graph.result import CalibrationResult

POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.2, 1.0), [0.1, -0.2, 0.3])


def _write(path: Path, **values: Any) -> Path:
    document = {"T_camera_lidar": POSE.matrix().tolist(), "time_offset_s": 0.1, **values}
    path.write_text(json.dumps(document))
    return path


def test_kitti_calibration_of_any_camera(kitti_drive: Path) -> None:
    # P2 = K [I | K^-1 (35 0 0)'] shifts by 35 / 700 = 0.05 m, P3 by -0.5 m; Tr stands at y -0.08, z -0.27.
    second, time_offset_s = load_initial(kitti_drive / "calib.txt")
    third, _ = load_initial(kitti_drive / "calib.txt", "image_3")
    assert second.translation() == pytest.approx([0.05, -0.08, -0.27])
    assert third.translation() == pytest.approx([-0.5, -0.08, -0.27])
    assert time_offset_s == 0.0
    assert read_reference(kitti_drive / "calib.txt").time_offset_s is None


def test_groundtruth(tmp_path: Path) -> None:
    truth = read_reference(_write(tmp_path / "groundtruth.json", camera="image_2"))
    assert truth.cTl.equals(POSE, 1e-12) and truth.time_offset_s == 0.1


def test_result_as_a_start(tmp_path: Path) -> None:
    camera = PinholeCamera(700.0, 700.0, 4.0, 3.0, 8, 6)
    result = CalibrationResult(POSE, -0.2, np.eye(7), "ok", camera, "image_3")
    path = tmp_path / "calibration.json"
    path.write_text(result.to_json())
    cTl, time_offset_s = load_initial(path, "image_3")
    assert cTl.equals(POSE, 1e-12) and time_offset_s == -0.2


def test_an_unknown_offset_stays_unknown(tmp_path: Path) -> None:
    path = _write(tmp_path / "groundtruth.json", time_offset_s=None)
    assert read_reference(path).time_offset_s is None
    assert load_initial(path).time_offset_s == 0.0


@pytest.mark.parametrize("camera", ["image_3", {"name": "image_3"}])
def test_another_camera_is_refused(tmp_path: Path, camera: Any) -> None:
    path = _write(tmp_path / "groundtruth.json", camera=camera)
    with pytest.raises(DataError, match="found a calibration of camera image_3, expected one of image_2"):
        read_reference(path, "image_2")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"T_camera_lidar": [[1, 2], [3]]}, "T_camera_lidar: found no numeric array"),
        ({"T_camera_lidar": np.eye(3).tolist()}, r"T_camera_lidar: found shape \(3, 3\)"),
        ({"T_camera_lidar": (2 * np.eye(4)).tolist()}, "T_camera_lidar: found last row"),
        ({"T_camera_lidar": np.diag([1, 2, 1, 1]).tolist()}, "expected a rotation matrix"),
        ({"time_offset_s": "0.1"}, "time_offset_s: found '0.1', expected a number"),
        ({"time_offset_s": float("nan")}, "NaN is no JSON number"),
    ],
)
def test_bad_values(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_reference(_write(tmp_path / "groundtruth.json", **values))


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b"\xff\xfe"])
def test_no_such_json(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "groundtruth.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"groundtruth\.json: found") as caught:
        read_reference(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["calibration.json", "calib.txt"])
def test_no_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=name):
        read_reference(tmp_path / name)
