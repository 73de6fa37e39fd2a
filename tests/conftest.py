"""A tiny KITTI drive on disk, the simulated drive that the tracker is tried on, and the session's folder."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from stored import FOLDER, simulated
from streets import TRACKED_STREET

from sst_graph.simulator import SimulatedDrive
from sst_graph.types import Frame

CALIB = """P0: 700 0 4 0 0 700 3 0 0 0 1 0
P2: 700 0 4 35 0 700 3 0 0 0 1 0
P3: 700 0 4 -350 0 700 3 0 0 0 1 0
Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""


def pytest_configure(config: pytest.Config) -> None:
    """The folder of :mod:`stored`, removed at the end; the workers inherit it by the environment."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="sst-graph-tests-")
        os.environ[FOLDER] = folder.name
        config.add_cleanup(folder.cleanup)


@pytest.fixture
def kitti_drive(tmp_path: Path) -> Path:
    """Folder of the only sequence of a data set: five frames, 12 points each, images of 8x6 px.

    Stamps are 0, 0.1, 0.2, 0.31, 0.41 s. Frame k has k + 1 points (instance 3) and k + 1 pixels of a
    car; its other points are ground, its other pixels background but for one to ignore; its picture is
    grey 10 k.
    """
    folder = tmp_path / "kitti" / "sequences" / "00"
    for name in ("velodyne", "labels", "image_2", "semantic_2"):
        (folder / name).mkdir(parents=True)
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("".join(f"{t:e}\n" for t in (0.0, 0.1, 0.2, 0.31, 0.41)))
    for k in range(5):
        points = np.random.default_rng(k).uniform(1.0, 20.0, (12, 4)).astype("<f4")
        points.tofile(folder / f"velodyne/{k:06d}.bin")
        labels = np.full(12, 40, "<u4")
        labels[: k + 1] = 10 | 3 << 16
        labels.tofile(folder / f"labels/{k:06d}.label")
        cv2.imwrite(str(folder / f"image_2/{k:06d}.png"), np.full((6, 8, 3), 10 * k, np.uint8))
        mask = np.zeros((6, 8), np.uint8)
        mask[0, : k + 1] = 26
        mask[-1, -1] = 255
        cv2.imwrite(str(folder / f"semantic_2/{k:06d}.png"), mask)
    return folder


@pytest.fixture(scope="module")
def street() -> SimulatedDrive:
    """Of :data:`streets.TRACKED_STREET`; modules with a street of their own hide it."""
    return simulated(TRACKED_STREET)


@pytest.fixture(scope="module")
def frames(street: SimulatedDrive) -> list[Frame]:
    """All frames of the street, made once."""
    return [street[i] for i in range(len(street))]


@pytest.fixture(scope="module")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of a bucket at an S3 server of its own."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    patch = pytest.MonkeyPatch()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        patch.setenv(name, value)
    boto3.client("s3").create_bucket(Bucket="fleet")
    yield "s3://fleet"
    patch.undo()
    server.stop()
