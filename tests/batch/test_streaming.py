"""A drive is read once, file by file, and little of a frame stays in memory."""

from __future__ import annotations

import gc
import os
import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from stored import written
from streets import SHORT_STREET, standing_street

from sst_graph import open_source
from sst_graph.batch import CalibrationConfig, prepare_drives
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.cli.outputs import write_calibration
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.types import Frame, SemanticClass

VEHICLE, OBJECT = SemanticClass.VEHICLE, SemanticClass.OBJECT
LABELLED, UNLABELLED = CalibrationConfig().classes, (OBJECT,)


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


def prepared(frames: int, in_memory_bytes: int, classes: Sequence[SemanticClass] = LABELLED) -> Drive:
    """The drive with so much of it in memory."""
    config = replace(CalibrationConfig().prepare, use_visual_odometry=False, in_memory_bytes=in_memory_bytes)
    return prepare_drive(Long(frames), classes, config, depth=False)


def traced(frames: int, classes: Sequence[SemanticClass]) -> tuple[int, int, Drive]:
    """Bytes that preparing so many frames leaves behind, and their peak on the way."""
    gc.collect()
    tracemalloc.start()
    drive = prepared(frames, 1_000_000, classes)
    gc.collect()
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return kept, peak, drive


@pytest.mark.slow
def test_little_of_a_frame_stays_in_memory() -> None:
    """Its fields alone take 0.5 MB at half the usual size, its labelled points and mask as much."""
    few, few_peak, _ = traced(6, LABELLED)
    many, many_peak, drive = traced(18, LABELLED)
    fields = sum(contour.distance.nbytes for image in drive.images for contour in image.contours.values())
    assert fields > 18 * 300_000
    assert (many - few) / 12 < 100_000
    assert (many_peak - few_peak) / 12 < 100_000


@pytest.mark.slow
def test_little_of_a_frame_by_edges_stays_in_memory() -> None:
    """Its boundary points alone take 0.3 MB."""
    few, few_peak, _ = traced(6, UNLABELLED)
    many, many_peak, drive = traced(18, UNLABELLED)
    assert sum(len(scan.boundaries[OBJECT]) for scan in drive.scans) > 18 * 4_000
    assert (many - few) / 12 < 100_000
    assert (many_peak - few_peak) / 12 < 100_000


def test_a_drive_with_fewer_boundary_points_has_its_other_arrays_on_disk() -> None:
    drive = prepared(6, 0, UNLABELLED)
    gc.collect()
    tracemalloc.start()
    few = thinned(drive, 100)
    gc.collect()
    in_memory, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    points = sum(len(scan.boundaries[OBJECT]) for scan in few.scans)
    assert 0 < points <= 6 * 100
    assert sum(scan.lPs.nbytes for scan in few.scans) > 6 * 50_000
    assert in_memory < 100 * points + 6 * 5_000


def test_a_drive_in_the_array_store_is_the_same_drive() -> None:
    plain, stored = prepared(2, 100_000_000), prepared(2, 0)
    for a, b in zip(plain.scans, stored.scans, strict=True):
        assert len(a.lPs) > 100 and a.lPs.dtype == b.lPs.dtype == float
        assert (a.lPs == b.lPs).all() and (a.classes == b.classes).all()
        assert (a.offsets_s == b.offsets_s).all()
    for c, d in zip(plain.images, stored.images, strict=True):
        assert (c.mask == d.mask).all() and list(c.contours) == list(d.contours) == [VEHICLE]
        assert (c.contours[VEHICLE].distance == d.contours[VEHICLE].distance).all()
        assert (c.contours[VEHICLE].unknown == d.contours[VEHICLE].unknown).all()


@pytest.mark.parametrize("classes", [LABELLED, UNLABELLED])
def test_boundary_points_in_the_array_store_are_the_same(classes: Sequence[SemanticClass]) -> None:
    plain, stored = prepared(2, 100_000_000, classes), prepared(2, 0, classes)
    for a, b in zip(plain.scans, stored.scans, strict=True):
        for found, there in ((a.boundaries, b.boundaries), (a.lower_edges, b.lower_edges)):
            assert list(found) == list(there)
            for c in found:
                assert len(found[c]) == len(there[c]) > 0
                for field in fields(Boundaries):
                    rows, others = (getattr(each[c], field.name) for each in (found, there))
                    assert rows.dtype == others.dtype and (rows == others).all()
        assert a.boundaries


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
