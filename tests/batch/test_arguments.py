"""What ``calibrate`` is given, of any type: refused in one line before anything is read or solved."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from checks.fuzz import STREET
from sst_graph import CalibrationConfig, PinholeCamera, TrackerConfig, calibrate, calibrate_rig
from sst_graph.batch.calibrate import calibrate_prepared, prepare_drives
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import check_progress
from sst_graph.errors import SstGraphError
from sst_graph.factors import FactorError
from sst_graph.segmentation.labelled import segment_drive
from sst_graph.simulator import simulate, write_drive
from sst_graph.types import Frame


@pytest.fixture(scope="module")
def drive() -> KeptDrive:
    return KeptDrive.of(simulate(STREET))


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (None, "found NoneType"),
        (5, "found int"),
        ([], "found list"),
        ("drive", "a sequence of str"),
        ({}, "found dict"),
        (iter(()), "expected a source"),
        (itertools.count(), "a sequence of int"),
    ],
)
def test_no_source(frames: Any, found: str) -> None:
    with pytest.raises(SstGraphError, match=found):
        calibrate(frames)


def test_drives_without_end(drive: KeptDrive) -> None:
    with pytest.raises(SstGraphError, match="found more than 10000 drives"):
        calibrate(itertools.repeat(drive))  # type: ignore[arg-type]


def test_frames_are_no_source(drive: KeptDrive) -> None:
    def one_by_one() -> Iterator[Frame]:
        yield from drive

    for frames in (one_by_one(), list(drive), drive[0]):
        with pytest.raises(SstGraphError, match="Frame, expected a source"):
            calibrate(frames)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initial": "Tr"}, "initial: found a str"),
        ({"initial": gtsam.Pose3(gtsam.Rot3(np.zeros((3, 3))), np.zeros(3))}, "expected a rotation matrix"),
        ({"initial": gtsam.Pose3(gtsam.Rot3(), np.full(3, 1e200))}, "a translation of 1e+200 m"),
        ({"initial_time_offset_s": "now"}, "initial time offset: found a str"),
        ({"initial_time_offset_s": -np.inf}, "initial time offset: found -inf"),
        ({"config": {}}, "config: found a dict, expected a CalibrationConfig"),
        ({"config": TrackerConfig()}, "config: found a TrackerConfig"),
    ],
)
def test_guess_and_settings(drive: KeptDrive, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SstGraphError, match=re.escape(message)):
        calibrate(drive, **options)


@pytest.mark.parametrize("camera", [None, PinholeCamera(1e-3, 1e-3, 1.0, 1.0, 10, 10)])
def test_a_source_without_a_camera(drive: KeptDrive, camera: Any) -> None:
    with pytest.raises(SstGraphError, match="camera: "):
        calibrate(dataclasses.replace(drive, camera=camera))


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"name": 5}, "name: found 5, expected text"),
        ({"name": {}}, "name: found a dict, expected text"),
        ({"name": "a\nb"}, "expected text without control characters"),
        ({"nominal": "Tr"}, "nominal: found the text 'Tr', expected a gtsam.Pose3"),
        ({"frames": ()}, "found no frame"),
    ],
)
def test_what_a_source_says_of_itself(drive: KeptDrive, said: dict[str, Any], message: str) -> None:
    with pytest.raises(SstGraphError, match=re.escape(message)):
        calibrate(dataclasses.replace(drive, **said))


@pytest.mark.parametrize("length", ["three", -1, 10**30])
def test_a_source_whose_length_is_none(drive: KeptDrive, length: Any) -> None:
    class Endless(KeptDrive):
        def __len__(self) -> int:
            return length  # type: ignore[no-any-return]

    with pytest.raises(SstGraphError, match=f"{drive.name}: length: found .*, expected a number of frames"):
        calibrate(Endless.of(drive))


@pytest.mark.parametrize("method", ["auto", "joint", "motion", "edges"])
@pytest.mark.parametrize("part", ["frame", "index", "scan", "points", "image", "mask"])
def test_a_source_whose_frames_hold_anything(drive: KeptDrive, part: str, method: Any) -> None:
    first = drive[0]
    assert first.scan is not None and first.image is not None
    wrong: Any = {
        "frame": 3,
        "index": Frame("a", first.scan, first.image),  # type: ignore[arg-type]
        "scan": Frame(0, {}, first.image),  # type: ignore[arg-type]
        "points": Frame(0, dataclasses.replace(first.scan, points=[1]), first.image),  # type: ignore[arg-type]
        "image": Frame(0, first.scan, "image"),  # type: ignore[arg-type]
        "mask": Frame(0, first.scan, dataclasses.replace(first.image, mask=first.image.mask[0])),
    }[part]
    with pytest.raises(SstGraphError, match="frame"):
        calibrate(
            dataclasses.replace(drive, frames=(wrong, *drive.frames[1:])),
            drive.nominal,
            CalibrationConfig(method=method),
        )


@pytest.mark.parametrize(
    ("progress", "found"),
    [
        (3, "found 3"),
        ("bar", "found the text 'bar'"),
        (lambda: None, r"one with the arguments \(\)"),
        (lambda stage, done: None, r"one with the arguments \(stage, done\)"),
        (lambda stage, done, total, *, at: None, r"one with the arguments \(stage, done, total, \*, at\)"),
    ],
)
def test_no_progress(progress: Any, found: str, drive: KeptDrive) -> None:
    expected = "expected a function of (stage, done, total), or None"
    for begin in (
        lambda: calibrate(drive, progress=progress),
        lambda: calibrate_rig({"left": drive}, progress=progress),
        lambda: prepare_drives([drive], CalibrationConfig(), progress),
        lambda: calibrate_prepared([], progress=progress),
    ):
        with pytest.raises(FactorError, match=f"progress: .*{found}") as error:
            begin()
        assert expected in str(error.value)


def test_no_progress_of_files(tmp_path: Path) -> None:
    wrong: Any = lambda done: None  # noqa: E731
    with pytest.raises(FactorError, match=r"arguments \(done\), expected a function of \(done, total\)"):
        write_drive(simulate(STREET), tmp_path / "street", progress=wrong)
    assert not (tmp_path / "street").exists()
    with pytest.raises(FactorError, match="progress: found 3"):
        segment_drive([], 3)  # type: ignore[arg-type]


def test_progress_of_any_kind() -> None:
    """Bound methods, further arguments with defaults, and what is written in C."""
    for progress in (lambda *step: None, lambda a, b, c, d=1: None, print):
        check_progress(progress)
    check_progress(None)
    check_progress(functools.partial(lambda where, a, b, c: None, "here"))
