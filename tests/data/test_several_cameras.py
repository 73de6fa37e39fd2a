"""Layouts with several cameras: each is opened by name, the scans are the same."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from bags import CLOUD, EPOCH_NS, writing
from tiny_networks import colour_yaml, write_colour_network

from sst_graph import open_source
from sst_graph.cli import main
from sst_graph.data.images import read_mask
from sst_graph.data.kitti.odometry import KittiSource
from sst_graph.errors import ConfigError, DataError
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.simulator.write import right_camera

SMALL = SimulationConfig(
    seed=4, frames=3, width=128, height=64, azimuth_limit_deg=30.0, azimuth_step_deg=1.0, vehicle_density=0.3
)


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stereo drive in KITTI's layout."""
    return write_drive(simulate(SMALL), tmp_path_factory.mktemp("stereo") / "street", stereo=True)


def _kitti(stereo: Path, camera: str) -> KittiSource:
    source = open_source(stereo, camera=camera)
    assert isinstance(source, KittiSource)
    return source


def test_the_right_camera_of_a_simulated_drive(stereo: Path) -> None:
    """Its picture, mask, nominal pose and truth are those of the simulated right camera."""
    left, right = _kitti(stereo, "image_2"), _kitti(stereo, "image_3")
    simulated = right_camera(simulate(SMALL))
    assert right.nominal.equals(simulated.nominal, 1e-9)
    assert right.truth.cTl.equals(simulated.truth.cTl, 1e-9)
    image = right.read_image(1)
    assert image is not None
    expected = simulated.image(1)
    np.testing.assert_array_equal(image.pixels, expected.pixels)
    assert (image.mask == expected.mask).mean() > 0.9  # Cityscapes has fewer kinds of things
    baseline = right.nominal * left.nominal.inverse()
    np.testing.assert_allclose(baseline.translation(), [-0.5330, 0.0025, 0.0], atol=5e-4)
    other = left.read_image(1)
    assert other is not None and not np.array_equal(other.pixels, image.pixels)


