"""A drive in the odometry layout of KITTI, written anew in other layouts; and clouds in formats of others."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np

from sst_graph.data import open_source
from sst_graph.data.kitti.calib import read_calibration
from sst_graph.data.scan_order import rings_from_order
from sst_graph.timestamps import read_times

EPOCH_NS = 1_317_042_145_000_000_000
"""2011-09-26 13:02:25 UTC: stamps of the raw layout and of nuScenes count from 1970."""
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0005_sync"


def raw_stamp(stamp_ns: int) -> str:
    """As in KITTI's timestamps.txt, to the nanosecond."""
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=stamp_ns // 10**9)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{stamp_ns % 10**9:09d}"


def row(values: Any) -> str:
    return " ".join(f"{value:.17e}" for value in np.asarray(values, np.float64).ravel())


def write_raw_calibration(
    folder: Path, P2: np.ndarray, c0Tl: gtsam.Pose3, size: tuple[int, int], **lines: str
) -> None:
    """calib_cam_to_cam.txt and calib_velo_to_cam.txt; ``lines`` replace others."""
    # Rectification turns camera 0: what follows it must undo that turn.
    R_rect = gtsam.Rot3.RzRyRx(0.004, -0.007, 0.009)
    c0Tl = gtsam.Pose3(R_rect.inverse(), np.zeros(3)) * c0Tl
    cam = {
        "calib_time": "09-Jan-2012 13:57:47",
        "corner_dist": "9.950000e-02",
        "S_02": row((size[0] + 2, size[1] + 5)),
        "K_02": row(P2[:, :3]),
        "D_02": row((-0.37, 0.2, 1e-3, 2e-3, -0.07)),
        "R_02": row(np.eye(3)),
        "T_02": row(np.linalg.solve(P2[:, :3], P2[:, 3])),
        "S_rect_02": row(size),
        "R_rect_00": row(R_rect.matrix()),
        "P_rect_02": row(P2),
    } | lines
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calib_cam_to_cam.txt").write_text("".join(f"{k}: {v}\n" for k, v in cam.items() if v))
    velo = {
        "calib_time": "15-Mar-2012 11:37:16",
        "R": row(c0Tl.rotation().matrix()),
        "T": row(c0Tl.translation()),
    }
    (folder / "calib_velo_to_cam.txt").write_text("".join(f"{k}: {v}\n" for k, v in velo.items()))


def as_kitti_raw(odometry: Path, root: Path) -> Path:
    """The drive as KITTI raw, and its folder; stamps are later by EPOCH_NS."""
    day, drive = root / DAY, root / DAY / DRIVE
    calibration, stamps = read_calibration(odometry / "calib.txt"), read_times(odometry / "times.txt")
    first = cv2.imread(str(next((odometry / "image_2").iterdir())))
    write_raw_calibration(day, calibration.projection("image_2"), calibration.c0Tl, first.shape[1::-1])
    for source, target in (
        ("velodyne", "velodyne_points/data"),
        ("image_2", "image_02/data"),
        ("labels", "labels"),
        ("semantic_2", "semantic_02"),
    ):
        (drive / target).mkdir(parents=True)
        for path in (odometry / source).iterdir():
            shutil.copy(path, drive / target / f"{int(path.stem):010d}{path.suffix}")
    lines = {"timestamps": 0, "timestamps_start": -50_000_000, "timestamps_end": 50_000_000}
    for name, after in lines.items():
        text = "".join(f"{raw_stamp(EPOCH_NS + int(stamp) + after)}\n" for stamp in stamps)
        (drive / "velodyne_points" / f"{name}.txt").write_text(text)
    shutil.copy(drive / "velodyne_points/timestamps.txt", drive / "image_02/timestamps.txt")
    return drive


def without_label_files(drive: Path, root: Path) -> None:
    """Links to what a drive is without its labels: clouds, pictures, stamps and intrinsics."""
    stored, bare = (folder / "sequences" / "00" for folder in (drive, root))
    bare.mkdir(parents=True)
    for part in ("velodyne", "image_2", "times.txt", "calib.txt"):
        (bare / part).symlink_to(stored / part)


def camera_yaml(odometry: Path, size: tuple[int, int]) -> str:
    P = read_calibration(odometry / "calib.txt").projection("image_2")
    names = {"fx": P[0, 0], "fy": P[1, 1], "cx": P[0, 2], "cy": P[1, 2]}
    lines = [f"{name}: {value!r}" for name, value in {k: float(v) for k, v in names.items()}.items()]
    return "\n".join([*lines, f"width: {size[0]}", f"height: {size[1]}"]) + "\n"


