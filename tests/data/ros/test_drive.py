"""A drive in a bag gives the frames, and the calibration, of the drive that it was written from."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from stored import written

pytest.importorskip("rosbags")

from bags import EPOCH_NS, IMAGE, KINDS, MASK, Kind, bag_of, files_of

from sst_graph.batch import calibrate
from sst_graph.cli import main
from sst_graph.cli.pictures import ShownFrame, overlay, telling_positions
from sst_graph.data import KittiSource, open_source
from sst_graph.data.frame_parts import RecentReader
from sst_graph.data.two_clocks import TwoClockSource
from sst_graph.drive.preparation import prepare_drive
from sst_graph.odometry.sweep import with_sweep
from sst_graph.simulator import SimulationConfig
from sst_graph.types import SemanticClass

STREET = SimulationConfig(
    seed=11,
    frames=14,
    width=414,
    height=125,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.3,
    vehicle_density=0.3,
    moving_fraction=0.0,
    time_offset_s=0.03,
    motion="no_stop",
    speed_mps=6.0,
    rolling=True,
)
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
STOP = DATA / "kitti_2011_09_26_stop"


@pytest.fixture(scope="module")
def drive() -> KittiSource:
    source = open_source(written(STREET))
    assert isinstance(source, KittiSource)
    return source


@pytest.fixture(scope="module")
def bags(drive: KittiSource, tmp_path_factory: pytest.TempPathFactory) -> dict[Kind, Path]:
    folder = tmp_path_factory.mktemp("bags")
    names: dict[Kind, str] = {"ros1": "drive.bag", "sqlite3": "sqlite3", "mcap": "mcap"}
    return {kind: bag_of(drive, folder / names[kind], kind) for kind in KINDS}


def opened(path: Path, **options: object) -> TwoClockSource:
    source = open_source(path, mask_topic=MASK, **options)  # type: ignore[arg-type]
    assert isinstance(source, TwoClockSource)
    return source


def assert_same_frames(source: TwoClockSource, drive: KittiSource) -> None:
    assert len(source) == len(drive)
    for found, true in zip(source, drive, strict=True):
        assert found.scan is not None and true.scan is not None
        assert found.image is not None and true.image is not None
        assert found.index == true.index
        assert found.scan.stamp_ns == true.scan.stamp_ns + EPOCH_NS
        assert found.image.stamp_ns == true.image.stamp_ns + EPOCH_NS
        for name in ("points", "classes", "instances", "offsets_s", "rings"):
            np.testing.assert_array_equal(getattr(found.scan, name), getattr(true.scan, name), name)
        np.testing.assert_array_equal(found.image.pixels, true.image.pixels)
        np.testing.assert_array_equal(found.image.mask, true.image.mask)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_each_kind_of_bag(kind: Kind, bags: dict[Kind, Path], drive: KittiSource) -> None:
    source = opened(bags[kind])
    assert_same_frames(source, drive)
    assert source.camera == drive.camera
    assert source.nominal is not None and source.nominal.equals(drive.nominal, 1e-9)


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_a_file_of_a_rosbag2_folder_is_opened_alone(
    suffix: str, bags: dict[Kind, Path], drive: KittiSource
) -> None:
    (file,) = files_of(bags["mcap" if suffix == ".mcap" else "sqlite3"], suffix)
    assert_same_frames(opened(file), drive)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_in_any_order_and_slices(kind: Kind, bags: dict[Kind, Path], drive: KittiSource) -> None:
    source = opened(bags[kind])
    for position in (9, 2, 13, 0, 12, 2, 3):
        scan, true = source.read_scan(position), drive.read_scan(position)
        assert scan is not None and true is not None
        np.testing.assert_array_equal(scan.points, true.points)
        image, picture = source.read_image(position), drive.read_image(position)
        assert image is not None and picture is not None
        np.testing.assert_array_equal(image.pixels, picture.pixels)
    part, again = source[4:7], opened(bags[kind], frames="4:7")
    assert [frame.index for frame in part] == [frame.index for frame in again] == [4, 5, 6]
    assert part[0] == again[0] == source[4] and part[1:][0] == source[5]
    with pytest.raises(IndexError):
        part[3]
    assert pickle.loads(pickle.dumps(part))[2] == source[6]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_calibration_from_the_bag_is_that_of_the_drive(
    kind: Kind, bags: dict[Kind, Path], drive: KittiSource
) -> None:
    source = opened(bags[kind])
    from_bag, from_drive = (calibrate(one, one.nominal) for one in (source, drive))
    difference = from_bag.T_camera_lidar.localCoordinates(from_drive.T_camera_lidar)
    assert float(np.abs(difference).max()) < 1e-6
    assert abs(from_bag.time_offset_s - from_drive.time_offset_s) < 1e-6
    np.testing.assert_allclose(from_bag.covariance, from_drive.covariance, rtol=1e-3)


@pytest.mark.slow
def test_the_result_names_the_topic_of_its_images(
    bags: dict[Kind, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, result = str(bags["mcap"]), str(tmp_path / "result")
    command = ["calibrate", bag, "--mask-topic", MASK, "--sweep", "compensated", "--out", result]
    assert main(command) in (0, 3)
    assert "p_camera = T_camera_lidar . p_lidar" in capsys.readouterr().out
    assert f"<h1>Calibration of {IMAGE} from mcap</h1>" in (tmp_path / "result/report.html").read_text()

    yaml = pytest.importorskip("yaml")
    assert main(["export", result, "--to", "kalibr", "--force"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["cam0"]["rostopic"] == IMAGE
    # The topic holds for the drive when it is read again.
    assert main(["overlay", result, bag, "--image-topic", "/rear/image_rect"]) == 2
    assert f"was made with --image-topic {IMAGE}" in capsys.readouterr().err


@pytest.mark.slow
def test_images_stamped_later_change_the_time_offset_alone(drive: KittiSource, tmp_path: Path) -> None:
    source = opened(bag_of(drive, tmp_path / "later", image_later_ns=40_000_000))
    assert len(source) == 2 * len(drive)
    assert [frame.scan is None for frame in source] == [False, True] * len(drive)
    from_bag, from_drive = (calibrate(one, one.nominal) for one in (source, drive))
    difference = from_bag.T_camera_lidar.localCoordinates(from_drive.T_camera_lidar)
    sigmas = np.sqrt(np.diag(from_drive.covariance))
    assert (np.abs(difference) < 0.5 * sigmas[:6]).all()
    assert abs(from_bag.time_offset_s + 0.04 - from_drive.time_offset_s) < 0.5 * sigmas[6]
    # Pictures show a scan with the image of its instant, though no frame holds both.
    reader = RecentReader(source)
    (position,) = telling_positions(reader, from_bag, 1)
    assert position not in source.image_positions
    shown = ShownFrame.of(reader, position, from_bag)
    assert overlay(shown, from_bag, None).picture.shape[2] == 3


def test_without_masks_nothing_is_labelled_and_motion_is_estimated(
    drive: KittiSource, bags: dict[Kind, Path]
) -> None:
    source = open_source(bags["mcap"], image_topic="/front/image_rect")
    frame = source[3]
    assert frame.scan is not None and frame.image is not None
    assert not frame.scan.has_labels and not frame.image.has_mask
    assert (frame.image.mask == SemanticClass.IGNORE).all()
    prepared = prepare_drive(source, [SemanticClass.VEHICLE])
    truth = prepare_drive(drive, [SemanticClass.VEHICLE])
    assert len(prepared.lidar_motions) == len(truth.lidar_motions) == len(drive) - 1
    for found, true in zip(prepared.lidar_motions, truth.lidar_motions, strict=True):
        # Odometry of labelled scans leaves vehicles that may move out.
        assert found.aTb.equals(true.aTb, 0.02)


@pytest.mark.slow
def test_the_sweep_is_decided_by_scans_between_images(tmp_path: Path) -> None:
    street = written(
        SimulationConfig(
            seed=5, frames=26, width=128, height=64, azimuth_step_deg=0.4, rolling=True,
            sweep_output="raw", motion="no_stop", moving_fraction=0.0,
        )
    )  # fmt: skip
    drive = open_source(street)
    assert isinstance(drive, KittiSource)
    source = opened(bag_of(drive, tmp_path / "bag", image_later_ns=40_000_000))
    found, true = with_sweep(source).sweep_decision, with_sweep(drive).sweep_decision
    assert found.kind == true.kind == "clockwise"
    assert found.timing == true.timing
    assert set(found.frames) <= set(source.scan_positions)