def test_folders(stereo: Path, tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    (folder / "clouds").mkdir(parents=True)
    for k in range(3):
        scan = np.fromfile(stereo / f"velodyne/{k:06d}.bin", "<f4")
        scan.tofile(folder / f"clouds/{k + 1}.000000000.bin")
    for name, number in (("left", 2), ("right", 3)):
        source = _kitti(stereo, f"image_{number}")
        for kind in ("images", "masks"):
            (folder / name / kind).mkdir(parents=True)
        for k in range(3):
            picture = (stereo / f"image_{number}/{k:06d}.png").read_bytes()
            (folder / name / f"images/{k + 1}.050000000.png").write_bytes(picture)
            mask = (stereo / f"semantic_{number}/{k:06d}.png").read_bytes()
            (folder / name / f"masks/{k + 1}.050000000.png").write_bytes(mask)
        K = source.camera
        (folder / name / "camera.yaml").write_text(
            f"fx: {K.fx}\nfy: {K.fy}\ncx: {K.cx}\ncy: {K.cy}\nwidth: {K.width}\nheight: {K.height}\n"
        )
        rows = json.dumps(source.nominal.matrix().tolist())
        (folder / name / "extrinsic.yaml").write_text(f"T_camera_lidar: {rows}\n")
    left, right = (open_source(folder, camera=name) for name in ("left", "right"))
    assert len(left) == len(right) == 6
    for source, number in ((left, 2), (right, 3)):
        wanted = _kitti(stereo, f"image_{number}")
        assert source.nominal is not None and source.nominal.equals(wanted.nominal, 1e-9)
        found, expected = source[3].image, wanted.read_image(1)
        assert found is not None and expected is not None
        np.testing.assert_array_equal(found.mask, expected.mask)
    with pytest.raises(ConfigError, match="cameras left, right: none is 'rear'"):
        open_source(folder, camera="rear")
    with pytest.raises(ConfigError, match="cameras left, right: none is named"):
        open_source(folder)


@pytest.fixture(scope="module")
def bag(stereo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras, each with images, masks and camera_info in a namespace of its own."""
    path = tmp_path_factory.mktemp("bag") / "rig"
    with writing(path, "mcap") as bag:
        make = bag.messages
        identity = gtsam.Pose3()
        bag.add(
            "/tf_static",
            make.transforms({("base", "front_optical"): identity, ("base", "lidar"): identity}),
            EPOCH_NS,
        )
        for name, number in (("cam0", 2), ("cam1", 3)):
            source = _kitti(stereo, f"image_{number}")
            bag.add(f"/{name}/camera_info", make.info(source.camera), EPOCH_NS)
            for k in range(3):
                image = source.read_image(k)
                assert image is not None
                stamp_ns = EPOCH_NS + image.stamp_ns
                bag.add(f"/{name}/image_raw", make.image(stamp_ns, image.pixels), stamp_ns)
                mask = read_mask(source.files.masks[k])
                bag.add(f"/{name}/mask", make.image(stamp_ns, mask, "mono8"), stamp_ns)
        for k in range(3):
            points = np.fromfile(stereo / f"velodyne/{k:06d}.bin", "<f4").reshape(-1, 4)
            table = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u2")])
            for axis, values in zip("xyz", points.T, strict=False):
                table[axis] = values
            table["label"] = np.fromfile(stereo / f"labels/{k:06d}.label", "<u4") & 0xFFFF
            stamp_ns = EPOCH_NS + int(_kitti(stereo, "image_2").stamps_ns[k])
            bag.add(CLOUD, make.cloud(stamp_ns, table), stamp_ns)
    return path


@pytest.mark.parametrize("form", ["/{}/image_raw", "{}", "/{}"])
def test_bags(stereo: Path, bag: Path, form: str) -> None:
    """By the topic of the images or by its namespace; masks and model stand beside them."""
    for name, number in (("cam0", 2), ("cam1", 3)):
        source = open_source(bag, camera=form.format(name), mask_topic="mask")
        wanted = _kitti(stereo, f"image_{number}")
        assert source.camera == wanted.camera
        image, expected = source[1].image, wanted.read_image(1)
        assert image is not None and expected is not None
        np.testing.assert_array_equal(image.pixels, expected.pixels)
        np.testing.assert_array_equal(image.mask, expected.mask)
        scan = source[1].scan
        assert scan is not None and scan.has_labels


def test_cameras_that_a_bag_has_not(bag: Path) -> None:
    with pytest.raises(DataError, match=r"no message of cam7 \(--camera\); there are .*/cam0/image_raw"):
        open_source(bag, camera="cam7", mask_topic="mask")
    with pytest.raises(DataError, match=r"several topics of .*/cam0/image_raw .*/cam0/mask .*--camera"):
        open_source(bag, camera="cam0", mask_topic="masks")
    with pytest.raises(DataError, match=r"several topics .* expected one, named by --image-topic; several"):
        open_source(bag, mask_topic="mask")
    with pytest.raises(DataError, match=r"named by --image-topic; of masks by --mask-topic /cam\d/mask$"):
        open_source(bag)


def test_commands_on_the_drive_alone_take_several_cameras(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [str(bag), "--mask-topic", "mask"]
    assert main(["info", "--camera", "cam0", "cam1", *options]) == 0
    text = capsys.readouterr().out
    assert [line.split()[3] for line in text.splitlines() if line.startswith("images")] == [
        "/cam0/image_raw",
        "/cam1/image_raw",
    ]
    assert main(["info", *options, "--camera", "cam0", "cam1", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == ["cam0", "cam1"]
    network = colour_yaml(write_colour_network(tmp_path / "n.onnx"))
    labels = ["--image-model", str(network), "--out", str(tmp_path / "labels")]
    assert main(["segment", *options, *labels, "--camera", "cam0", "cam1"]) == 0
    assert "cam1: 3 labels made, 0 found" in capsys.readouterr().out
    assert main(["info", str(bag), *options, "--camera", "cam0"]) == 2
    assert "info: found 2 DATA, expected one" in capsys.readouterr().err


def test_cameras_that_kitti_has_not(stereo: Path) -> None:
    with pytest.raises(ConfigError, match=r"camera 'image_0': .* has image_2, image_3"):
        open_source(stereo, camera="image_0")


def test_the_same_span_of_a_drive_whose_cameras_have_other_rates(bag: Path) -> None:
    """Frames are counted in the order of stamps; a span of time is the same for every camera."""
    whole = open_source(bag, camera="cam0", mask_topic="mask")
    part = whole[0:1]  # type: ignore[index]
    assert part.span_ns[0] == part.span_ns[1]
    other = open_source(bag, camera="cam1", mask_topic="mask")
    cut = other.within(part.span_ns)  # type: ignore[attr-defined]
    assert (cut.start, cut.stop) == (0, 1)
    assert other.within(whole.span_ns) == slice(0, len(other))  # type: ignore[attr-defined]
    assert other.within((0, 1)) == slice(0, 0)  # type: ignore[attr-defined]