def as_folder(odometry: Path, folder: Path, cloud: str = ".bin") -> Path:
    """The drive as a folder; clouds as .bin with files of labels, or as .npz with a field of labels."""
    stamps = read_times(odometry / "times.txt")
    source = open_source(odometry)
    assert source.nominal is not None
    for name in ("images", "masks", "clouds", "labels"):
        (folder / name).mkdir(parents=True)
    for k, stamp in enumerate(stamps.tolist()):
        shutil.copy(odometry / f"image_2/{k:06d}.png", folder / f"images/{stamp}.png")
        shutil.copy(odometry / f"semantic_2/{k:06d}.png", folder / f"masks/{stamp}.png")
        seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
        values = np.fromfile(odometry / f"velodyne/{k:06d}.bin", "<f4").reshape(-1, 4)
        labels = np.fromfile(odometry / f"labels/{k:06d}.label", "<u4")
        if cloud == ".bin":
            values.tofile(folder / f"clouds/{seconds}.bin")
            labels.tofile(folder / f"labels/{seconds}.label")
        else:
            np.savez(folder / f"clouds/{seconds}.npz", points=values, label=labels)
    if cloud != ".bin":
        (folder / "labels").rmdir()
    size = (source.camera.width, source.camera.height)
    (folder / "camera.yaml").write_text(camera_yaml(odometry, size))
    rows = [[float(value) for value in line] for line in source.nominal.matrix()]
    (folder / "extrinsic.yaml").write_text(f"T_camera_lidar: {json.dumps(rows)}\n")
    return folder


def pose_record(pose: gtsam.Pose3) -> dict[str, list[float]]:
    q = pose.rotation().toQuaternion()
    t = [float(value) for value in pose.translation()]
    return {"translation": t, "rotation": [q.w(), q.x(), q.y(), q.z()]}


def as_nuscenes(odometry: Path, root: Path, labels: bool = True, rings_by_order: bool = False) -> Path:
    """The drive as scene-0061 of nuScenes, every second frame a key frame with lidarseg labels: 17 a car.

    A second scene and a second camera stand in the tables, without files. Stamps are later by EPOCH_NS.

    Args:
        rings_by_order: rings as KITTI's readers find them; else they count up from 0.
    """
    source, stamps = open_source(odometry), read_times(odometry / "times.txt")
    camera = source.camera
    eTl = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, 0.02, -1.57), np.array([0.94, 0.0, 1.84]))
    assert source.nominal is not None
    eTc = eTl * source.nominal.inverse()
    tables = root / "v1.0-mini"
    for name in (
        "v1.0-mini",
        "samples/LIDAR_TOP",
        "samples/CAM_FRONT",
        "sweeps/LIDAR_TOP",
        "sweeps/CAM_FRONT",
    ):
        (root / name).mkdir(parents=True)
    (root / "lidarseg/v1.0-mini").mkdir(parents=True)
    K = camera.matrix.tolist()
    calibrated = [
        {"token": "c-l", "sensor_token": "s-l", **pose_record(eTl), "camera_intrinsic": []},
        {"token": "c-c", "sensor_token": "s-c", **pose_record(eTc), "camera_intrinsic": K},
        {"token": "c-b", "sensor_token": "s-b", **pose_record(eTl), "camera_intrinsic": K},
    ]
    sensors = [
        {"token": "s-l", "channel": "LIDAR_TOP", "modality": "lidar"},
        {"token": "s-c", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "s-b", "channel": "CAM_BACK", "modality": "camera"},
    ]
    samples, data, lidarseg = [{"token": "other", "scene_token": "t-2", "timestamp": 0}], [], []
    for k, stamp in enumerate(stamps.tolist()):
        stamp_us, kind = (EPOCH_NS + stamp) // 1000, "sweeps" if k % 2 else "samples"
        if kind == "samples":
            samples.append({"token": f"sample-{k}", "scene_token": "t-1", "timestamp": stamp_us})
        values = np.fromfile(odometry / f"velodyne/{k:06d}.bin", "<f4").reshape(-1, 4)
        found = rings_from_order(values[:, :3]) if rings_by_order else None
        rings = np.arange(len(values)) % 32 if found is None else found
        cloud = f"{kind}/LIDAR_TOP/n015__LIDAR_TOP__{stamp_us}.pcd.bin"
        np.column_stack([values, rings]).astype("<f4").tofile(root / cloud)
        picture = f"{kind}/CAM_FRONT/n015__CAM_FRONT__{stamp_us}.png"
        shutil.copy(odometry / f"image_2/{k:06d}.png", root / picture)
        shared = {
            "sample_token": f"sample-{k - k % 2}",
            "timestamp": stamp_us,
            "is_key_frame": kind == "samples",
        }
        size = {"height": camera.height, "width": camera.width}
        data += [
            {
                "token": f"l-{k}",
                "calibrated_sensor_token": "c-l",
                **shared,
                "height": 0,
                "width": 0,
                "filename": cloud,
            },
            {"token": f"c-{k}", "calibrated_sensor_token": "c-c", **shared, **size, "filename": picture},
        ]
        if kind == "samples" and labels:
            classes = np.fromfile(odometry / f"labels/{k:06d}.label", "<u4") & 0xFFFF
            name = f"lidarseg/v1.0-mini/l-{k}_lidarseg.bin"
            np.where(classes == 10, 17, 24).astype(np.uint8).tofile(root / name)
            lidarseg.append({"token": f"l-{k}", "sample_data_token": f"l-{k}", "filename": name})
    data.append({**data[0], "token": "x", "sample_token": "other", "filename": "samples/none.bin"})
    scenes = [{"token": "t-1", "name": "scene-0061"}, {"token": "t-2", "name": "scene-0103"}]
    for name, table in {
        "scene": scenes,
        "sample": samples,
        "sample_data": data[::-1],
        "sensor": sensors,
        "calibrated_sensor": calibrated,
        "lidarseg": lidarseg,
    }.items():
        (tables / f"{name}.json").write_text(json.dumps(table, indent=0))
    return root
