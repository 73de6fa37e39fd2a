"""Both real drives in every layout: the same calibration as from KITTI's odometry layout."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from bags import KINDS, MASK, bag_of
from layouts import as_folder, as_kitti_raw, as_nuscenes

from sst_graph import CalibrationConfig, calibrate
from sst_graph.data import KittiSource, open_source
from sst_graph.result import CalibrationResult

DATA = Path(__file__).parents[3] / "shared" / "data"
DRIVES = ("kitti_2011_09_26_stop", "kitti_2011_09_26_parked")
FRAMES = 14
"""Of each drive: the images stand one frame later than the scans."""
FOLDERS = ("velodyne", "labels", "image_2", "semantic_2")

pytestmark = [
    pytest.mark.drives,
    pytest.mark.skipif(not all((DATA / name).exists() for name in DRIVES), reason="no real drives here"),
]


def beginning(drive: Path, folder: Path, names: tuple[str, ...] = FOLDERS) -> Path:
    """The first frames of a drive."""
    for name in names:
        (folder / name).mkdir(parents=True)
        for path in sorted((drive / name).iterdir())[:FRAMES]:
            shutil.copy(path, folder / name / path.name)
    shutil.copy(drive / "calib.txt", folder)
    lines = (drive / "times.txt").read_text().splitlines()[:FRAMES]
    (folder / "times.txt").write_text("".join(f"{line}\n" for line in lines))
    return folder


@pytest.fixture(scope="module", params=DRIVES)
def odometry(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    (drive,) = sorted((DATA / request.param / "sequences").iterdir())[:1]
    return beginning(drive, tmp_path_factory.mktemp("real") / "odometry")


@pytest.fixture(scope="module")
def wanted(odometry: Path) -> CalibrationResult:
    source = open_source(odometry, image_shift=1)
    return calibrate(source, source.nominal)


def assert_same(found: CalibrationResult, wanted: CalibrationResult) -> None:
    step = gtsam.Pose3.Logmap(wanted.T_camera_lidar.between(found.T_camera_lidar))
    assert np.abs(step).max() < 1e-6 and abs(found.time_offset_s - wanted.time_offset_s) < 1e-6
    np.testing.assert_allclose(found.covariance, wanted.covariance, rtol=1e-3, atol=1e-12)
    assert found.status == wanted.status


def as_bag(kind: str) -> Callable[[Path, Path], Path]:
    def written(odometry: Path, root: Path) -> Path:
        source = open_source(odometry)
        assert isinstance(source, KittiSource)
        return bag_of(source, root.with_suffix(".bag") if kind == "ros1" else root, kind)  # type: ignore[arg-type]

    return written


LAYOUTS: dict[str, Callable[[Path, Path], Path]] = {
    "kitti-raw": as_kitti_raw,
    "folder": as_folder,
    **{kind: as_bag(kind) for kind in KINDS},
}


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_calibration_does_not_depend_on_the_layout(
    layout: str, odometry: Path, wanted: CalibrationResult, tmp_path: Path
) -> None:
    options = {"mask_topic": MASK} if layout in KINDS else {}
    source = open_source(LAYOUTS[layout](odometry, tmp_path / "drive"), image_shift=1, **options)  # type: ignore[arg-type]
    assert_same(calibrate(source, source.nominal), wanted)


@pytest.mark.slow
def test_motion_from_nuscenes_is_that_from_kitti(odometry: Path, tmp_path: Path) -> None:
    """nuScenes has no masks of images, so neither side has labels here."""
    bare = beginning(odometry, tmp_path / "bare", ("velodyne", "image_2"))
    root = as_nuscenes(odometry, tmp_path / "nuscenes", labels=False, rings_by_order=True)
    config = CalibrationConfig(method="motion")
    results = []
    for source in (open_source(bare, image_shift=1), open_source(root, sequence="61", image_shift=1)):
        results.append(calibrate(source, source.nominal, config))
    assert_same(results[1], results[0])
