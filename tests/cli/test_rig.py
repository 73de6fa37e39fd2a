"""``sst-graph calibrate`` of several cameras, as a user calls it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from sst_graph.cli import main
from sst_graph.result import read_result
from sst_graph.rig import read_rig


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stereo street on disk, in small pictures."""
    folder = tmp_path_factory.mktemp("rig") / "street"
    options = ["--seed", "2", "--frames", "24", "--time-offset", "0.05", "--stereo"]
    small = ["width=621", "height=188", "azimuth_limit_deg=50", "vehicle_density=0.3"]
    assert main(["simulate", str(folder), *options, *(f"--set={value}" for value in small)]) == 0
    return folder


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stereo street of two frames, for what is refused before a frame is looked at."""
    folder = tmp_path_factory.mktemp("rig") / "street"
    options = ["--frames", "2", "--stereo", "--set=width=310", "--set=height=94"]
    assert main(["simulate", str(folder), *options]) == 0
    return folder


@pytest.mark.slow
def test_a_stereo_rig_from_disk(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rig"
    options = ["--camera", "image_2", "image_3", "--rig", "dataset", "--one-trigger"]
    videos = ["--video", str(tmp_path / "drive.gif")]
    code = main(["calibrate", str(street), *options, "--out", str(out), *videos])
    captured = capsys.readouterr()
    assert (code, captured.err) == (0, "")
    # 1. What is printed: each camera against the truth, and the pose between them.
    assert captured.out.count("against the truth") == 2
    assert "image_2 in image_3: " in captured.out and "-53." in captured.out
    # 2. The files, read again.
    rig = read_rig(out)
    assert list(rig.cameras) == ["image_2", "image_3"] and rig.status == "ok"
    for name in rig.cameras:
        assert sorted(path.suffix for path in (out / name).iterdir()) == [
            ".html",
            ".json",
            ".md",
            *[".png"] * 3,
        ]
        assert rig[name] == read_result(out / name / "calibration.json")
        assert rig[name].read_as["camera"] == name
    document = json.loads((out / "rig.json").read_text())
    assert document["known"]["one_trigger"] and len(document["covariance"]) == 14
    assert document["diagnostics"]["known_poses"][0]["used"]
    for name in rig.cameras:
        assert (tmp_path / f"drive_{name}.gif").read_bytes().startswith(b"GIF8")
    # 3. The other commands take each camera's folder.
    picture = tmp_path / "overlay.png"
    assert main(["overlay", str(out / "image_3"), str(street), "--out", str(picture)]) == 0
    assert "read with --camera image_3" in capsys.readouterr().err
    assert main(["export", str(out / "image_3"), "--to", "opencv"]) == 0
    assert main(["inspect", str(out / "image_3"), "--json"]) == 0
    # 4. A rig's result as the start of another one: cameras that it has not are named.
    capsys.readouterr()
    again = ["calibrate", str(street), "--init", str(out), "--camera", "image_2", "image_0"]
    assert main([*again, "--out", str(tmp_path / "x")]) == 2
    assert "has image_2, image_3" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_as_json_with_videos_inside(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rig"
    options = ["--camera", "image_2", "image_3", "--frames", "0:6", "--set", "search.enabled=false"]
    written = ["--out", str(out), "--no-report", "--video", str(out / "drive.gif"), "--json"]
    assert main(["calibrate", str(street), *options, *written]) == 3
    document = json.loads(capsys.readouterr().out)
    rig = read_rig(out)
    assert document["status"] == rig.status and document["camera_poses"][0]["camera"] == "image_3"
    assert document["covariance"] == rig.covariance.tolist()
    assert list(document["cameras"]) == ["image_2", "image_3"]
    for name, printed in document["cameras"].items():
        assert printed["T_camera_lidar"] == rig[name].T_camera_lidar.matrix().tolist()
        assert printed["time_offset_s"] == rig[name].time_offset_s
        assert printed["errors"]["qad_deg"] > 0 and printed["out"] == str(out / name)
        assert all((out / name / file).is_file() for file in printed["files"])
    assert {"rig.json", "drive_image_2.gif", "drive_image_3.gif"} < set(document["files"])
    pictures = [(out / file).read_bytes() for file in document["files"] if file.endswith(".gif")]
    assert pictures[0].startswith(b"GIF8") and pictures[0] != pictures[1]


@pytest.fixture(scope="module")
def half_labelled(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stereo street without the masks of image_3."""
    folder = tmp_path_factory.mktemp("rig") / "street"
    shutil.copytree(street, folder)
    shutil.rmtree(folder / "sequences/00/semantic_3")
    return folder


_FEW = ["--camera", "image_2", "image_3", "--frames", "0:6", "--no-report", "--set", "search.enabled=false"]


