"""Results, rigs, exports, trackers, settings and batches refuse what is no argument of theirs.

Each is called once with arguments that fit, then with each of them replaced by each of the wrong objects;
what fits after all is listed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from calibrations import turned
from rigs import CAMERA, marginal_of
from rigs import result_of as rig_of
from wrong_objects import POSE, check_refusals

from sst_graph import Calibration, CalibrationConfig, KnownPose, KnownRig, RigResult, ScanMotion, Tracker
from sst_graph import Trajectory as Poses
from sst_graph.config import from_dict, to_dict, with_overrides
from sst_graph.errors import DataError, SstGraphError
from sst_graph.export import CalibrationMarginal, ExportOptions, common_errors, export_text
from sst_graph.factors import FactorError
from sst_graph.files.reading import path_of
from sst_graph.fleet import (
    BatchConfig,
    ListedDrive,
    Place,
    find_drives,
    run_batch,
    vehicles_of,
    with_vehicles,
)
from sst_graph.fleet.batch import write_summary
from sst_graph.fleet.vehicles.walk import WalkConfig
from sst_graph.rig.known import poses_by_nominal
from sst_graph.rig.marginal import RigMarginal
from sst_graph.types import GroundTruth, Guess

RIG, RIG_MARGINAL, CALIBRATION = rig_of(marginal_of(2)), marginal_of(2), Calibration(POSE, 0.1)
MARGINAL = CalibrationMarginal(POSE, 0.1, np.eye(7), np.zeros(7))
DRIVE = ListedDrive("one", Place("/nowhere/one"), "van", "2026-11-01")
POSES = Poses([1, 2], [0, 100])
TRACKER = Tracker(CAMERA)
NUMBER = {"int", "negative", "float"}

RIGHT: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "Calibration.local_coordinates": (CALIBRATION.local_coordinates, {"other": CALIBRATION}),
    "Calibration.retract": (CALIBRATION.retract, {"step": np.zeros(7)}),
    "Guess": (Guess, {"cTl": POSE, "time_offset_s": 0.1}),
    "GroundTruth": (GroundTruth, {"cTl": POSE, "time_offset_s": 0.1}),
    "RigResult": (
        RigResult,
        {
            "cameras": RIG.cameras,
            "covariance": RIG.covariance,
            "status": "ok",
            "reasons": (),
            "known": RIG.known,
        }
        | {"diagnostics": {}},
    ),
    "RigResult.__getitem__": (RIG.__getitem__, {"name": "cam0"}),
    "RigResult.relative_pose": (RIG.relative_pose, {"camera": "cam0", "reference": "cam1"}),
    "RigMarginal": (
        RigMarginal,
        {"names": ("a",), "extrinsics": (POSE,), "time_offsets_s": (0.1,), "covariance": np.eye(7)},
    ),
    "RigMarginal.of_camera": (RIG_MARGINAL.of_camera, {"name": "cam0"}),
    "KnownRig.check": (KnownRig((KnownPose("a", "b", POSE),)).check, {"cameras": ["a", "b"]}),
    "poses_by_nominal": (poses_by_nominal, {"nominal": {"a": POSE, "b": POSE}}),
    "CalibrationMarginal.shares_point": (MARGINAL.shares_point, {"other": MARGINAL}),
    "common_errors": (common_errors, {"result": turned(3)}),
    "export_text": (export_text, {"result": turned(3), "target": "urdf", "options": ExportOptions()}),
    "ExportOptions": (
        ExportOptions,
        {"camera_frame": "c", "camera_link": "d", "lidar_frame": "l", "parent": "a", "child": "b"}
        | {"tree": None, "kitti": None},
    ),
    "Tracker": (Tracker, {"camera": CAMERA, "config": None, "initial": POSE, "sweep": None}),
    "Trajectory.at": (POSES.at, {"position": 0}),
    "Trajectory.position": (POSES.position, {"stamp_ns": 0}),
    "Trajectory.interval": (POSES.interval, {"true_ns": 0.0}),
    "Trajectory.outside_s": (POSES.outside_s, {"true_ns": 0.0}),
    "ScanMotion.of_camera": (ScanMotion(np.zeros(6)).of_camera, {"cTl": POSE}),
    "with_overrides": (with_overrides, {"config": CalibrationConfig(), "overrides": ["method=joint"]}),
    "from_dict": (from_dict, {"cls": CalibrationConfig, "data": {}}),
    "to_dict": (to_dict, {"config": CalibrationConfig()}),
    "ListedDrive": (ListedDrive, {"name": "a", "place": Place("/a"), "vehicle": "v", "date": "2026-11-01"}),
    "Place.of": (Place.of, {"text": "/a"}),
    "with_vehicles": (with_vehicles, {"drives": [DRIVE], "given": "(?P<vehicle>one)"}),
    "vehicles_of": (vehicles_of, {"drives": [], "records": {}, "config": WalkConfig()}),
}
FITS: dict[str, set[str]] = {
    "cTl": {"Pose3"},
    "Guess.cTl": {"Pose3", "None"},
    "time_offset_s": NUMBER,
    "GroundTruth.time_offset_s": NUMBER | {"None"},
    "RigResult.reasons": {"texts", "empty"},
    "RigResult.diagnostics": {"dict"},
    "export_text.options": {"None"},
    "sweep": {"None"},
    "Tracker.config": {"None"},
    "Tracker.initial": {"Pose3", "None"},
    "position": set(),
    "stamp_ns": {"int", "negative"},
    "true_ns": NUMBER,
    "overrides": {"empty"},
    "data": {"dict"},
    "name": {"text"},
    "vehicle": {"text"},
    "text": {"text"},
    "vehicles_of.config": {"None"},
    "vehicles_of.drives": {"empty"},
    "records": {"dict"},
    **{name: {"text", "None"} for name in ("camera_frame", "camera_link", "parent", "child")},
    "lidar_frame": {"text"},
    "tree": {"None"},
    "kitti": {"None"},
    "RigResult.__getitem__.name": set(),
    "RigMarginal.of_camera.name": set(),
}
"""By name of the argument, or of function and argument."""


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_no_argument_is_refused_in_one_sentence(name: str) -> None:
    def in_one_sentence(said: str) -> None:
        assert ("\n" not in said and "expected" in said) or "found" in said, said

    check_refusals(name, *RIGHT[name], FITS, in_one_sentence)


@pytest.mark.parametrize("matrix", [2.0 * np.eye(3), 1e200 * np.eye(3), np.eye(3) + 0.01])
def test_a_matrix_that_is_no_rotation(matrix: np.ndarray) -> None:
    """gtsam makes a rotation of any matrix."""
    with pytest.raises(
        FactorError, match=r"cTl of Calibration: found .* in its rotation, expected a rotation"
    ):
        Calibration(gtsam.Pose3(gtsam.Rot3(matrix), np.zeros(3)))


def test_a_rotation_with_the_digits_of_a_file_is_one() -> None:
    R = np.round(POSE.rotation().matrix(), 5)
    assert Calibration(gtsam.Pose3(gtsam.Rot3(R), np.zeros(3))).cTl.rotation().matrix().tolist() == R.tolist()


@pytest.mark.parametrize(("path", "found"), [("x" * 5000, "5000 characters"), ("\ud800", "a lone surrogate")])
def test_paths_that_no_file_system_takes(path: str, found: str) -> None:
    with pytest.raises(DataError, match=found):
        path_of(path, "a file")


def test_what_batches_refuse(tmp_path: Path) -> None:
    out, config = Place.of(tmp_path), BatchConfig()
    assert run_batch([], out, config, lambda _: None) == {}
    for wrong in (None, "drives", [1], 5):
        with pytest.raises(FactorError, match="drives"):
            run_batch(wrong, out, config, lambda _: None)  # type: ignore[arg-type]
        with pytest.raises(FactorError, match="drives"):
            write_summary(wrong, {}, out, config)  # type: ignore[arg-type]
    with pytest.raises(FactorError, match="out: found the text"):
        run_batch([], str(tmp_path), config, lambda _: None)  # type: ignore[arg-type]
    with pytest.raises(FactorError, match="progress: found None"):
        run_batch([], out, config, None)  # type: ignore[arg-type]
    with pytest.raises(SstGraphError, match="drives: found none"):
        write_summary([], {}, out, config)
    with pytest.raises(DataError, match="date of the drive a: found the date 'soon'"):
        ListedDrive("a", out, date="soon")
    (tmp_path / "one").mkdir()
    assert find_drives(tmp_path) == find_drives(str(tmp_path))
    with pytest.raises(FactorError, match="name_parts: found 0"):
        find_drives(tmp_path, 0)


@pytest.mark.parametrize("setup", [1, "setup", {}])
def test_a_checkpoint_is_loaded_with_a_setup(setup: Any, tmp_path: Path) -> None:
    TRACKER.save(tmp_path / "tracker.npz")
    Tracker.load(tmp_path / "tracker.npz", TRACKER.setup)
    with pytest.raises(FactorError, match=r"setup: found .*, expected the setup of a tracker"):
        Tracker.load(tmp_path / "tracker.npz", setup)
