"""rig.json: written, read again, refused."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rigs import marginal_of, result_of

from sst_graph.cli import main
from sst_graph.errors import ConfigError, DataError
from sst_graph.rig import KnownPose, KnownRig, RigResult, read_rig
from sst_graph.rig.result import folder_names


def _written(rig: RigResult, folder: Path) -> Path:
    for name, own in folder_names(rig.cameras).items():
        (folder / own).mkdir(parents=True)
        (folder / own / "calibration.json").write_text(rig[name].to_json())
    (folder / "rig.json").write_text(rig.to_json())
    return folder


@pytest.fixture
def rig() -> RigResult:
    pose = gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([-0.5, 0.0, 0.01]))
    return result_of(marginal_of(3), KnownRig((KnownPose("cam1", "cam0", pose, 0.02, 0.003),), True))


def test_written_and_read_again(rig: RigResult, tmp_path: Path) -> None:
    folder = _written(rig, tmp_path / "rig")
    again = read_rig(folder)
    assert again == rig and hash(again) == hash(rig)
    assert read_rig(folder / "rig.json") == rig
    assert list(again.cameras) == ["cam0", "cam1", "cam2"]
    assert again.known == rig.known
    np.testing.assert_array_equal(again.covariance, rig.covariance)


def test_poses_between_cameras_are_in_the_file(rig: RigResult) -> None:
    poses = json.loads(rig.to_json())["camera_poses"]
    assert [(p["camera"], p["reference"]) for p in poses] == [("cam1", "cam0"), ("cam2", "cam1")]
    expected = rig.relative_pose("cam2", "cam1")
    np.testing.assert_array_equal(poses[1]["T_camera_reference"], expected.T_camera_reference.matrix())
    np.testing.assert_array_equal(poses[1]["covariance"], expected.covariance)


def test_names_of_folders() -> None:
    names = folder_names(("/front/image_raw", "front_image_raw", "../..", "CAM_BACK"))
    assert names == {
        "/front/image_raw": "front_image_raw",
        "front_image_raw": "front_image_raw_2",
        "../..": "camera",
        "CAM_BACK": "CAM_BACK",
    }


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda d: d.update(format="x"), "format 'x'"),
        (lambda d: d.update(version=2), "version 2"),
        (lambda d: d["cameras"].pop(), "shape"),
        (lambda d: d["cameras"].append(dict(d["cameras"][0])), "each of them once"),
        (lambda d: d["covariance"][0].__setitem__(0, 1.0), "another covariance of cam0"),
        (lambda d: d.update(covariance=np.eye(7).tolist()), "shape"),
        (lambda d: d.update(status="fine"), "'fine'"),
        (lambda d: d["known"].update(one_trigger=1), "true or false"),
        (lambda d: d["known"]["poses"][0].update(reference="cam1"), "in itself"),
    ],
)
def test_files_that_are_none(rig: RigResult, tmp_path: Path, change, found: str) -> None:
    folder = _written(rig, tmp_path / "rig")
    document = json.loads((folder / "rig.json").read_text())
    change(document)
    (folder / "rig.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=found):
        read_rig(folder)


def test_a_calibration_that_is_missing(rig: RigResult, tmp_path: Path) -> None:
    folder = _written(rig, tmp_path / "rig")
    (folder / "cam1" / "calibration.json").unlink()
    with pytest.raises(DataError, match="cam1"):
        read_rig(folder)


def test_a_camera_that_is_not_there(rig: RigResult) -> None:
    with pytest.raises(ConfigError, match="cam0, cam1, cam2"):
        rig["cam9"]


@pytest.mark.parametrize("name", ["", "rig.json"])
def test_a_command_for_one_camera_names_the_folders_of_each(
    rig: RigResult, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    folder = _written(rig, tmp_path / "rig")
    for command in (["inspect"], ["evaluate", "--truth", str(folder / "cam0")]):
        assert main([*command, str(folder / name)]) == 2
        error = capsys.readouterr().err
        assert f"found a rig of several cameras, expected the result of one: {folder / 'cam0'}" in error
        assert error.count("\n") == 1
    assert main(["import", str(folder / name)]) == 2
    assert "found a rig of several cameras" in capsys.readouterr().err
    assert main(["import", str(folder / "cam0")]) == 0
