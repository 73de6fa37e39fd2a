"""Drives with labels of networks: what they hold, what is stored, what a killed run leaves."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_networks import colour_yaml, range_yaml, write_colour_network, write_range_network

from sst_graph.cli.labels import store_to_fill
from sst_graph.data import open_source
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.segmentation import (
    ImageLabels,
    LabelledSource,
    LabelStore,
    PointLabels,
    cache_folder,
    open_image_segmenter,
    open_scan_segmenter,
    segment_drive,
    with_labels,
)
from sst_graph.segmentation.store import StoredModel
from sst_graph.types import NO_PICTURE, CameraImage, Frame, Scan, SemanticClass

CLASSES = np.array([c for c in SemanticClass if c != SemanticClass.OBJECT], np.uint8)
"""That labels have; OBJECT is what geometry finds."""


class Threshold:
    """A segmenter of no network: what is brighter than a value is a vehicle; it counts its pictures."""

    def __init__(self, value: int, numbered: bool = False) -> None:
        self.value, self.numbered, self.asked = value, numbered, 0
        self.name = f"above {value}"
        self.identity = hashlib.sha256(self.name.encode()).hexdigest()
        self.known = frozenset({SemanticClass.VEHICLE})

    def segment(self, image: CameraImage) -> ImageLabels:
        self.asked += 1
        inside = image.pixels[:, :, 0] > self.value
        mask = np.where(inside, np.uint8(SemanticClass.VEHICLE), np.uint8(SemanticClass.GROUND))
        return ImageLabels(mask, inside.astype(np.uint16) * 3 if self.numbered else None)


def drive_of(frames: int = 3) -> KeptDrive:
    """Pictures with a bright corner, clouds of few points, no labels."""
    rng = np.random.default_rng(1)
    made = []
    for k in range(frames):
        pixels = np.zeros((6, 8, 3), np.uint8)
        pixels[: k + 1, :4] = 200
        image = CameraImage(100 * k, np.full((6, 8), SemanticClass.IGNORE, np.uint8), pixels)
        points = rng.uniform(-9.0, 9.0, (20, 3)).astype(np.float32)
        scan = Scan(100 * k, points, np.full(20, SemanticClass.IGNORE, np.uint8))
        made.append(Frame(k, scan, image))
    return KeptDrive("made", PinholeCamera(8.0, 8.0, 4.0, 3.0, 8, 6), None, None, tuple(made))


def image_of(drive: LabelledSource, k: int) -> CameraImage:
    image = drive[k].image
    assert image is not None
    return image


def test_a_view_labels_pictures_and_leaves_the_rest(tmp_path: Path) -> None:
    source = drive_of()
    drive = with_labels(source, Threshold(100), None, tmp_path)
    assert (image_of(drive, 1).mask == np.where(source[1].image.pixels[:, :, 0] > 100, 1, 2)).all()  # type: ignore[union-attr]
    assert drive[1].scan == source[1].scan
    assert (drive.name, len(drive), drive.camera, drive.sweep) == ("made", 3, source.camera, "auto")
    assert [frame.index for frame in drive] == [0, 1, 2]


def test_labels_are_made_once_whatever_the_drive_is_called(tmp_path: Path) -> None:
    made = Threshold(100, numbered=True)
    first = with_labels(drive_of(), made, None, tmp_path)
    counts = segment_drive(first)
    assert (counts["made"], counts["found"], made.asked) == (3, 0, 3)
    later = dataclasses.replace(drive_of(), name="other").with_images(
        lambda image: dataclasses.replace(image, stamp_ns=image.stamp_ns + 7)
    )
    again = Threshold(100, numbered=True)
    second = with_labels(later, again, None, tmp_path)
    assert segment_drive(second) == {"found": 3}
    assert again.asked == 0
    for k in range(3):
        assert (image_of(second, k).mask == image_of(first, k).mask).all()
        assert np.array_equal(image_of(second, k).instances, image_of(first, k).instances)


def test_labels_of_another_network_are_other_labels(tmp_path: Path) -> None:
    segment_drive(with_labels(drive_of(), Threshold(100), None, tmp_path))
    other = Threshold(250)
    drive = with_labels(drive_of(), other, None, tmp_path)
    assert (image_of(drive, 1).mask == SemanticClass.GROUND).all()
    assert other.asked == 1
    with pytest.raises(ConfigError, match=r"found labels of 2 networks \(above 100 .*\): give --image-model"):
        with_labels(drive_of(), None, None, tmp_path)


def test_stored_labels_serve_without_their_network(tmp_path: Path) -> None:
    segment_drive(with_labels(drive_of(2), Threshold(100), None, tmp_path))
    drive = with_labels(drive_of(3), None, None, tmp_path)
    assert drive.labelling.images is not None
    assert drive.labelling.images.known == {SemanticClass.VEHICLE}
    assert image_of(drive, 1).has_mask
    with pytest.raises(DataError, match="no labels of the image stamped 200 ns, expected those of all"):
        drive[2]
    with pytest.raises(ConfigError, match="found no labels, expected those that sst-graph segment writes"):
        with_labels(drive_of(), None, None, tmp_path / "none")


def test_an_image_without_a_picture_may_be_anything(tmp_path: Path) -> None:
    blind = drive_of().with_images(lambda i: dataclasses.replace(i, pixels=NO_PICTURE, mask=i.mask * 0))
    image = image_of(with_labels(blind, Threshold(100), None, tmp_path), 0)
    assert not image.has_mask


def test_what_a_lens_does_not_show_is_not_labelled(tmp_path: Path) -> None:
    valid = np.ones((6, 8), bool)
    valid[:, 0] = False
    seen = drive_of().with_images(lambda image: dataclasses.replace(image, valid=valid))
    image = image_of(with_labels(seen, Threshold(100), None, tmp_path), 0)
    assert (image.mask[:, 0] == SemanticClass.IGNORE).all()
    assert (image.mask[:, 1:] != SemanticClass.IGNORE).all()


def test_all_classes_and_instances_come_back_from_disk(tmp_path: Path) -> None:
    store, source = LabelStore(tmp_path), drive_of(1)
    image, scan = source[0].image, source[0].scan
    assert image is not None
    assert scan is not None
    rng = np.random.default_rng(5)
    mask = rng.choice(CLASSES, (6, 8))
    instances = np.where(mask == SemanticClass.VEHICLE, rng.integers(0, 256, (6, 8)), 0).astype(np.uint16)
    store.put_image("a" * 64, image, ImageLabels(mask, instances))
    found = store.image("a" * 64, image)
    assert found is not None
    assert (found.mask == mask).all()
    assert np.array_equal(found.instances, instances)
    assert store.image("b" * 64, image) is None
    changed = dataclasses.replace(image, pixels=image.pixels + np.uint8(1))
    assert store.image("a" * 64, changed) is None


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    first = image_of(with_labels(drive_of(), Threshold(100), None, tmp_path), 0)
    path = next(tmp_path.glob("images/*/*.png"))
    left = path.with_name(f".{path.name}.0123456789abcdef.sst-graph-partial")
    left.write_bytes(path.read_bytes()[:30])
    again = image_of(with_labels(drive_of(), Threshold(100), None, tmp_path), 0)
    assert not left.exists() and (again.mask == first.mask).all()


def test_a_damaged_file_is_made_again_or_named(tmp_path: Path) -> None:
    segmenter = Threshold(100)
    first = image_of(with_labels(drive_of(), segmenter, None, tmp_path), 0)
    path = next(tmp_path.glob("images/*/*.png"))
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(DataError, match=path.name):
        with_labels(drive_of(), None, None, tmp_path)[0]
    again = image_of(with_labels(drive_of(), segmenter, None, tmp_path), 0)
    assert (again.mask == first.mask).all()
    assert segmenter.asked == 2
    assert (image_of(with_labels(drive_of(), None, None, tmp_path), 0).mask == first.mask).all()


@pytest.mark.parametrize(
    "text", ["{}", "[", '{"format": "sst-graph/labels", "version": 1, "classes": ["lorry"]}']
)
def test_a_damaged_model_file_is_named(text: str, tmp_path: Path) -> None:
    with_labels(drive_of(), Threshold(100), None, tmp_path)
    next(tmp_path.glob("images/*/model.json")).write_text(text)
    with pytest.raises(DataError, match=r"model\.json: found no "):
        with_labels(drive_of(), None, None, tmp_path)


def test_a_network_without_a_stored_label_is_not_chosen(tmp_path: Path) -> None:
    """A run that fails before its first label leaves a folder of its network."""

    class Failing(Threshold):
        def segment(self, image: CameraImage) -> ImageLabels:
            raise DataError(self.name, "no picture that it can label", "one")

    with pytest.raises(DataError, match="above 50"):
        segment_drive(with_labels(drive_of(), Failing(50), None, tmp_path))
    assert store_to_fill(tmp_path).folder == tmp_path
    with pytest.raises(ConfigError, match="found no labels, expected those"):
        with_labels(drive_of(), None, None, tmp_path)
    segment_drive(with_labels(drive_of(), Threshold(100), None, tmp_path))
    chosen = with_labels(drive_of(), None, None, tmp_path).labelling.images
    assert chosen is not None and chosen.name == "above 100"


def test_labels_of_another_shape_are_refused(tmp_path: Path) -> None:
    class Small(Threshold):
        def segment(self, image: CameraImage) -> ImageLabels:
            return ImageLabels(np.zeros((3, 4), np.uint8))

    with pytest.raises(DataError, match=r"labels of shape \(3, 4\), expected \(6, 8\)"):
        with_labels(drive_of(), Small(1), None, tmp_path)[0]


def test_labels_are_the_same_when_they_are_made_and_when_they_are_found(tmp_path: Path) -> None:
    """Cityscapes numbers no instances of OTHER; SemanticKITTI has no SKY."""

    class Everything(Threshold):
        def segment(self, image: CameraImage) -> ImageLabels:
            mask = np.random.default_rng(3).choice(CLASSES, (6, 8))
            return ImageLabels(mask, np.full((6, 8), 255, np.uint16))

    class Sky(Threshold):
        def segment(self, scan: Scan) -> PointLabels:  # type: ignore[override]
            return PointLabels(np.full(len(scan.points), SemanticClass.SKY, np.uint8))

    made, found = (with_labels(drive_of(1), Everything(1), Sky(1), tmp_path)[0] for _ in range(2))  # type: ignore[arg-type]
    assert made == found and made.image is not None and made.image.instances is not None


def test_instances_that_cannot_be_stored_are_refused(tmp_path: Path) -> None:
    class Many(Threshold):
        def segment(self, image: CameraImage) -> ImageLabels:
            return ImageLabels(
                np.full((6, 8), SemanticClass.VEHICLE, np.uint8), np.full((6, 8), 300, np.uint16)
            )

    with pytest.raises(
        DataError, match="image stamped 0 ns: found instance 300, expected at most 255 a class"
    ):
        with_labels(drive_of(), Many(1), None, tmp_path)[0]


def test_the_cache_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "sst-graph" / "labels"
    segment_drive(with_labels(drive_of(), Threshold(100)))
    assert LabelStore(cache_folder()).only_model("images") == StoredModel(
        "above 100", Threshold(100).identity, frozenset({SemanticClass.VEHICLE})
    )
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "sst-graph" / "labels"


def test_networks_of_both_sides_label_a_drive_of_kitti(kitti_drive: Path, tmp_path: Path) -> None:
    """All its pixels are grey, so none is red; points above the sensor are vehicles."""
    images = open_image_segmenter(colour_yaml(write_colour_network(tmp_path / "i.onnx")))
    scans = open_scan_segmenter(range_yaml(write_range_network(tmp_path / "s.onnx"), "neighbours: false\n"))
    source = open_source(kitti_drive)
    drive = with_labels(source, images, scans, tmp_path / "labels")
    for frame in drive:
        assert frame.image is not None
        assert frame.scan is not None
        assert set(np.unique(frame.image.mask)) == {SemanticClass.GROUND}
        assert set(np.unique(frame.scan.classes)) <= {SemanticClass.VEHICLE, SemanticClass.GROUND}
    stored = with_labels(source, None, None, tmp_path / "labels")
    assert [a == b for a, b in zip(stored, drive, strict=True)] == [True] * 5


RUN = """
import sys, time
from pathlib import Path
from sst_graph.cli import main
from sst_graph.segmentation import image_network
segment = image_network.OnnxImageSegmenter.segment
def slowly(self, image):
    labels = segment(self, image)
    print("labelled", flush=True)
    time.sleep(0.2)
    return labels
