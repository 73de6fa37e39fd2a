"""Networks for pictures: what they are given, and what becomes of what they give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto
from tiny_networks import PLAIN, Node, colour_yaml, write_colour_network, write_network

from sst_graph.errors import DataError
from sst_graph.segmentation import open_image_segmenter
from sst_graph.segmentation.picture_input import PictureInput, best_output
from sst_graph.types import CameraImage, SemanticClass

VEHICLE, GROUND = int(SemanticClass.VEHICLE), int(SemanticClass.GROUND)


def picture_of(size: tuple[int, int], box: tuple[int, int, int, int]) -> CameraImage:
    """Black, with a red box (left, top, right, bottom)."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    left, top, right, bottom = box
    pixels[top:bottom, left:right, 2] = 255
    return CameraImage(5, np.full(pixels.shape[:2], SemanticClass.IGNORE, np.uint8), pixels)


def expected(image: CameraImage) -> np.ndarray:
    return np.where(image.pixels[:, :, 2] > 127, VEHICLE, GROUND)


BOX = picture_of((64, 32), (8, 4, 40, 20))


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("nhwc", [False, True])
def test_a_picture_comes_back_pixel_by_pixel(tmp_path: Path, nhwc: bool, labels: bool) -> None:
    path = write_colour_network(tmp_path / "n.onnx", nhwc=nhwc, labels=labels)
    more = f"layout: {'nhwc' if nhwc else 'nchw'}\noutput: {'labels' if labels else 'logits'}\n"
    found = open_image_segmenter(colour_yaml(path, more)).segment(BOX)
    assert (found.mask == expected(BOX)).all()
    assert found.mask.dtype == np.uint8
    assert found.instances is None


def test_a_network_that_takes_bytes_has_the_pixels_as_they_are(tmp_path: Path) -> None:
    constants = {"W": np.array([[1, 0, 0], [0, 0, 0]], np.float32)[:, :, None, None]}
    constants["b"] = np.array([-127.5, 0.0], np.float32)
    nodes = [
        ("Cast", ["input"], ["floats"], {"to": TensorProto.FLOAT}),
        ("Conv", ["floats", "W", "b"], ["scores"], {"kernel_shape": [1, 1]}),
    ]
    shape, outputs = [1, 3, "h", "w"], [("scores", TensorProto.FLOAT)]
    path = write_network(tmp_path / "n.onnx", nodes, shape, outputs, constants, kind=TensorProto.UINT8)
    described = path.with_suffix(".yaml")
    as_they_are = "range: 1\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n"
    described.write_text(f"network: n.onnx\nclasses: {{0: vehicle, 1: ground}}\n{as_they_are}")
    assert (open_image_segmenter(described).segment(BOX).mask == expected(BOX)).all()


def test_labels_may_keep_a_channel_last(tmp_path: Path) -> None:
    """As an argmax over the last axis that keeps it."""
    nodes = [("ArgMax", ["input"], ["numbers"], {"axis": 3, "keepdims": 1})]
    path = write_network(tmp_path / "n.onnx", nodes, [1, "h", "w", 3], [("numbers", TensorProto.INT64)])
    found = open_image_segmenter(colour_yaml(path, "layout: nhwc\noutput: labels\n")).segment(BOX)
    assert found.mask.shape == BOX.mask.shape and (found.mask == VEHICLE)[8, 20]


def test_channels_are_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = write_colour_network(tmp_path / "n.onnx")
    blue_first = open_image_segmenter(colour_yaml(path, "channels: bgr\n"))
    assert (blue_first.segment(BOX).mask == GROUND).all()


@pytest.mark.parametrize("resize", ["stretch", "letterbox"])
@pytest.mark.parametrize(("width", "height"), [(128, 64), (64, 64), (96, 32)])
@pytest.mark.parametrize("stride", [1, 4])
def test_borders_are_not_moved_by_resizing(
    tmp_path: Path, resize: str, width: int, height: int, stride: int
) -> None:
    """Sizes and strides move a border by less than half a pixel, and by nothing on average."""
    image = picture_of((64, 32), (17, 9, 43, 23))
    path = write_colour_network(tmp_path / "n.onnx", stride)
    more = f"width: {width}\nheight: {height}\nresize: {resize}\n"
    found = open_image_segmenter(colour_yaml(path, more)).segment(image).mask == VEHICLE
    rows, columns = np.flatnonzero(found.any(axis=1)), np.flatnonzero(found.any(axis=0))
    coarse = max(1.0, stride * max(64 / width, 32 / height)) / 2.0
    edges = np.array([columns[0], columns[-1] + 1, rows[0], rows[-1] + 1]) - (17, 43, 9, 23)
    assert np.abs(edges).max() <= coarse
    assert abs(edges[0] + edges[1]) <= coarse
    assert abs(edges[2] + edges[3]) <= coarse


def test_a_letterbox_keeps_proportions_and_is_the_mean_around() -> None:
    taken = PictureInput(width=32, height=32, resize="letterbox")
    values = taken.values(np.full((10, 40, 3), 255, np.uint8))
    assert values.shape == (1, 3, 32, 32)
    inside = np.flatnonzero(np.abs(values[0, 0]).sum(axis=1))
    assert (inside[0], inside[-1]) == (12, 19)
    assert values[0, 0, 15, 0] == pytest.approx((1.0 - 0.485) / 0.229, rel=1e-6)
    assert (values[0, :, :12] == 0.0).all()


