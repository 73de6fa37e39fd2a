"""The summary of a drive."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_networks import colour_yaml, write_colour_network

from sst_graph import open_source
from sst_graph.cli import main
from sst_graph.data.info.facts import SensorFacts
from sst_graph.data.info.methods import METHODS, Content, missing_for
from sst_graph.data.info.summary import Gap, drive_info, sensor_info

EVERYTHING = Content(20, 20, True, frozenset({"vehicle", "pole"}), frozenset({"vehicle"}), True)


def test_rate_and_gaps_by_the_median_interval() -> None:
    stamps = np.array([0, 100, 200, 360, 460, 560, 700, 1200], np.int64) * 1_000_000
    info = sensor_info(SensorFacts("here", stamps))
    assert (info.count, info.rate_hz, info.gap_count) == (8, 10.0, 2)
    assert (info.first_ns, info.last_ns) == (0, 1_200_000_000)
    assert info.gaps == (Gap(200_000_000, 0.16), Gap(700_000_000, 0.5))
    assert sensor_info(SensorFacts("", stamps[:1])).rate_hz is None
    assert sensor_info(SensorFacts("", stamps[:0])).first_ns is None


def test_what_is_missing_for_which_method() -> None:
    assert missing_for(EVERYTHING) == {method: () for method in METHODS}
    nothing = Content(20, 20, True, frozenset(), frozenset(), True)
    labels = ("labels of points", "semantic masks of images")
    without = ("edges", "motion", "track")
    assert missing_for(nothing) == {method: () if method in without else labels for method in METHODS}
    assert missing_for(replace(nothing, pictures=False))["track"] == labels
    blind = Content(1, 20, False, frozenset({"pole"}), frozenset({"vehicle"}), False)
    found = missing_for(blind)
    assert found["motion"] == ("scans", "pictures", "a nominal extrinsic (--init none does without)")
    assert found["joint"] == (
        "a class that points and masks both have", "a nominal extrinsic (--init none does without)"
    )  # fmt: skip
    assert found["paper"][-1] == "a nominal extrinsic (--init FILE gives a start)"


@pytest.mark.parametrize(
    ("points", "masks", "looked_at", "words"),
    [
        ({"vehicle", "pole"}, {"pole"}, 5, "pixels labelled vehicle in the 5 images looked at{pole}"),
        ({"vehicle", "pole"}, {"pole"}, 20, "pixels labelled vehicle{pole}"),
        ({"pole"}, {"vehicle", "pole"}, 5, "points labelled vehicle in the 5 scans looked at{pole}"),
        (
            {"pole", "ground"},
            {"pole", "ground"},
            None,
            "points labelled vehicle and pixels labelled vehicle{pole}",
        ),
        ({"ground"}, {"ground"}, None, "points labelled vehicle and pixels labelled vehicle"),
    ],
)
def test_labels_without_the_class_that_is_aligned(
    points: set[str], masks: set[str], looked_at: int | None, words: str
) -> None:
    content = Content(20, 20, True, frozenset(points), frozenset(masks), True)
    found = missing_for(replace(content, scans_looked_at=looked_at, images_looked_at=looked_at))
    said = words.format(pole=" (or name other classes: --classes pole)")
    by_labels = ("joint", "both", "paper", "semalign", "track")
    assert found == {method: (said,) if method in by_labels else () for method in METHODS}


def test_labels_of_networks_without_vehicles(
    kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The network knows poles, ground and sky; all pixels of the drive are ground to it."""
    model = colour_yaml(write_colour_network(tmp_path / "n.onnx"))
    model.write_text(model.read_text().replace("vehicle", "pole"))
    options = ["--image-model", str(model), "--labels", str(tmp_path / "labels")]
    assert main(["info", str(kitti_drive), *options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"]["classes"] == ["ground"]
    for method in ("joint", "both", "paper", "semalign", "track"):
        assert found["missing"][method] == ["pixels labelled vehicle"]


def test_stamps_of_two_clocks_that_share_no_time_are_named(kitti_drive: Path) -> None:
    times = kitti_drive / "times_2.txt"
    for later, named in ((0.03, False), (4000.0, True)):
        times.write_text("".join(f"{later + 0.1 * k}\n" for k in range(5)))
        found = drive_info(open_source(kitti_drive)).missing
        sentence = "images of the time of the scans (--init FILE gives the offset between their stamps)"
        assert {method for method, missing in found.items() if sentence in missing} == (
            set(METHODS) if named else set()
        )


def test_pictures_of_12_bits_in_16_are_missing_pictures(kitti_drive: Path) -> None:
    for path in (kitti_drive / "image_2").iterdir():
        cv2.imwrite(str(path), np.full((6, 8), 4095, np.uint16))
    found = drive_info(open_source(kitti_drive)).missing
    words = "pictures that are not black (12 bits kept in 16 are to be made 16 times brighter)"
    assert {method for method, missing in found.items() if words in missing} == {
        "edges",
        "both",
        "motion",
        "paper",
    }


def test_text_and_json_of_a_drive(kitti_drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(kitti_drive)]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line[0] != " ")
    assert lines["drive"] == "kitti/00: 5 frames"
    assert lines["camera"] == "pinhole, 8x6 px, fx 700.00, fy 700.00, cx 4.00, cy 3.00 px"
    assert lines["scans"].endswith("velodyne, 10.00 Hz, 0.000000000 s to 0.410000000 s, 0 gaps")
    assert lines["points"] == "12 a scan, no times of points, no rings"
    assert lines["nominal"] == "yes, by calib.txt" and lines["joint"] == "nothing is missing"
    assert main(["info", str(kitti_drive), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["scan_sensor"]["count"] == found["image_sensor"]["count"] == 5
    assert found["images"]["masks"] == 1.0 and found["scans"]["classes"] == ["vehicle", "ground"]
    assert found["missing"] == {method: [] for method in METHODS}


def test_a_drive_without_labels(kitti_drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (kitti_drive / "labels").iterdir():
        labels = np.zeros(12, "<u4")
        labels.tofile(file)
    assert main(["info", str(kitti_drive), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["scans"]["labelled_points"] == 0.0
    assert found["missing"]["motion"] == [] and found["missing"]["joint"] == ["labels of points"]


def test_labels_of_some_frames_are_counted_where_they_were_looked_at(
    kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(1, 5):
        np.zeros(12, "<u4").tofile(kitti_drive / f"labels/{k:06d}.label")
    assert main(["info", str(kitti_drive)]) == 0
    said = capsys.readouterr().out
    assert "labels in 1 of 5 scans looked at, about 20 % of all points" in said
    assert "\nboth         nothing is missing\n" in said


def test_masks_without_a_class_to_align(kitti_drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (kitti_drive / "semantic_2").iterdir():
        cv2.imwrite(str(file), np.zeros((6, 8), np.uint8))
    assert main(["info", str(kitti_drive)]) == 0
    said = capsys.readouterr().out
    assert "masks of 100 % of the images, 100 % of all pixels: none that can be aligned\n" in said


def test_stamps_in_another_unit_show_as_a_period(
    kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = kitti_drive / "times.txt"
    times.write_text("\n".join(f"{100.0 * k:.1f}" for k in range(5)))
    assert main(["info", str(kitti_drive)]) == 0
    out = capsys.readouterr().out
    assert "one in 100 s (are the stamps in seconds?)" in out and "0.01 Hz" not in out