image_network.OnnxImageSegmenter.segment = slowly
sys.exit(main(sys.argv[1:]))
"""


def test_a_run_that_is_killed_goes_on_where_it_was(kitti_drive: Path, tmp_path: Path) -> None:
    model = str(colour_yaml(write_colour_network(tmp_path / "i.onnx")))
    command = ["segment", str(kitti_drive), "--image-model", model, "--out", str(tmp_path / "labels")]
    run = subprocess.Popen(
        [sys.executable, "-c", RUN, *command], stdout=subprocess.PIPE, text=True, env={**os.environ}
    )
    assert run.stdout is not None
    for _ in range(3):
        assert run.stdout.readline() == "labelled\n"
    run.send_signal(signal.SIGKILL)
    run.wait()
    time.sleep(0.05)
    made = len(list((tmp_path / "labels").glob("images/*/*.png")))
    assert 1 <= made <= 3
    done = subprocess.run([sys.executable, "-c", RUN, *command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{5 - made} labels made, {made} found" in done.stdout
    assert len(list((tmp_path / "labels").glob("images/*/*.png"))) == 5


def test_a_run_that_ended_before_its_first_label_is_gone_on_from(tmp_path: Path) -> None:
    """A kill, or a full disk, after the folders were made and before ``model.json`` had its name."""
    place = tmp_path / "images" / "0123456789abcdef"
    place.mkdir(parents=True)
    (place / ".model.json.0123456789abcdef.sst-graph-partial").write_text("{")
    assert store_to_fill(tmp_path).folder == tmp_path
    (place / "000000.png").write_bytes(b"a picture of somebody")
    with pytest.raises(ConfigError, match="found a folder of other things"):
        store_to_fill(tmp_path)
    (place / "000000.png").unlink()
    (tmp_path / "velodyne").mkdir()
    with pytest.raises(ConfigError, match="found a folder of other things"):
        store_to_fill(tmp_path)