def test_the_best_output_is_that_of_all_at_once() -> None:
    logits = np.random.default_rng(1).standard_normal((7, 8, 16)).astype(np.float32)
    place = PictureInput(width=16, height=8).place(37, 21)
    all_at_once = np.stack([place.scores(one) for one in logits]).argmax(axis=0)
    assert (best_output(logits, place) == all_at_once).all()


def write_detector(path: Path, masks: np.ndarray, boxes: np.ndarray) -> Path:
    """Detections that do not depend on the picture: two cars and a person of a low score."""
    nodes: list[Node] = [
        ("ReduceMean", ["input"], ["mean"], {"keepdims": 0}),
        ("Mul", ["mean", "zero"], ["nothing"], {}),
        *(("Add", [name, "nothing"], [f"{name}_out"], {}) for name in ("scores", "masks", "boxes")),
        ("Identity", ["labels"], ["labels_out"], {}),
    ]
    outputs = [(f"{name}_out", TensorProto.FLOAT) for name in ("scores", "masks", "boxes")]
    constants = {
        "zero": np.zeros((), np.float32),
        "scores": np.array([0.7, 0.9, 0.2], np.float32),
        "labels": np.array([3, 3, 1], np.int64),
        "masks": masks.astype(np.float32),
        "boxes": boxes.astype(np.float32),
    }
    return write_network(
        path, nodes, [1, 3, 32, 64], [*outputs, ("labels_out", TensorProto.INT64)], constants
    )


DETECTOR = "classes: coco\noutput: instances\noutputs: {scores: scores_out, masks: masks_out, "
DETECTOR += "boxes: boxes_out, labels: labels_out}\n"


def test_detections_with_masks_of_the_whole_picture(tmp_path: Path) -> None:
    masks = np.zeros((3, 1, 32, 64))
    masks[0, 0, 4:12, 4:30] = 1.0
    masks[1, 0, 8:20, 20:40] = 1.0
    masks[2] = 1.0
    write_detector(tmp_path / "d.onnx", masks, np.zeros((3, 4)))
    (tmp_path / "d.yaml").write_text(f"network: d.onnx\n{PLAIN}{DETECTOR}")
    found = open_image_segmenter(tmp_path / "d.yaml").segment(BOX)
    assert found.instances is not None
    assert (found.mask[masks[0, 0] + masks[1, 0] > 0] == VEHICLE).all()
    assert (found.mask[masks[0, 0] + masks[1, 0] == 0] == SemanticClass.OTHER).all()
    assert (found.instances[8:20, 20:40] == 1).all()  # the better one has what both claim
    assert (found.instances[4:8, 4:30] == 2).all()
    assert found.instances.max() == 2


def test_detections_with_masks_of_their_boxes(tmp_path: Path) -> None:
    """As Mask R-CNN has them before they are pasted: 7 x 7 of the box, whatever its size."""
    boxes = np.array([[4, 2, 32, 30], [40, 8, 54, 22], [0, 0, 9, 9]])
    masks = np.zeros((3, 1, 7, 7))
    masks[:2, :, :, 2:] = 1.0  # all but the left 2/7
    write_detector(tmp_path / "d.onnx", masks, boxes)
    (tmp_path / "d.yaml").write_text(f"network: d.onnx\n{PLAIN}{DETECTOR}")
    found = open_image_segmenter(tmp_path / "d.yaml").segment(BOX)
    assert found.instances is not None
    for number, (left, top, right, bottom) in ((2, boxes[0]), (1, boxes[1])):
        rows, columns = np.nonzero(found.instances == number)
        assert abs(columns.min() - (left + 2 / 7 * (right - left))) <= 1.0
        assert abs(columns.max() + 1 - right) <= 2.0  # half of a mask's cell, where it falls to 0 beyond
        assert abs(rows.min() - top) <= 2.0
        assert abs(rows.max() + 1 - bottom) <= 2.0


def test_equal_networks_and_files_have_equal_identities_and_others_have_others(tmp_path: Path) -> None:
    path = write_colour_network(tmp_path / "n.onnx")
    first = open_image_segmenter(colour_yaml(path)).identity
    assert open_image_segmenter(colour_yaml(path, "# a remark\n")).identity == first
    others = [colour_yaml(path, "channels: bgr\n")]
    others = [open_image_segmenter(others[0]).identity]
    (tmp_path / "n.onnx.data").write_bytes(b"weights beside it")
    others.append(open_image_segmenter(colour_yaml(path)).identity)
    (tmp_path / "n.onnx.data").unlink()
    write_colour_network(path, stride=2)
    others.append(open_image_segmenter(colour_yaml(path)).identity)
    assert len({first, *others}) == 4


def test_an_onnx_file_is_read_by_the_yaml_file_beside_it(tmp_path: Path) -> None:
    path = write_colour_network(tmp_path / "n.onnx")
    with pytest.raises(DataError, match=r"nowhere.onnx: found no file or folder"):
        open_image_segmenter(tmp_path / "nowhere.onnx")
    with pytest.raises(DataError, match=r"n.onnx: found no n.yaml beside it"):
        open_image_segmenter(path)
    assert open_image_segmenter(colour_yaml(path)).known == open_image_segmenter(path).known


def test_a_picture_is_needed(tmp_path: Path) -> None:
    segmenter = open_image_segmenter(colour_yaml(write_colour_network(tmp_path / "n.onnx")))
    image = CameraImage(5, BOX.mask, np.zeros((0, 0, 3), np.uint8))
    with pytest.raises(DataError, match="image stamped 5 ns: found no picture"):
        segmenter.segment(image)
