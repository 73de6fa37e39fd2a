"""The tree that stands for nuScenes in the tests, read by nuScenes' own devkit.

The devkit asks for NumPy 1 and works with NumPy 2, so no extra can name it: ``pip install --no-deps`` with
nuscenes-devkit, scikit-learn, joblib, threadpoolctl, narwhals, shapely, descartes, cachetools.
"""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from layouts import as_nuscenes
from PIL import Image

from sst_graph import SemanticClass, open_source

devkit = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")

CATEGORIES = {17: "vehicle.car", 24: "flat.driveable_surface"}


def with_further_tables(root: Path) -> Path:
    """The tables that the devkit loads and a calibration does not need."""
    tables = root / "v1.0-mini"
    (root / "maps").mkdir()
    Image.new("L", (1, 1)).save(root / "maps/map.png")
    further = {
        "category": [{"token": f"k-{n}", "name": name, "index": n} for n, name in CATEGORIES.items()],
        "log": [{"token": "log"}],
        "map": [{"token": "map", "log_tokens": ["log"], "filename": "maps/map.png"}],
        **{name: [] for name in ("attribute", "visibility", "instance", "ego_pose", "sample_annotation")},
    }
    for name, table in further.items():
        (tables / f"{name}.json").write_text(json.dumps(table))
    return root


def test_the_devkit_reads_what_we_read(kitti_drive: Path, tmp_path: Path) -> None:
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.data_io import load_bin_file
    from nuscenes.utils.geometry_utils import transform_matrix
    from pyquaternion import Quaternion

    root = with_further_tables(as_nuscenes(kitti_drive, tmp_path / "nuscenes"))
    theirs = devkit.NuScenes("v1.0-mini", str(root), verbose=False)
    ours = open_source(root, sequence="61")
    poses = []
    for k, frame in enumerate(ours):
        assert frame.scan is not None and frame.image is not None
        lidar, camera = (theirs.get("sample_data", f"{kind}-{k}") for kind in "lc")
        # 1. Stamps, points and pictures.
        assert (lidar["channel"], camera["channel"]) == ("LIDAR_TOP", "CAM_FRONT")
        assert frame.scan.stamp_ns == 1000 * lidar["timestamp"]
        assert frame.image.stamp_ns == 1000 * camera["timestamp"]
        cloud = LidarPointCloud.from_file(theirs.get_sample_data_path(lidar["token"]))
        np.testing.assert_array_equal(frame.scan.points, cloud.points[:3].T)
        picture = np.asarray(Image.open(theirs.get_sample_data_path(camera["token"])))
        np.testing.assert_array_equal(frame.image.pixels, picture)
        # 2. Labels, where the frame is a key frame.
        assert frame.scan.has_labels == lidar["is_key_frame"]
        if lidar["is_key_frame"]:
            numbers = load_bin_file(str(root / theirs.get("lidarseg", lidar["token"])["filename"]))
            np.testing.assert_array_equal(
                frame.scan.classes == SemanticClass.VEHICLE,
                [theirs.lidarseg_idx2name_mapping[n] == "vehicle.car" for n in numbers],
            )
        # 3. Where the sensors sit.
        records = [theirs.get("calibrated_sensor", one["calibrated_sensor_token"]) for one in (lidar, camera)]
        poses.append([transform_matrix(one["translation"], Quaternion(one["rotation"])) for one in records])
        np.testing.assert_allclose(ours.camera.matrix, records[1]["camera_intrinsic"])
    assert len(poses) == len(ours) and ours.nominal is not None
    eTl, eTc = poses[0]
    assert ours.nominal.equals(gtsam.Pose3(np.linalg.inv(eTc) @ eTl), 1e-9)
