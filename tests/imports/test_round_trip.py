"""What the exports write comes back as a start: pose, time offset and its sign."""

from __future__ import annotations

from pathlib import Path

import pytest
from calibrations import TIME_OFFSET_S, turned, vehicle
from rigs import marginal_of
from rigs import result_of as rig_of

from sst_graph.cli.options import IMPORTS
from sst_graph.errors import DataError
from sst_graph.export import FORMATS as EXPORTS
from sst_graph.export import ExportOptions, export_text
from sst_graph.imports import FORMATS, ImportOptions, import_calibration, read_tree
from sst_graph.reference import load_initial
from sst_graph.result import CalibrationResult

TREES = ("ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro")
CHAINS = ("kalibr", "openvins", "mins")
WITHOUT_OFFSET = ("kitti",)


def written(folder: Path, text: str) -> Path:
    """A file whose name says nothing."""
    path = folder / "file"
    path.write_text(text)
    return path


def agrees(path: Path, result: CalibrationResult, options: ImportOptions | None = None) -> str:
    """The format of a file, which holds the result to 1e-9."""
    found = import_calibration(path, options)
    assert found.cTl.equals(result.T_camera_lidar, 1e-9)
    expected = None if found.format in WITHOUT_OFFSET else result.time_offset_s
    assert found.time_offset_s == expected
    return found.format


@pytest.mark.parametrize("target", EXPORTS)
@pytest.mark.parametrize("seed", range(8))
def test_every_format_comes_back(target: str, seed: int, tmp_path: Path) -> None:
    path = written(tmp_path, export_text(turned(seed), target))
    assert agrees(path, turned(seed)) == target
    cTl, time_offset_s = load_initial(path)
    assert cTl.equals(turned(seed).T_camera_lidar, 1e-9)
    assert time_offset_s == (0.0 if target in WITHOUT_OFFSET else TIME_OFFSET_S)


@pytest.mark.parametrize("target", TREES)
@pytest.mark.parametrize(
    "options",
    [
        {"parent": "lidar"},
        {"child": "camera_link"},
        {"parent": "camera_link"},
        {"camera_frame": "front/optical", "lidar_frame": "/os_sensor/lidar", "parent": "/os_sensor/lidar"},
    ],
)
def test_either_direction(target: str, options: dict[str, str], tmp_path: Path) -> None:
    text = export_text(turned(3), target, ExportOptions(**options))
    assert agrees(written(tmp_path, text), turned(3)) == target


@pytest.mark.parametrize("target", [*TREES, "nuscenes", "autoware", "mins"])
def test_on_a_vehicle(target: str, tmp_path: Path) -> None:
    tree = read_tree(vehicle(tmp_path))
    parent = "imu_link" if target == "mins" else "base_link"
    text = export_text(turned(4), target, ExportOptions(parent=parent, tree=tree))
    # Only these need the vehicle: the others hold the LiDAR, too.
    options = ImportOptions(tree=tree) if target in TREES else None
    assert agrees(written(tmp_path, text), turned(4), options) == target


@pytest.mark.parametrize("target", ["urdf", "ros-tf"])
@pytest.mark.parametrize(
    ("parent", "child"),
    [
        ("base_link", "camera_link"),
        ("camera_link", "base_link"),
        ("camera_link", "roof"),
        ("camera_link", "lidar"),
    ],
)
def test_the_file_replaces_the_camera_of_the_tree(
    target: str, parent: str, child: str, tmp_path: Path
) -> None:
    """The tree has the camera on the roof already, somewhere else."""
    tree = read_tree(vehicle(tmp_path))
    options = ExportOptions(parent=parent, child=child, tree=tree)
    path = written(tmp_path, export_text(turned(4), target, options))
    found = import_calibration(path, ImportOptions(tree=tree))
    assert found.cTl.equals(turned(4).T_camera_lidar, 1e-12)


def test_a_tree_that_joins_camera_and_lidar_by_itself_is_refused(tmp_path: Path) -> None:
    """Its pose is none of the file's: the file has another camera."""
    tree = read_tree(vehicle(tmp_path))
    other = ExportOptions("rear_optical_frame", parent="base_link", tree=tree)
    path = written(tmp_path, export_text(turned(4), "urdf", other))
    expected = "found 'camera_link' and 'lidar' joined by --tree alone, expected a transform of the file"
    with pytest.raises(DataError, match=expected):
        import_calibration(path, ImportOptions(camera_link="camera_link", tree=tree))


@pytest.mark.parametrize("target", ["kalibr", "openvins"])
def test_chains_on_the_imu_of_a_vehicle(target: str, tmp_path: Path) -> None:
    tree = read_tree(vehicle(tmp_path))
    text = export_text(turned(4), target, ExportOptions(parent="imu_link", tree=tree))
    path = written(tmp_path, text)
    assert agrees(path, turned(4), ImportOptions(parent="imu_link", tree=tree)) == target
    # Without it the IMU is taken for the LiDAR, and the import says so.
    alone = import_calibration(path)
    assert not alone.cTl.equals(turned(4).T_camera_lidar, 0.1)
    assert "the LiDAR in the IMU's place" in alone.words()
    with pytest.raises(DataError, match=r"no pose of 'lidar' in 'imu_link', expected --tree"):
        import_calibration(path, ImportOptions(parent="imu_link"))


@pytest.mark.parametrize("target", sorted(set(EXPORTS) - {"kitti", "gtsam"}))
def test_each_camera_of_a_rig(target: str, tmp_path: Path) -> None:
    rig = rig_of(marginal_of(3))
    link = "{camera}/camera_link" if target == "autoware" else None
    path = written(tmp_path, export_text(rig, target, ExportOptions(camera_link=link)))
    for name, result in rig.cameras.items():
        assert agrees(path, result, ImportOptions(camera=name)) == target
    with pytest.raises(DataError, match=r"expected one.*--camera"):
        import_calibration(path)


def test_a_result_is_a_start_too(tmp_path: Path) -> None:
    path = written(tmp_path, turned(3).to_json())
    assert agrees(path, turned(3)) == "calibration"
    with pytest.raises(DataError, match="a calibration of camera image_2, expected one of image_3"):
        import_calibration(path, ImportOptions(camera="image_3"))


def test_what_is_written_can_be_read() -> None:
    assert set(EXPORTS) | {"calibration"} == set(FORMATS) == set(IMPORTS)