@pytest.mark.slow
def test_a_camera_without_masks_leaves_the_others_theirs(
    half_labelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By labels it has no estimate of its own, and the other one is that of its masks."""
    options = [*_FEW, "--method", "joint", "--out", str(tmp_path / "rig")]
    assert main(["calibrate", str(half_labelled), *options]) == 3
    assert "image_3: unobservable: no mask's pixel has a label" in capsys.readouterr().err
    rig = read_rig(tmp_path / "rig")
    assert rig["image_2"].frames_used and not rig["image_3"].frames_used


@pytest.mark.slow
def test_the_camera_that_makes_all_go_by_edges_is_named(
    half_labelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["calibrate", str(half_labelled), *_FEW, "--out", str(tmp_path / "rig")])
    said = "warning: image_3: found no labels, so all cameras are calibrated without them"
    assert said in capsys.readouterr().err


def test_labels_of_no_camera(refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where no camera has masks, method joint is refused."""
    bare = tmp_path / "street"
    shutil.copytree(refused, bare)
    for camera in (2, 3):
        shutil.rmtree(bare / f"sequences/00/semantic_{camera}")
    options = ["--camera", "image_2", "image_3", "--method", "joint", "--out", str(tmp_path / "out")]
    assert main(["calibrate", str(bare), *options]) == 2
    assert "found no semantic masks of images, expected both for method joint" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (["--camera", "image_2", "image_7"], "camera 'image_7': "),
        (["--camera", "image_2", "image_7"], "has image_2, image_3"),
        (["--camera", "image_2", "--camera", "image_7"], "camera 'image_7': "),
        (["--camera", "image_2", "--camera", "image_3", "--rig-sigma", "1,1"], "expected with --rig"),
        (["--camera", "image_2", "image_2"], "--camera image_2: found twice"),
        (["--camera", "image_2", "--rig", "dataset"], "--rig: means something for several cameras only"),
        (["--one-trigger"], "--one-trigger: means something for several cameras only"),
        (["--camera", "image_2", "image_3", "--rig-sigma", "1,1"], "--rig-sigma: expected with --rig"),
        (["--camera", "image_2", "image_3", "--rig", "dataset", "--rig-sigma", "a"], "expected DEG,CM"),
        (["--camera", "image_2", "image_3", "--rig", "none.yaml"], "none.yaml"),
        (
            ["--camera", "image_2", "image_3", "--method", "motion"],
            "method joint or edges, found motion",
        ),
        (["--camera", "image_2", "image_3", "--video", "a.avi"], "a_image_2.avi: expected a name that ends"),
    ],
)
def test_what_is_refused(
    refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], found: str
) -> None:
    assert main(["calibrate", str(refused), *options, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert found in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_camchain_without_the_camera(
    refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chain = tmp_path / "camchain.yaml"
    chain.write_text(
        "cam0: {rostopic: image_2}\ncam1: {T_cn_cnm1: [1], rostopic: /right}\n".replace("[1]", _UNIT)
    )
    options = ["--camera", "image_2", "image_3", "--rig", str(chain), "--out", str(tmp_path / "out")]
    assert main(["calibrate", str(refused), *options]) == 2
    error = capsys.readouterr().err
    assert "cam0 (image_2), cam1 (/right)" in error and "image_3" in error


_UNIT = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"


def test_one_pose_is_no_start_of_two_cameras(
    refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file that names no camera goes for one; the folder of one camera's result is of that one."""
    (tmp_path / "start.json").write_text(f'{{"T_camera_lidar": {_UNIT}}}')
    (tmp_path / "of_one").mkdir()
    (tmp_path / "of_one/calibration.json").write_text(
        f'{{"T_camera_lidar": {_UNIT}, "camera": {{"name": "image_2"}}}}'
    )
    for init, found in (
        ("start.json", "found one pose for image_2 and image_3, expected one of each"),
        ("of_one", "found a calibration of camera image_2, expected one of image_3"),
    ):
        options = ["--camera", "image_2", "image_3", "--init", str(tmp_path / init)]
        assert main(["calibrate", str(refused), *options, "--out", str(tmp_path / "out")]) == 2
        assert found in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_camera_without_images(refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is bad input, which is said before anything is calibrated."""
    data = tmp_path / "street"
    sequence = data / "sequences" / "00"
    (sequence / "image_3").mkdir(parents=True)
    for entry in (refused / "sequences" / "00").iterdir():
        if entry.name != "image_3":
            (sequence / entry.name).symlink_to(entry)
    code = main(["calibrate", str(data), "--camera", "image_2", "image_3", "--out", str(tmp_path / "out")])
    assert code == 2 and "image_3" in capsys.readouterr().err


def test_data_after_the_cameras(refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``--camera NAME DATA`` takes DATA for what it is; without any DATA the usage says so."""
    out = str(tmp_path / "out")
    assert main(["calibrate", "--camera", "image_7", str(refused), "--out", out]) == 2
    assert "camera 'image_7'" in capsys.readouterr().err
    assert main(["calibrate", "--camera", "image_2", "image_3", "--out", out]) == 2
    assert "required: DATA" in capsys.readouterr().err
