"""KITTI raw, folders and nuScenes: what each lays down besides frames, and one line for what is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from layouts import EPOCH_NS, as_folder, as_kitti_raw, as_nuscenes, raw_stamp, write_raw_calibration

from sst_graph.cameras import BrownConradyCamera
from sst_graph.cameras.fisheye import FisheyeCamera
from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.data.folder.camera_file import read_camera
from sst_graph.data.folder.stamps import stamped_files
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.sweep_timing import SweepTiming

Change = Callable[[Path], None]


@pytest.fixture
def raw(kitti_drive: Path, tmp_path: Path) -> Path:
    return as_kitti_raw(kitti_drive, tmp_path / "raw")


@pytest.fixture
def folder(kitti_drive: Path, tmp_path: Path) -> Path:
    return as_folder(kitti_drive, tmp_path / "street")


@pytest.fixture
def nuscenes(kitti_drive: Path, tmp_path: Path) -> Path:
    return as_nuscenes(kitti_drive, tmp_path / "nuscenes")


def test_raw_sweeps_give_times_by_their_own_start_and_end(raw: Path) -> None:
    starts = [raw_stamp(EPOCH_NS + 10**8 * k - 40_000_000) for k in range(5)]
    ends = [raw_stamp(EPOCH_NS + 10**8 * k + 62_000_000) for k in range(5)]
    stamps = [raw_stamp(EPOCH_NS + 10**8 * k) for k in range(5)]
    for name, lines in (("_start", starts), ("_end", ends), ("", stamps)):
        (raw / f"velodyne_points/timestamps{name}.txt").write_text("\n".join(lines) + "\n")
    scans = [frame.scan for frame in open_source(raw, sweep="clockwise") if frame.scan is not None]
    turn = SweepTiming(-1.0, np.pi, 0.102, "start")
    for scan in scans:
        np.testing.assert_allclose(scan.offsets_s, turn.offsets_s(scan.points) - 0.04, atol=1e-7)
    assert all(frame.scan is None or frame.scan.offsets_s is None for frame in open_source(raw))


def test_raw_drops_and_other_counts(raw: Path) -> None:
    (raw / "velodyne_points/data/0000000002.bin").unlink()
    lines = [raw_stamp(EPOCH_NS + 30_000_000 * k) for k in range(7)]
    (raw / "image_02/timestamps.txt").write_text("\n".join(lines) + "\n")
    (raw / "image_02/data/0000000004.png").rename(raw / "image_02/data/0000000006.png")
    source = open_source(raw)
    scans = [frame.scan.stamp_ns - EPOCH_NS for frame in source if frame.scan is not None]
    images = [frame.image.stamp_ns - EPOCH_NS for frame in source if frame.image is not None]
    assert scans == [0, 100_000_000, 310_000_000, 410_000_000]
    assert images[:4] == [0, 30_000_000, 60_000_000, 90_000_000] and images[-1] == 180_000_000


def test_raw_clouds_in_text(raw: Path) -> None:
    binary = raw / "velodyne_points/data/0000000001.bin"
    values = np.fromfile(binary, "<f4").reshape(-1, 4)
    binary.unlink()
    np.savetxt(binary.with_suffix(".txt"), values, fmt="%.9g")
    scan = open_source(raw)[1].scan
    assert scan is not None
    np.testing.assert_array_equal(scan.points, values[:, :3])


def test_raw_pictures_as_recorded_of_a_lens_without_distortion(raw: Path) -> None:
    P2 = np.array([[700.0, 0, 4, 35], [0, 700, 3, 0], [0, 0, 1, 0]])
    c0Tl = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    sizes = {"S_02": "8 6", "S_rect_02": "9 9"}
    turn = gtsam.Rot3.RzRyRx(0.01, 0.02, 0.03)
    R = " ".join(f"{value:.15e}" for value in turn.matrix().ravel())
    write_raw_calibration(
        raw.parent, P2, c0Tl, (8, 6), **sizes, D_02="0 0 0 0 0", R_02=R, R_rect_00="1 0 0 0 1 0 0 0 1"
    )
    source = open_source(raw)
    velo = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.004, -0.007, 0.009).inverse(), np.zeros(3)) * c0Tl
    assert source.nominal is not None
    assert source.nominal.equals(gtsam.Pose3(turn, np.array([0.05, 0.0, 0.0])) * velo, 1e-12)


def write(name: str, content: str | bytes) -> Change:
    data = content.encode() if isinstance(content, str) else content
    return lambda path: (path / name).write_bytes(data) and None


def remove(name: str) -> Change:
    return lambda path: (path / name).unlink()


def edit(name: str, old: str, new: str, count: int = 1) -> Change:
    def change(path: Path) -> None:
        text = (path / name).read_text()
        assert old in text
        (path / name).write_text(text.replace(old, new, count))

    return change


BROKEN: list[tuple[str, Change, str]] = [
    ("raw", remove("../calib_velo_to_cam.txt"), "calib_velo_to_cam.txt: found no such file"),
    ("raw", edit("../calib_cam_to_cam.txt", "P_rect_02", "P_rect_09"), "no line P_rect_02"),
    ("raw", edit("../calib_cam_to_cam.txt", "S_rect_02: ", "S_rect_02: 1"), "pictures of 8x6 px"),
    ("raw", edit("../calib_velo_to_cam.txt", "R: ", "R: 1 "), "10 values for R"),
    ("raw", edit("../calib_velo_to_cam.txt", "R: ", "R: nan "), "in R, expected finite numbers"),
    ("raw", edit("image_02/timestamps.txt", "2011-09-26", "26.09.2011"), "expected a stamp as 2011-09-26"),
    (
        "raw",
        edit("image_02/timestamps.txt", "2011-09-26", "9999-09-26"),
        "timestamps.txt:1: found a stamp of",
    ),
    (
        "raw",
        edit("image_02/timestamps.txt", "2011-09-26", "2117-09-26"),
        "timestamps.txt:1: found a stamp of",
    ),
    (
        "raw",
        write("image_02/timestamps.txt", "2011-09-26 13:02:25.9\n"),
        "1 stamp for 5 images, expected 5, one for each number from 0: none for 4 images, ",
    ),
    ("raw", write("velodyne_points/timestamps_end.txt", "2011-09-26 13:02:25.9\n"), "1 stamp, expected 5"),
    ("raw", edit("velodyne_points/timestamps.txt", "13:02:25", "14:02:25"), "falling stamps 0 and 1"),
    ("raw", remove("velodyne_points/timestamps.txt"), "timestamps.txt: found no such file"),
    ("folder", remove("camera.yaml"), "camera.yaml: found no such file"),
    ("folder", edit("camera.yaml", "fx: 700.0", "fx: .nan"), r"\(fx\): found nan"),
    ("folder", edit("camera.yaml", "fx: 700.0", "fx: [700"), "no YAML"),
    ("folder", edit("camera.yaml", "height: 6\n", ""), "no height"),
    ("folder", edit("camera.yaml", "height: 6\n", "height: 6\nfx: 9\n"), "'fx' twice in one table"),
    ("raw", edit("../calib_velo_to_cam.txt", "T: ", "T: 1 2 3\nT: "), "found another T than above"),
    (
        "folder",
        write(
            "extrinsic.yaml", f"T_camera_lidar: {[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}\ntranslation: [0]\n"
        ),
        "found two poses",
    ),
    ("folder", write("extrinsic.yaml", "T_lidar_camera: [1]\n"), "expected T_camera_lidar, or translation"),
    ("folder", edit("camera.yaml", "fx: 700.0", "a: &a 1\nfx: *a"), "an alias"),
    ("folder", write("camera.yaml", "- 1\n"), "a YAML list"),
    ("folder", write("camera.yaml", "a: !!python/object:os.system {}\n"), "no YAML"),
    ("folder", write("extrinsic.yaml", "translation: [0, 0, 0]\n"), "no quaternion"),
    ("folder", write("extrinsic.yaml", "T_camera_lidar: [1, 2]\n"), "2 numbers, expected 16"),
    ("folder", write("images/first.png", b""), "the name 'first', expected a stamp"),
    ("folder", write("images.csv", "a.png,100\n"), "'a.png', expected the name of a file in images"),
    ("folder", write("images.csv", "name,stamp_ns\n"), "no stamp"),
    ("folder", write("images.csv", "0.png,1e9\n"), "'0.png,1e9', expected name,stamp or stamp,name"),
    ("folder", write("clouds/0.000000001.bin", bytes(3)), "3 bytes, expected a multiple of 16"),
    ("nuscenes", write("v1.0-mini/sample.json", "[{"), "no whole record after 0"),
    ("nuscenes", write("v1.0-mini/scene.json", "{}"), "expected a table of nuScenes"),
    ("nuscenes", remove("v1.0-mini/calibrated_sensor.json"), "no such file"),
    (
        "nuscenes",
        edit("v1.0-mini/sample_data.json", "samples/CAM_FRONT/", "../samples/"),
        "below the data set",
    ),
    (
        "nuscenes",
        edit("v1.0-mini/calibrated_sensor.json", '"camera_intrinsic": [\n[', '"camera_intrinsic": [\n[1,'),
        "camera_intrinsic",
    ),
    ("nuscenes", edit("v1.0-mini/sample_data.json", '"timestamp": 1', '"timestamp": -1', -1), "timestamp"),
]


@pytest.mark.parametrize(("layout", "change", "found"), BROKEN)
def test_a_broken_drive_is_one_line(
    request: pytest.FixtureRequest, layout: str, change: Change, found: str
) -> None:
    path: Path = request.getfixturevalue(layout)
    change(path)
    with pytest.raises(DataError, match=found) as raised:
        list(open_source(path, sequence="61" if layout == "nuscenes" else None))
    assert str(raised.value).isprintable()


def test_a_broken_drive_ends_a_command_with_2(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "camera.yaml").unlink()
    assert main(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "camera.yaml: found no such file" in lines[0]


@pytest.mark.parametrize(
    ("layout", "options", "found"),
    [
        ("raw", {"sequence": "0007"}, "is itself the folder of a drive"),
        ("raw", {"camera": "left"}, "expected image_0N"),
        ("folder", {"sequence": "0"}, "images and clouds only"),
        ("folder", {"camera": "left"}, "cameras images: none is .left."),
        ("nuscenes", {}, "2 scenes .scene-0061, scene-0103.: name one of them .--sequence."),
        ("nuscenes", {"sequence": "7"}, "none is '7'"),
        ("nuscenes", {"sequence": "61", "camera": "CAM_LEFT"}, "has CAM_BACK, CAM_FRONT .--camera."),
        ("nuscenes", {"sequence": "61", "cloud": "LIDAR_LEFT"}, "has LIDAR_TOP .--cloud."),
    ],
)
def test_options_that_a_layout_has_not(
    request: pytest.FixtureRequest, layout: str, options: dict[str, str], found: str
) -> None:
    with pytest.raises(ConfigError, match=found):
        open_source(request.getfixturevalue(layout), **options)  # type: ignore[arg-type]


# --- folders ----------------------------------------------------------------------------------------------

CAMERAS = {
    "kalibr": "cam0:\n  camera_model: pinhole\n  intrinsics: [700, 701, 4, 3]\n  distortion_model: radtan\n"
    "  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [8, 6]\n",
    "opencv": "%YAML:1.0\n---\nimage_width: 8\nimage_height: 6\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
    "   cols: 3\n   dt: d\n   data: [ 700., 0., 4., 0., 701., 3., 0., 0., 1. ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
    "   data: [ 0., 0., 0., 0. ]\n",
    "script": "resolution: [8, 6]\nmtx: [[700, 0, 4], [0, 701, 3], [0, 0, 1]]\ndist_coeffs: [0, 0, 0, 0]\n",
    "camera_info": "header: {frame_id: camera}\nheight: 6\nwidth: 8\ndistortion_model: plumb_bob\n"
    "d: [0, 0, 0, 0]\nk: [700, 0, 4, 0, 701, 3, 0, 0, 1]\nbinning_x: 0\nroi: {width: 0}\n---\n",
    "camera_info of all the sensor": "height: 6\nwidth: 8\ndistortion_model: plumb_bob\nd: [0, 0, 0, 0]\n"
    "k: [700, 0, 4, 0, 701, 3, 0, 0, 1]\nroi: {x_offset: 0, y_offset: 0, height: 6, width: 8}\n",
    "plain": "fx: 700\nfy: 7.01e2\ncx: 4\ncy: 3\nwidth: 8\nheight: 6\n",
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_cameras_of_other_tools(folder: Path, kind: str) -> None:
    (folder / "camera.yaml").write_text(CAMERAS[kind])
    camera = open_source(folder).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (700.0, 701.0, 4.0, 3.0)
    assert (camera.width, camera.height) == (8, 6)
    (folder / "camera.yaml").write_text(CAMERAS[kind].replace("0, 0, 0, 0]", "-0.3, 0, 0, 0]"))
    if kind == "opencv":
        (folder / "camera.yaml").write_text(CAMERAS[kind].replace("0., 0., 0., 0. ]", "-0.3, 0., 0., 0. ]"))
    if kind != "plain":
        # Rectified as it is read: with so few pixels there is no pinhole to rectify to.
        assert read_camera(folder / "camera.yaml") == BrownConradyCamera(camera, (-0.3, 0.0, 0.0, 0.0))
        with pytest.raises(DataError, match=r"camera \(plumb_bob\): found a field of 8x6 px"):
            open_source(folder)


ORB_SLAM = "%YAML:1.0\nCamera{}.fx: 700\nCamera{}.fy: 701\nCamera{}.cx: 4\nCamera{}.cy: 3\n"
ORB_SIZE = "Camera.width: 8\nCamera.height: 6\nORBextractor.nFeatures: 2000\nThDepth: 40\n"
VINS = "projection_parameters: {fx: 700, fy: 701, cx: 4, cy: 3}\nimage_width: 8\nimage_height: 6\n"
VINS_FISHEYE = "projection_parameters: {mu: 700, mv: 701, u0: 4, v0: 3, k2: 0.1, k3: 0.2, k4: 0.3, k5: 0.4}\n"
LIVO = "cam_fx: 700\ncam_fy: 701\ncam_cx: 4\ncam_cy: 3\ncam_width: 8\ncam_height: 6\nscale: 0.5\n"
LENS, FISHEYE = (-0.3, 0.1, 0.01, 0.02, 0.0), (0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ORB_SLAM.format(*[""] * 4) + ORB_SIZE, None),
        (
            f"{ORB_SLAM.format(*[''] * 4)}{ORB_SIZE}Camera.k1: -0.3\nCamera.k2: 0.1\nCamera.p1: 0.01\n"
            "Camera.p2: 0.02\nCamera.fps: 10\nCamera.bf: 40.0\n",
            LENS,
        ),
        (
            f"{ORB_SLAM.format(*'1111')}{ORB_SIZE}Camera.type: KannalaBrandt8\nCamera1.k1: 0.1\n"
            "Camera1.k2: 0.2\nCamera1.k3: 0.3\nCamera1.k4: 0.4\nCamera2.fx: 1\n",
            FISHEYE,
        ),
        (
            f"{VINS}model_type: PINHOLE\ndistortion_parameters: {{k1: -0.3, k2: 0.1, p1: 0.01, p2: 0.02}}\n",
            LENS,
        ),
        (f"{VINS_FISHEYE}model_type: KANNALA_BRANDT\nimage_width: 8\nimage_height: 6\n", FISHEYE),
        (f"{LIVO}cam_model: Pinhole\ncam_d0: -0.3\ncam_d1: 0.1\ncam_d2: 0.01\ncam_d3: 0.02\n", LENS),
        (f"{LIVO}cam_model: EquidistantCamera\nk1: 0.1\nk2: 0.2\nk3: 0.3\nk4: 0.4\n", FISHEYE),
    ],
)
def test_cameras_of_slam_systems(tmp_path: Path, text: str, expected: tuple[float, ...] | None) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    camera, intrinsics = read_camera(tmp_path / "camera.yaml"), PinholeCamera(700.0, 701.0, 4.0, 3.0, 8, 6)
    if expected == FISHEYE:
        assert camera == FisheyeCamera(intrinsics, FISHEYE)
    else:
        assert camera == BrownConradyCamera(intrinsics, expected or ())


K = "K: [700, 0, 4, 0, 701, 3, 0, 0, 1]\nwidth: 8\nheight: 6\n"
CHAIN = "intrinsics: [700, 701, 4, 3]\nresolution: [8, 6]\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (f"{K}distorsion: [-0.3, 0, 0, 0]\n", "the key 'distorsion', expected of the lens distortion_coef"),
        (f"{K}radial_distortion: [-0.3, 0.1]\n", "the key 'radial_distortion'"),
        (f"{K}coeffs: [-0.3, 0.1, 0, 0]\n", "the key 'coeffs'"),
        (f"{K}k1: -0.3\nk2: 0.1\n", "the key 'k1'"),
        (f"{K}k1: -3e-1\n", "the key 'k1'"),  # text by YAML 1.1
        (f"{K}D: [-0.3, 0, 0, 0]\ndist_coeffs: [0, 0, 0, 0]\n", "'dist_coeffs' beside another entry"),
        (f"{CHAIN}distortion: [-0.3, 0.1, 0, 0]\n", "the key 'distortion', expected of the lens"),
        (f"{CHAIN}distortion_model: radtan\n", "the distortion 'radtan' without coefficients"),
        (f"{CHAIN}distortion_model: [radtan]\n", "the distortion '.*radtan.*' without coefficients"),
        (f"{K}binning_x: 2\n", "binning"),
        (f"{K}roi: {{x_offset: 0, y_offset: 0, height: 3, width: 8}}\n", "region of interest"),
        (f"{K}binning_x: x\n", "binning_x: 'x', expected a whole number"),
        (f"{K}binning_x: .nan\n", "binning_x: nan, expected a whole number"),
        (f"{K}roi: {{x_offset: null}}\n", "x_offset: None, expected a whole number"),
        (f"{K}fisheye_model: perhaps\n", "fisheye_model: 'perhaps', expected a whole number"),
        (ORB_SLAM.format(*[""] * 4), "no width, expected fx, fy, cx, cy, width, height of the camera"),
        (f"{ORB_SLAM.format(*[''] * 4)}{ORB_SIZE}Camera.k4: 0.1\n", "the key 'k4', expected of the lens k1"),
        (
            f"{ORB_SLAM.format(*[''] * 4)}{ORB_SIZE}Camera.type: Fancy\n",
            "camera model 'Fancy', expected one of",
        ),
        (f"{ORB_SLAM.format(*[''] * 4)}{ORB_SIZE}Camera.k1: x\n", r"\(k1\): found 'x'"),
        (f"{VINS}model_type: MEI\n", "camera model 'MEI', expected one of pinhole, kannalabrandt"),
        (f"{VINS}model_type: PINHOLE\ndistortion_parameters: 3\n", "distortion_parameters 3"),
        (f"{LIVO}cam_model: ATAN\ncam_d0: 0.9\n", "camera model 'ATAN'"),
        (f"{LIVO}cam_model: Pinhole\nk1: 0.1\n", "the key 'k1', expected of the lens cam_d0"),
    ],
)
def test_a_lens_that_is_not_understood_does_not_pass_for_none(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(DataError, match=found):
        read_camera(tmp_path / "camera.yaml")


def test_a_chain_with_the_names_of_euroc_and_a_fisheye_by_a_script(tmp_path: Path) -> None:
    file, D = tmp_path / "camera.yaml", "[-0.3, 0.1, 0.0, 0.0]"
    lines = f"{CHAIN}distortion_model: radtan\ndistortion_coefficients: {D}\n"
    file.write_text("cam0:\n" + "".join(f"  {line}\n" for line in lines.splitlines()))
    model = read_camera(file)
    assert isinstance(model, BrownConradyCamera) and model.coefficients[:2] == (-0.3, 0.1)
    file.write_text(f"{K}D: {D}\nfisheye: true\nP1: [[700, 0, 4, 0], [0, 700, 3, 0], [0, 0, 1, 0]]\n")
    assert isinstance(read_camera(file), FisheyeCamera)


def test_a_camera_is_found_in_a_chain_by_its_name_or_topic(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    one = "{{intrinsics: [{}, 30, 16, 12], resolution: [32, 24], rostopic: {}}}\n"
    file.write_text(
        "cam0: " + one.format(30, "/left/image_raw") + "cam1: " + one.format(31, "/right/image_raw")
    )
    for name, fx in {
        "": 30.0,
        "cam1": 31.0,
        "/right/image_raw": 31.0,
        "/right/image_raw/compressed": 31.0,
        "/right/image_mono": 31.0,
        "left": 30.0,
    }.items():
        assert read_camera(file, name).intrinsics.fx == fx, name
    with pytest.raises(DataError, match=r"cameras cam0 \(/left/image_raw\), .*, expected one of .* front"):
        read_camera(file, "front")
    unnamed = "{intrinsics: [30, 30, 16, 12], resolution: [32, 24]}\n"
    file.write_text("cam1: " + one.format(31, "/right/image_raw") + "cam2: " + unnamed)
    with pytest.raises(DataError, match="expected one of the name or rostopic cam0"):
        read_camera(file)
    file.write_text("cam1: " + one.format(31, "/right/image_raw"))
    assert read_camera(file).intrinsics.fx == read_camera(file, "front").intrinsics.fx == 31.0


def test_an_extrinsic_as_translation_and_quaternion(folder: Path) -> None:
    (folder / "extrinsic.yaml").write_text("translation: [1, 2, 3]\nquaternion: [0.5, -0.5, 0.5, -0.5]\n")
    nominal = open_source(folder).nominal
    assert nominal is not None
    assert nominal.equals(
        gtsam.Pose3(gtsam.Rot3.Quaternion(0.5, -0.5, 0.5, -0.5), np.array([1.0, 2, 3])), 1e-12
    )
    (folder / "extrinsic.yaml").unlink()
    assert open_source(folder).nominal is None


@pytest.mark.parametrize("channel", ["LIDAR_TOP", "LIDAR_LEFT"])
def test_the_lidars_of_a_nuscenes_tree(nuscenes: Path, channel: str) -> None:
    """The only one is taken, whatever its name; of two the usual one, or the one that is named."""
    table = nuscenes / "v1.0-mini/sensor.json"
    sensors = json.loads(table.read_text().replace("LIDAR_TOP", channel))
    table.write_text(json.dumps(sensors))
    count = sum(frame.scan is not None for frame in open_source(nuscenes, sequence="61"))
    assert count == 5
    sensors.append({"token": "s-2", "channel": "LIDAR_REAR", "modality": "lidar"})
    table.write_text(json.dumps(sensors))
    named = open_source(nuscenes, sequence="61", cloud=channel)
    assert sum(frame.scan is not None for frame in named) == count
    with pytest.raises(DataError, match="0 calibrations of LIDAR_REAR in the scene"):
        open_source(nuscenes, sequence="61", cloud="LIDAR_REAR")
    if channel != "LIDAR_TOP":
        with pytest.raises(ConfigError, match=r"no lidar is named: .* has LIDAR_LEFT, LIDAR_REAR .--cloud."):
            open_source(nuscenes, sequence="61")


def test_stamps_in_a_table_and_files_that_are_not_in_it(folder: Path) -> None:
    names = sorted(path.name for path in (folder / "images").iterdir())[:3]
    lines = [f"{name},{7_000_000 + 50_000_000 * k}" for k, name in enumerate(names)]
    (folder / "images.csv").write_text("\n".join(["name,stamp_ns", *lines]) + "\n")
    stamps = [frame.image.stamp_ns for frame in open_source(folder) if frame.image is not None]
    assert stamps == [7_000_000, 57_000_000, 107_000_000]


def test_lines_whose_files_are_missing_are_left_out_and_counted(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = sorted(path.name for path in (folder / "images").iterdir())[:3]
    rows = [(f"cam0/{Path(name).stem}", 7_000_000 + 50_000_000 * k) for k, name in enumerate(names)]
    lines = [f"{ns},{name}" for name, ns in rows] + ["157000000,lost.png", "lost_too.png,207000000"]
    (folder / "images.csv").write_text("\n".join(lines) + "\n")
    source = open_source(folder)
    stamps = [frame.image.stamp_ns for frame in source if frame.image is not None]
    assert stamps == [7_000_000, 57_000_000, 107_000_000]
    assert "2 lines of images.csv left out, whose files are missing" in caplog.text


@pytest.mark.parametrize(
    ("heading", "line"),
    [
        ("#timestamp [ns],filename", "{ns},{name}"),  # EuRoC
        ("filename,timestamp", "{name},{seconds}"),
        ("", "{seconds},{name}"),
        ("", "{name},{ns}"),
        ("", "{name};{ns}"),
        ("name\tstamp", "{name}\t{seconds}"),
        ("# timestamp filename", "{seconds} {name}"),  # TUM
        ("# color images", "{seconds}   image/{name}"),
        ("", "{name},{us}"),
        ("", "{ms};{name}"),
        ("name,sec,nsec", "{name},{sec},{nsec}"),
        ("", "{sec} {nsec} {name}"),
        ("seq,stamp,name,exposure", "{k},{ns},{name},0.012"),
        ("", "{k};{sec};{nsec};{name}"),
    ],
)
def test_columns_in_either_order_and_stamps_in_either_unit(tmp_path: Path, heading: str, line: str) -> None:
    """Names that are themselves numbers are told from stamps by the files that are there."""
    images = tmp_path / "images"
    images.mkdir()
    stamps = [1_700_000_000_000_000_000 + 100_000_000 * k for k in range(3)]
    lines = [heading] if heading else []
    for k, stamp in enumerate(stamps):
        name, seconds = f"{k:06d}.png", f"{stamp // 10**9}.{stamp % 10**9:09d}"
        (images / name).write_bytes(b"")
        sec, nsec = divmod(stamp, 10**9)
        units = {"ns": stamp, "us": stamp // 1_000, "ms": stamp // 1_000_000, "sec": sec, "nsec": nsec}
        lines.append(line.format(name=name, seconds=seconds, k=k, **units))
    (tmp_path / "images.csv").write_text("\n".join(lines) + "\n")
    files = stamped_files(images, (".png",))
    assert files.stamps_ns.tolist() == stamps
    assert [path.name for path in files.paths] == ["000000.png", "000001.png", "000002.png"]


@pytest.mark.parametrize("form", ["{s}_{n:09d}", "{s}_{n}", "{s}_{u:06d}", "{us}", "{s}.{n:09d}"])
def test_stamps_as_names(tmp_path: Path, form: str) -> None:
    stamps = [1_700_000_000_000_000_000 + 33_333_000 * k for k in range(40)]
    for stamp in stamps:
        s, n = divmod(stamp, 10**9)
        (tmp_path / f"{form.format(s=s, n=n, u=n // 1000, us=stamp // 1000)}.png").write_bytes(b"")
    assert stamped_files(tmp_path, (".png",)).stamps_ns.tolist() == stamps


@pytest.mark.parametrize("line", ["0.png,1,2,3", "0.png,1700000000.1,1700000000.2", "0.png,words,more"])
def test_columns_that_do_not_show_which_the_stamp_is(tmp_path: Path, line: str) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").write_bytes(b"")
    (tmp_path / "images.csv").write_text(line + "\n")
    with pytest.raises(DataError, match=r"images.csv:1: found .*, expected name,stamp or stamp,name"):
        stamped_files(tmp_path / "images", (".png",))


def test_a_camera_of_euroc(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(
        "sensor_type: camera\ncomment: VI-Sensor cam0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1.0]\n"
        "rate_hz: 20\nresolution: [752, 480]\ncamera_model: pinhole\n"
        "intrinsics: [458.654, 457.296, 367.215, 248.375]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n"
    )
    model = read_camera(tmp_path / "sensor.yaml")
    assert isinstance(model, BrownConradyCamera)
    assert (model.width, model.height, model.intrinsics.fx) == (752, 480, 458.654)
    np.testing.assert_allclose(model.coefficients[:4], [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])


def test_a_table_with_quotes(tmp_path: Path) -> None:
    """Commas and quotes in names, a byte order mark, and lines that end as on Windows."""
    images = tmp_path / "images"
    images.mkdir()
    names = ["left, 1.png", 'the "2".png', "3.png"]
    for name in names:
        (images / name).write_bytes(b"")
    table = tmp_path / "images.csv"
    lines = [
        '"name","stamp_ns"',
        '"left, 1.png","1000000000"',
        '"the ""2"".png", 2000000000',
        "",
        "3.png ,3000000000",
    ]
    table.write_bytes("\ufeff".encode() + "\r\n".join(lines).encode())
    found = stamped_files(images, (".png",))
    assert [path.name for path in found.paths] == names
    assert found.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    table.write_text('"3.png,1000000000\n')
    with pytest.raises(DataError, match=r"images.csv:1: found .*, expected name,stamp or stamp,name"):
        stamped_files(images, (".png",))
    table.write_text(f"3.png,{2**63 - 1}\n")
    with pytest.raises(DataError, match=f"expected nanoseconds, at most {2**62}"):
        stamped_files(images, (".png",))


def test_names_that_count_are_no_stamps(folder: Path) -> None:
    for k, path in enumerate(sorted((folder / "images").iterdir())):
        path.rename(path.with_name(f"{k:06d}.jpg"))
    with pytest.raises(DataError, match="stamps with a median step of 1 ns"):
        open_source(folder)


@pytest.mark.parametrize("suffix", [".tif", ".jpg", ".bmp", ".webp"])
def test_pictures_of_other_formats(folder: Path, suffix: str) -> None:
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path.with_suffix(suffix)), cv2.imread(str(path)))
        path.unlink()
    pixels = [frame.image.pixels for frame in open_source(folder) if frame.image is not None]
    assert [int(picture.mean()) for picture in pixels] == [0, 10, 20, 30, 40]
    first = min((folder / "images").iterdir())
    first.write_bytes(first.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"truncated|damaged"):
        open_source(folder)[0]


@pytest.mark.parametrize("line", ["k1: -0.3", "distortion_coefficients: [-0.3, 0.1, 0, 0]"])
def test_a_camera_whose_distortion_has_another_name_is_not_taken_for_a_pinhole(
    tmp_path: Path, line: str
) -> None:
    path = tmp_path / "camera.yaml"
    plain = "fx: 300\nfy: 300\ncx: 310\ncy: 94\nwidth: 621\nheight: 188\n"
    path.write_text(plain)
    assert read_camera(path).is_pinhole
    path.write_text(plain + line + "\n")
    with pytest.raises(
        DataError, match=f"the key '{line.split(':')[0]}', expected none but fx, .*, distortion$"
    ):
        read_camera(path)


def test_the_cameras_of_a_raw_drive_are_listed(kitti_drive: Path, tmp_path: Path) -> None:
    drive = as_kitti_raw(kitti_drive, tmp_path)
    (drive / "image_02").rename(drive / "image_00")
    with pytest.raises(ConfigError, match=r"camera 'image_02': .* has image_00 \(--camera\)"):
        open_source(tmp_path)
