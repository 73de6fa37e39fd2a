"""A drive is read once, file by file, and little of a frame stays in memory."""

from __future__ import annotations

import gc
import os
import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stored import written
from streets import SHORT_STREET, standing_street

from sst_graph import open_source
from sst_graph.batch import CalibrationConfig, prepare_drives
from sst_graph.cli.outputs import write_calibration
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.types import Frame, SemanticClass

VEHICLE = SemanticClass.VEHICLE


class Long:
    """Frames of a standing street over and over, with stamps that rise."""

    name, nominal, truth, sweep = "long", None, None, "compensated"

    def __init__(self, frames: int) -> None:
        self.frames = [frame for frame in standing_street()]
        self.count = frames

    @property
    def camera(self) -> PinholeCamera:
        return standing_street().camera

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, position: int) -> Frame:
        frame = self.frames[position % len(self.frames)]
        assert frame.scan is not None and frame.image is not None
        stamp_ns = 100_000_000 * position
        scan = replace(frame.scan, stamp_ns=stamp_ns, points=frame.scan.points.copy())
        image = replace(frame.image, stamp_ns=stamp_ns, mask=frame.image.mask.copy())
        return Frame(position, scan, image)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(self.count))


def prepared(frames: int, in_memory_bytes: int) -> Drive:
    """The drive with so much of it in memory."""
    config = replace(CalibrationConfig().prepare, use_visual_odometry=False, in_memory_bytes=in_memory_bytes)
    return prepare_drive(Long(frames), CalibrationConfig().classes, config, depth=False)


def traced(frames: int) -> tuple[int, int, Drive]:
    """Bytes that preparing so many frames leaves behind, and their peak on the way."""
    gc.collect()
    tracemalloc.start()
    drive = prepared(frames, in_memory_bytes=1_000_000)
    gc.collect()
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return kept, peak, drive


def test_little_of_a_frame_stays_in_memory() -> None:
    """Its fields alone take 0.5 MB at half the usual size, its labelled points and mask as much."""
    few, few_peak, _ = traced(6)
    many, many_peak, drive = traced(18)
    fields = sum(contour.distance.nbytes for image in drive.images for contour in image.contours.values())
    assert fields > 18 * 300_000
    assert (many - few) / 12 < 100_000
    assert (many_peak - few_peak) / 12 < 100_000


def test_a_drive_in_the_array_store_is_the_same_drive() -> None:
    plain, stored = prepared(2, in_memory_bytes=100_000_000), prepared(2, in_memory_bytes=0)
    for a, b in zip(plain.scans, stored.scans, strict=True):
        assert len(a.lPs) > 100 and a.lPs.dtype == b.lPs.dtype == float
        assert (a.lPs == b.lPs).all() and (a.classes == b.classes).all()
        assert (a.offsets_s == b.offsets_s).all()
    for c, d in zip(plain.images, stored.images, strict=True):
        assert (c.mask == d.mask).all() and list(c.contours) == list(d.contours) == [VEHICLE]
        assert (c.contours[VEHICLE].distance == d.contours[VEHICLE].distance).all()
        assert (c.contours[VEHICLE].unknown == d.contours[VEHICLE].unknown).all()


_opened: Counter[str] | None = None


def _note(event: str, args: tuple[object, ...]) -> None:
    if _opened is not None and event == "open" and isinstance(args[0], str | os.PathLike):
        _opened[os.fspath(args[0])] += 1


sys.addaudithook(_note)  # of the interpreter; it cannot be taken away again


@contextmanager
def opened_files() -> Iterator[Counter[str]]:
    """Counts how often each file is opened."""
    global _opened
    _opened = Counter()
    try:
        yield _opened
    finally:
        _opened = None


@pytest.fixture(scope="module")
def street() -> Path:
    """A street driven along, on disk, without times of the points."""
    return written(SHORT_STREET)


def of_folders(opened: Counter[str], *folders: str) -> dict[str, int]:
    return {name: count for name, count in opened.items() if Path(name).parent.name in folders}


@pytest.mark.slow
def test_each_file_is_read_once(street: Path) -> None:
    """Scans that the sweep is decided by, too; masks that tell the encoding were read when it was opened.

    Method auto looks at some frames first, for labels.
    """
    source = open_source(street, frames="0:10")
    with opened_files() as opened:
        (drive,) = prepare_drives([source], CalibrationConfig(method="joint"))
    assert drive.sweep is not None and drive.sweep.kind != "given"
    read = of_folders(opened, "velodyne", "labels", "image_2", "semantic_2")
    assert len(read) == 4 * 10 and set(read.values()) == {1}


def test_pictures_read_what_they_show(street: Path, tmp_path: Path) -> None:
    """Four scans are candidates for each of three pictures, and two beside each tell its motion."""
    source = open_source(street, frames="0:10")
    result = CalibrationResult(
        T_camera_lidar=source.nominal,
        time_offset_s=0.0,
        covariance=1e-4 * np.eye(7),
        status="ok",
        camera=source.camera,
        frames_used=tuple(FrameId(source.name, k) for k in range(10)),
    )
    with opened_files() as opened:
        names = write_calibration(tmp_path, result, [source], None)
    assert sum(name.startswith("overlay") for name in names) == 3
    assert set(of_folders(opened, "velodyne", "labels").values()) == {1}
    images = of_folders(opened, "image_2", "semantic_2")
    assert set(images.values()) == {1} and len(images) <= 2 * 9
