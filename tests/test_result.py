"""CalibrationResult and calibration.json."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import (
    WALL_CLOCK,
    CalibrationResult,
    DriveOffset,
    FrameId,
    WeakDirection,
    read_result,
)
from sst_graph.rig.result import RigResult
from sst_graph.types import Frame, GroundTruth, Scan, SemanticClass

POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.2, 1.0), [0.1, -0.2, 0.3])


def _result(**changes: Any) -> CalibrationResult:
    values: dict[str, Any] = {
        "T_camera_lidar": POSE,
        "time_offset_s": 0.1036,
        "covariance": np.diag([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03, 0.004]) ** 2,
        "status": "unobservable",
        "camera": PinholeCamera(721.5, 721.5, 609.6, 172.9, 1242, 375),
        "camera_name": "image_2",
        "reasons": ("Only one speed.",),
        "weak_directions": (WeakDirection(np.eye(7)[6], 1e6, "The delay is unknown.", "Record a stop."),),
        "frames_used": (FrameId("a/00", 3), FrameId("a/00", 4)),
        "drive_offsets": (DriveOffset("a/00", 0.1036, 0.004),),
        "method": "joint",
        "config": {"method": "joint", "inner": {"sigma_px": 1.5}},
        "initial": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.41, -0.2, 1.0), [0.1, -0.2, 0.3]),
        "initial_time_offset_s": 0.05,
        "diagnostics": {"iterations": 12},
        "versions": {"gtsam": "4.3.0"},
    }
    return CalibrationResult(**{**values, **changes})


def _document(**changes: Any) -> dict[str, Any]:
    return {**json.loads(_result().to_json()), **changes}


def test_the_file_follows_the_contract() -> None:
    document = _document()
    assert (document["format"], document["version"]) == ("sst-graph/calibration", 1)
    assert np.array(document["T_camera_lidar"]) == pytest.approx(POSE.matrix(), abs=0.0)
    assert document["time_offset_s"] == 0.1036
    assert np.array(document["covariance"]).shape == (7, 7)
    assert document["status"] == "unobservable"
    assert document["weak_directions"][0]["sentence"] == "The delay is unknown."
    assert document["camera"]["name"] == "image_2" and document["camera"]["width"] == 1242
    assert document["frames_used"] == [{"drive": "a/00", "frame": 3}, {"drive": "a/00", "frame": 4}]
    assert document["config"]["inner"] == {"sigma_px": 1.5}


def test_round_trip_is_exact() -> None:
    text = _result().to_json()
    assert CalibrationResult.from_json(text).to_json() == text


def test_round_trip_without_a_start() -> None:
    back = CalibrationResult.from_json(_result(initial=None).to_json())
    assert back.initial is None and back.initial_time_offset_s == 0.0


def test_sigmas_in_human_units() -> None:
    sigmas = _result().sigmas()
    assert sigmas.rotation_deg == pytest.approx(np.degrees([1e-3, 2e-3, 3e-3]))
    assert sigmas.translation_cm == pytest.approx([1.0, 2.0, 3.0])
    assert sigmas.time_offset_ms == pytest.approx(4.0)


def test_diagnostics_become_plain_and_strict() -> None:
    result = _result(
        diagnostics={
            "nan": float("nan"),
            "array": np.array([1.0, np.inf]),
            "path": Path("a"),
            "class": SemanticClass.POLE,
            3: np.float32(0.5),
        }
    )
    text = result.to_json()
    assert "NaN" not in text and "Infinity" not in text
    expected = {"nan": None, "array": [1.0, None], "path": "a", "class": "pole", "3": 0.5}
    assert json.loads(text)["diagnostics"] == expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_offset_s": float("nan")}, "time_offset_s: found a value that is not finite"),
        ({"covariance": np.full((7, 7), np.inf)}, "covariance: found a value that is not finite"),
        ({"covariance": np.eye(6)}, r"covariance: found shape \(6, 6\), expected shape \(7, 7\)"),
        ({"covariance": -np.eye(7)}, "covariance: found a variance of -1"),
        ({"covariance": np.triu(np.ones((7, 7)))}, "covariance: found a matrix that is not symmetric"),
        ({"status": "fine"}, "status: found 'fine', expected one of ok, unobservable, not_converged"),
        (
            {"weak_directions": (WeakDirection(np.eye(7)[0], np.inf, "", ""),)},
            "weak_directions.sigma: found a value that is not finite",
        ),
    ],
)
def test_refuses_numbers_that_cannot_be_trusted(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        _result(**changes)


def test_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        _result().status = "ok"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "kalibr"}, "found format 'kalibr', expected format 'sst-graph/calibration'"),
        ({"version": 2}, "found version 2, expected version 1"),
        ({"T_camera_lidar": [[1, 2], [3, 4]]}, r"T_camera_lidar: found shape \(2, 2\)"),
        ({"T_camera_lidar": "eye"}, "T_camera_lidar: found no numeric array"),
        ({"T_camera_lidar": (2 * np.eye(4)).tolist()}, "T_camera_lidar: found last row"),
        ({"T_camera_lidar": np.diag([1, 1, 2, 1]).tolist()}, "expected a rotation matrix"),
        ({"T_camera_lidar": np.diag([1, 1, -1, 1]).tolist()}, "det -1, expected a rotation matrix"),
        ({"time_offset_s": None}, "time_offset_s: found None, expected a number"),
        ({"time_offset_s": True}, "time_offset_s: found True, expected a number"),
        ({"covariance": np.eye(6).tolist()}, r"covariance: found shape \(6, 6\)"),
        ({"status": "fine"}, "status: found 'fine'"),
        ({"camera": {"name": "image_2"}}, "camera: found no entry 'fx'"),
        ({"frames_used": [3]}, "frames_used: found 3, expected objects"),
        ({"frames_used": [{"drive": "a", "frame": 1.5}]}, r"frames_used\[0\]: frame: found 1.5"),
        ({"weak_directions": "none"}, "weak_directions: found 'none', expected a list"),
    ],
)
def test_malformed_file(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(_document(**changes)))
    with pytest.raises(DataError, match=message) as caught:
        read_result(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def _covariance(i: int, j: int, value: float) -> list[list[float]]:
    P = np.diag([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03, 0.004]) ** 2
    P[i, j] = P[j, i] = value
    return [[float(entry) for entry in row] for row in P]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariance": np.zeros((7, 7)).tolist()}, "covariance: found a sigma of 0, expected sigmas"),
        ({"covariance": _covariance(0, 0, 5e-324)}, "covariance: found a sigma of"),
        ({"covariance": _covariance(0, 0, 1e308)}, "covariance: found a sigma of 1e\\+154"),
        ({"covariance": _covariance(0, 1, 1e308)}, "covariance: found a covariance far above|correlation of"),
        ({"covariance": _covariance(0, 1, 3e-6)}, "covariance: found a correlation of 1.5"),
        ({"covariance": (np.eye(7) - 0.5 + 0.5 * np.eye(7)).tolist()}, "expected a covariance .positive"),
        ({"covariance": [["0"] * 7] * 7}, "covariance: found no numeric array"),
        ({"covariance": [[True] * 7] * 7}, "covariance: found no numeric array"),
        ({"T_camera_lidar": [[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "a translation of"),
        ({"T_camera_lidar": np.diag([1e300, 1, 1, 1]).tolist()}, "an entry of 1e\\+300, expected a rotation"),
        ({"time_offset_s": 1e300}, "time_offset_s: found 1e\\+300 s, expected a time offset of at most"),
        ({"camera": {**_document()["camera"], "fx": 1e9}}, "fx = 1e\\+09 px, expected a focal length"),
        ({"camera": {**_document()["camera"], "width": 0}}, "an image of 0x375 px"),
        ({"camera": {**_document()["camera"], "width": 10**12}}, "an image of 1000000000000x375 px"),
        ({"camera": {**_document()["camera"], "name": "a\nrostopic: /evil"}}, "without control characters"),
        ({"camera": {**_document()["camera"], "name": "\x1b[31m"}}, "without control characters"),
        ({"method": "\u202etniol"}, "method: found .*without control characters"),
        ({"versions": {"a": 1}}, "versions: a: found 1, expected text"),
        ({"frames_used": [{"drive": "a\x1b", "frame": 1}]}, "without control characters"),
    ],
)
def test_values_that_no_calibration_has(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        CalibrationResult.from_json(json.dumps(_document(**changes)))
    assert str(caught.value).isprintable()


def test_sentences_of_others_come_on_one_line() -> None:
    back = CalibrationResult.from_json(json.dumps(_document(reasons=["no motion\nat all\x1b[2J"])))
    assert back.reasons == (r"no motion at all\x1b[2J",)


def test_a_key_given_twice_is_refused() -> None:
    text = _result().to_json().replace('"method": "joint"', '"method": "joint", "method": "paper"', 1)
    with pytest.raises(DataError, match="the key 'method' twice"):
        CalibrationResult.from_json(text)


@pytest.mark.parametrize("key", ["T_camera_lidar", "time_offset_s", "covariance", "status", "camera"])
def test_missing_key(key: str) -> None:
    document = _document()
    del document[key]
    with pytest.raises(DataError, match=f"no entry '{key}'"):
        CalibrationResult.from_json(json.dumps(document))


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe\x00", b'{"format": NaN}'])
def test_no_json(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "calibration.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"calibration\.json: found"):
        read_result(path)


def test_a_folder_stands_for_its_file(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text(_result().to_json())
    assert read_result(tmp_path) == read_result(str(tmp_path / "calibration.json")) == _result()


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_result(tmp_path / "calibration.json")


def test_a_rounded_rotation_is_made_orthonormal() -> None:
    document = _document(T_camera_lidar=np.round(POSE.matrix(), 5).tolist())
    R = CalibrationResult.from_json(json.dumps(document)).T_camera_lidar.rotation().matrix()
    assert pytest.approx(np.eye(3), abs=1e-12) == R @ R.T


def test_equal_results_are_equal() -> None:
    first, second = _result(), _result()
    assert first == second and hash(first) == hash(second) and len({first, second}) == 1
    assert first == CalibrationResult.from_json(first.to_json())
    assert first != _result(time_offset_s=0.1037) and first != "a result"
    assert first.weak_directions == second.weak_directions and len({*first.weak_directions}) == 1
    slower = _result(diagnostics={"iterations": 12, WALL_CLOCK: {"estimate": 3.0}})
    assert slower == first and slower != _result(diagnostics={"iterations": 13})


def test_what_frames_and_truths_hold_is_compared() -> None:
    def scan(x: float) -> Scan:
        return Scan(1, np.full((2, 3), x, np.float32), np.zeros(2, np.uint8))

    assert scan(1.0) == scan(1.0) != scan(2.0) and hash(scan(1.0)) == hash(scan(1.0))
    assert Frame(0, scan(np.nan), None) == Frame(0, scan(np.nan), None)
    assert GroundTruth(POSE, 0.1) == GroundTruth(gtsam.Pose3(POSE.matrix()), 0.1) != GroundTruth(POSE, None)


def test_wall_clock_times_are_not_written() -> None:
    result = _result(diagnostics={"iterations": 12, WALL_CLOCK: {"estimate": 3.0}})
    assert result.to_json() == _result().to_json()


def test_how_the_drives_were_read_is_kept() -> None:
    read_as = {"image_shift": 1, "frames": None, "camera": "image_2"}
    assert CalibrationResult.from_json(_result(read_as=read_as).to_json()).read_as == read_as
    document = _document()
    del document["read_as"]
    assert CalibrationResult.from_json(json.dumps(document)).read_as == {}


def test_names_that_are_not_unicode_make_a_valid_file(tmp_path: Path) -> None:
    result = _result(frames_used=(FrameId("stra\udcdfe", 3),), reasons=("ä \ud800",))
    path = tmp_path / "calibration.json"
    path.write_bytes(result.to_json().encode("utf-8"))
    assert read_result(path).frames_used == (FrameId("stra\\udcdfe", 3),) and "ä" in path.read_text()


def test_a_result_does_not_change_with_the_array_it_was_made_of() -> None:
    covariance = 1e-6 * np.eye(7)
    result = CalibrationResult(
        gtsam.Pose3(), 0.1, covariance, "ok", PinholeCamera(50.0, 50.0, 50.0, 50.0, 99, 99)
    )
    text = result.to_json()
    covariance[0, 0] = 1.0
    assert result.to_json() == text
    with pytest.raises(ValueError, match="read-only"):
        result.covariance[0, 0] = 1.0
    rig = RigResult({"a": result}, covariance, "ok")
    covariance[0, 0] = 2.0
    assert rig.covariance[0, 0] == 1.0
