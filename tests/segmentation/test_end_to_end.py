"""From pictures and clouds without labels to a calibration, by networks fitted to other streets."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from stored import simulated, written
from streets import SHORT_STREET

from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.starts import errors_of
from sst_graph.result import read_result
from sst_graph.segmentation import open_image_segmenter, open_scan_segmenter
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Frame, SemanticClass
from studies.networks.small_networks import Fit, write_image_network, write_scan_network

HALF_SIZE = {
    "width": 621,
    "height": 188,
    "azimuth_limit_deg": 50.0,
    "azimuth_step_deg": 0.3,
    "vehicle_density": 0.3,
}
STREET = SimulationConfig(seed=5, frames=10, time_offset_s=0.1, label_noise=0.0, **HALF_SIZE)
FIT = Fit(pixels=4000, steps=400)


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with image.yaml and scan.yaml, fitted to four frames of each of three other streets."""
    folder = tmp_path_factory.mktemp("networks")
    streets = [
        KeptDrive.of(
            simulate(SimulationConfig(seed=seed, frames=4, frame_rate_hz=1.0, label_noise=0.0, **HALF_SIZE))
        )
        for seed in (701, 702, 703)
    ]
    write_image_network(streets, folder, FIT)
    write_scan_network(streets, folder, FIT)
    return folder


@pytest.fixture(scope="module")
def rough_networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same fitted in a few steps to two frames, where it does not matter what they find."""
    folder, street = tmp_path_factory.mktemp("networks"), simulated(SHORT_STREET)
    few = KeptDrive(street.name, street.camera, street.nominal, street.truth, (street[0], street[10]))
    write_image_network([few], folder, Fit(pixels=500, steps=20))
    write_scan_network([few], folder, Fit(pixels=500, steps=20))
    return folder


def without_labels(street: Path, folder: Path) -> Path:
    """A copy of a street on disk without labels and masks."""
    shutil.copytree(street, folder)
    for name in ("labels", "semantic_2"):
        shutil.rmtree(folder / "sequences" / "00" / name)
    return folder


@pytest.fixture(scope="module")
def unlabelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return without_labels(written(STREET), tmp_path_factory.mktemp("drive") / "street")


@pytest.fixture(scope="module")
def small_unlabelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street in smaller pictures, for the rough networks."""
    return without_labels(written(SHORT_STREET), tmp_path_factory.mktemp("drive") / "street")


def overlap(found: np.ndarray, exact: np.ndarray) -> float:
    """Intersection over union of the vehicles."""
    a, b = found == SemanticClass.VEHICLE, exact == SemanticClass.VEHICLE
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.slow
def test_networks_find_the_vehicles_of_a_street_they_do_not_know(networks: Path) -> None:
    frame: Frame = open_source(written(STREET))[5]
    assert frame.image is not None
    assert frame.scan is not None
    mask = open_image_segmenter(networks / "image.yaml").segment(frame.image).mask
    classes = open_scan_segmenter(networks / "scan.yaml").segment(frame.scan).classes
    assert overlap(mask, frame.image.mask) > 0.6
    assert overlap(classes, frame.scan.classes) > 0.8


@pytest.mark.slow
def test_a_drive_without_labels_is_calibrated_by_networks(
    networks: Path,
    unlabelled: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Segmented ahead or by calibrate itself: the same labels, the same result, as good as labels are."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    models = ["--image-model", str(networks / "image.yaml"), "--lidar-model", str(networks / "scan.yaml")]
    labels = str(tmp_path / "labels")
    assert main(["segment", str(unlabelled), *models, "--out", labels]) == 0
    assert main(["segment", str(unlabelled), *models]) == 0
    assert capsys.readouterr().out.count("20 labels made, 0 found") == 2
    with monkeypatch.context() as patch:
        # What is stored needs no network, and no picture is labelled a second time.
        patch.setattr("sst_graph.segmentation.onnx_network.OnnxNetwork.run", None)
        code = main(
            ["calibrate", str(unlabelled), "--labels", labels, "--no-report", "--out", str(tmp_path / "a")]
        )
        assert (
            main(["calibrate", str(unlabelled), *models, "--no-report", "--out", str(tmp_path / "b")]) == code
        )
    first, second = (read_result(tmp_path / name / "calibration.json") for name in "ab")
    assert (first.T_camera_lidar.matrix() == second.T_camera_lidar.matrix()).all()
    assert first.time_offset_s == second.time_offset_s
    truth = open_source(unlabelled).truth
    assert truth is not None
    errors = errors_of(first, truth)
    assert errors.qad_deg < 0.5
    assert errors.atd_m < 0.05
    assert first.method == "joint"
    read_as = json.loads((tmp_path / "b" / "calibration.json").read_text())["read_as"]
    assert (read_as["image_model"], read_as["lidar_model"]) == (models[1], models[3])
    # A later command labels the drive as the calibration did.
    capsys.readouterr()
    picture = str(tmp_path / "o.png")
    assert main(["overlay", str(tmp_path / "a"), str(unlabelled), "--out", picture]) == 0
    assert f"read with --labels {labels}" in capsys.readouterr().err
    shutil.rmtree(labels)
    assert main(["overlay", str(tmp_path / "a"), str(unlabelled), "--out", picture, "--overwrite"]) == 0


def test_tracking_labels_frame_by_frame(
    rough_networks: Path, small_unlabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = [
        "--image-model",
        str(rough_networks / "image.yaml"),
        "--lidar-model",
        str(rough_networks / "scan.yaml"),
    ]
    main(["track", str(small_unlabelled), "--frames", "0:4", *models, "--labels", str(tmp_path / "labels")])
    assert len(capsys.readouterr().out.splitlines()) == 4
    assert len(list((tmp_path / "labels").glob("*/*/*.*"))) == 4 + 4 + 2


def test_classes_that_a_network_does_not_know_are_refused(
    rough_networks: Path, small_unlabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["calibrate", str(small_unlabelled), "--image-model", str(rough_networks / "image.yaml")]
    command += ["--labels", str(tmp_path / "labels"), "--method", "joint", "--out", str(tmp_path / "out")]
    assert main([*command, "--classes", "vehicle,pole"]) == 2
    message = capsys.readouterr().err
    assert "image.yaml: found no pole among its classes (building, ground, vegetation, vehicle)" in message
    assert message.count("\n") == 1


def test_labels_are_not_written_among_other_things(
    rough_networks: Path, small_unlabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["segment", str(small_unlabelled), "--image-model", str(rough_networks / "image.yaml"), "--out"]
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    for folder, message in (
        (other, "found a folder of other things, expected a new one or one of labels"),
        (other / "notes.txt", "found a file, expected a folder or nothing"),
        (small_unlabelled, "is read as DATA and would be replaced"),
    ):
        assert main([*command, str(folder)]) == 2
        assert message in capsys.readouterr().err
    assert os.listdir(other) == ["notes.txt"]
    assert main(["segment", str(small_unlabelled), "--out", str(tmp_path / "new")]) == 2
    assert "found neither --image-model nor --lidar-model" in capsys.readouterr().err
