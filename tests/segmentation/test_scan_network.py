"""Networks for scans: their files, and the labels they give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny_networks import range_yaml, scan_of, write_range_network

from sst_graph.classes.data_sets import SEMANTIC_KITTI, SEMANTIC_KITTI_20
from sst_graph.errors import DataError
from sst_graph.segmentation import open_scan_segmenter
from sst_graph.segmentation.range_view import Neighbours, RangeView
from sst_graph.segmentation.scan_network import OnnxScanSegmenter
from sst_graph.types import SemanticClass

ABOVE_AND_BELOW = scan_of(np.array([[9.0, 0, 0.4], [9.0, 3, 0.3], [9.0, 0, -1.6], [9.0, -4, -1.5]]))


@pytest.mark.parametrize("neighbours", ["", "neighbours: false\n"])
def test_points_have_the_class_of_the_largest_output(tmp_path: Path, neighbours: str) -> None:
    path = range_yaml(write_range_network(tmp_path / "n.onnx"), neighbours)
    found = open_scan_segmenter(path).segment(ABOVE_AND_BELOW)
    assert [SemanticClass(c).name for c in found.classes] == ["VEHICLE", "VEHICLE", "GROUND", "GROUND"]
    assert found.classes.dtype == np.uint8


def test_an_empty_scan_has_no_labels(tmp_path: Path) -> None:
    segmenter = open_scan_segmenter(range_yaml(write_range_network(tmp_path / "n.onnx")))
    assert len(segmenter.segment(scan_of(np.zeros((0, 3)))).classes) == 0


def test_unlabelled_points_may_be_anything(tmp_path: Path) -> None:
    """Above the sensor the network says what its map ignores; no point is sky."""
    path = range_yaml(write_range_network(tmp_path / "n.onnx"), "neighbours: {count: 1, window: 1}\n")
    path.write_text(path.read_text().replace("0: ignore", "0: sky").replace("1: vehicle", "1: ignore"))
    found = open_scan_segmenter(path).segment(ABOVE_AND_BELOW)
    assert [SemanticClass(c).name for c in found.classes] == ["IGNORE", "IGNORE", "GROUND", "GROUND"]
    assert open_scan_segmenter(path).known == {SemanticClass.GROUND}


def write_bonnetal(folder: Path, knn: bool = True) -> Path:
    """The folder of a network as lidar-bonnetal's training leaves it, trained on SemanticKITTI."""
    sensor = {
        "name": "HDL64",
        "type": "spherical",
        "fov_up": 3,
        "fov_down": -25,
        "img_prop": {"width": 64, "height": 16},
        "img_means": [12.12, 10.88, 0.23, -1.04, 0.21],
        "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
    }
    voting = {"use": knn, "params": {"knn": 7, "search": 7, "sigma": 1.0, "cutoff": 2.0}}
    arch = {"post": {"CRF": {"use": False}, "KNN": voting}, "dataset": {"labels": "kitti", "sensor": sensor}}
    numbers = {name: number for number, name in SEMANTIC_KITTI.names.items()}
    data = {
        "name": "kitti",
        "labels": dict(SEMANTIC_KITTI.names),
        "learning_map_inv": {k: numbers[name] for k, name in SEMANTIC_KITTI_20.names.items()},
        "learning_ignore": {k: k == 0 for k in range(20)},
    }
    folder.mkdir()
    (folder / "arch_cfg.yaml").write_text(yaml.safe_dump(arch))
    (folder / "data_cfg.yaml").write_text(yaml.safe_dump(data))
    write_range_network(folder / "model.onnx", classes=20)
    return folder


def test_a_folder_of_lidar_bonnetal_is_read(tmp_path: Path) -> None:
    segmenter = open_scan_segmenter(write_bonnetal(tmp_path / "net"))
    assert isinstance(segmenter, OnnxScanSegmenter)
    model = segmenter.model
    assert model.view == RangeView(64, 16)
    assert model.neighbours == Neighbours(7, 7, 1.0, 2.0)
    assert dict(model.numbers.classes) == dict(SEMANTIC_KITTI_20.classes)
    assert segmenter.name == "net"
    assert len(segmenter.segment(ABOVE_AND_BELOW).classes) == 4


def test_without_its_vote_pixels_decide(tmp_path: Path) -> None:
    segmenter = open_scan_segmenter(write_bonnetal(tmp_path / "net", knn=False))
    assert isinstance(segmenter, OnnxScanSegmenter)
    assert segmenter.model.neighbours is None


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("data_cfg.yaml", "10: car", "10: spaceship", "the label 'spaceship' of an unknown class"),
        ("data_cfg.yaml", "learning_map_inv", "learned", "found no table learning_map_inv"),
        ("arch_cfg.yaml", "sensor:", "sensors:", "found no table dataset: sensor"),
        ("arch_cfg.yaml", "fov_up: 3", "fov_up: up", "fov_up: found 'up', expected a finite number"),
        ("arch_cfg.yaml", "height: 16", "height: 32", "found an input of 1x5x16x64, expected 1x5x32x64"),
    ],
)
def test_a_folder_that_cannot_be_used_is_refused(
    file: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = write_bonnetal(tmp_path / "net") / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=message.replace("(", r"\(")):
        open_scan_segmenter(path.parent)


def test_intensities_count_and_so_does_their_range(tmp_path: Path) -> None:
    segmenter = open_scan_segmenter(
        range_yaml(write_range_network(tmp_path / "n.onnx"), "remission_range: 255\n")
    )
    assert isinstance(segmenter, OnnxScanSegmenter)
    bright = scan_of(ABOVE_AND_BELOW.points, np.array([255, 51, 0, np.nan], np.float32))
    values = segmenter.model.view.project(bright).values[0, 4]
    assert sorted(values[values != 0]) == pytest.approx([0.2, 1.0])
