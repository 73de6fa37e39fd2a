"""Calibration without labels: by edges, and the choice of it."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import cast

import gtsam
import numpy as np
import pytest
from layouts import without_label_files
from stored import simulated

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.batch.by_edges.choice import with_method_for
from sst_graph.batch.by_edges.inverted import inverted_start
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.experiments.starts import errors_of
from sst_graph.fit import FitQuality
from sst_graph.inspect.report import summary
from sst_graph.inspect.verdict import quality_line
from sst_graph.simulator import SimulationConfig
from sst_graph.types import CameraImage, Guess, Scan, SemanticClass
from studies.edges_streets import source_of, start_step

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
STREET = SimulationConfig(seed=504, frames=12, motion="no_stop", azimuth_limit_deg=50.0, time_offset_s=0.05)
AWAY = np.array([0.03, -0.04, 0.03, 0.05, -0.04, 0.06])


def no_mask(image: CameraImage) -> CameraImage:
    return dataclasses.replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE), instances=None)


def no_classes(scan: Scan) -> Scan:
    return dataclasses.replace(scan, classes=np.full_like(scan.classes, SemanticClass.IGNORE), instances=None)


@cache
def labelled() -> KeptDrive:
    return KeptDrive.of(simulated(STREET), sweep="known")


@cache
def unlabelled() -> KeptDrive:
    return labelled().with_images(no_mask).with_scans(no_classes)


@pytest.mark.slow
def test_auto_takes_labels_where_both_sensors_have_some() -> None:
    config = CalibrationConfig()
    assert config.method == "auto"
    drives = {
        "joint": [labelled()],
        "edges": [unlabelled(), labelled().with_images(no_mask), labelled().with_scans(no_classes)],
    }
    for method, sources in drives.items():
        for source in sources:
            assert with_method_for(config, [source]).method == method
    assert with_method_for(config, [labelled(), unlabelled()]).method == "both"
    chosen = CalibrationConfig(method="joint")
    assert with_method_for(chosen, [unlabelled()]) is chosen


@pytest.fixture(scope="module")
def result():  # type: ignore[no-untyped-def]
    return calibrate(unlabelled(), unlabelled().truth.cTl.retract(AWAY))  # type: ignore[union-attr]


@pytest.mark.slow
def test_around_the_inverse_of_an_upright_start_nothing_is_searched() -> None:
    nominal, no_drive = unlabelled().nominal, cast(Drive, None)
    assert nominal is not None
    on_its_side = gtsam.Pose3(gtsam.Rot3.Rz(1.6), np.zeros(3)) * nominal
    for start in (nominal, on_its_side, None):
        assert inverted_start([no_drive], Guess(start, 0.0), CalibrationConfig(method="edges")) is None


@pytest.mark.slow
def test_an_inverted_start_is_named() -> None:
    nominal = unlabelled().nominal
    assert nominal is not None
    first, *others = calibrate(unlabelled(), nominal.inverse()).reasons
    assert first.startswith("the start (Tr) is inverted (around its inverse edges")
    assert any("no edge matches" in reason or "near an edge of the picture" in reason for reason in others)


@pytest.mark.slow
def test_a_street_without_labels(result) -> None:  # type: ignore[no-untyped-def]
    truth = unlabelled().truth
    assert truth is not None
    errors = errors_of(result, truth)
    assert result.method == "edges" and result.config["method"] == "edges"
    assert result.status == "ok"
    assert errors.qad_deg < 0.4 and errors.atd_m < 0.06
    assert errors.time_offset_s is not None and abs(errors.time_offset_s) < 0.01
    assert errors.nees is not None and errors.nees.joint < 3.0 * 7


@pytest.mark.slow
def test_its_fit_is_measured(result) -> None:  # type: ignore[no-untyped-def]
    """What a report draws, and, of it, what stands in calibration.json."""
    fit = result.fit
    assert fit is not None and fit.by_edges and len(fit.profiles) == 7
    assert fit.quality.share > 1.5 * fit.quality.by_chance
    assert FitQuality.from_diagnostics(result.diagnostics) == fit.quality
    assert quality_line(fit.quality) in summary(result)
    # From the start, on some scans, to all: the last iteration is the result.
    assert fit.iterations[0].kernel_px > fit.iterations[-1].kernel_px
    assert fit.iterations[-1].cTl.equals(result.T_camera_lidar, 1e-9)


@pytest.mark.slow
def test_labels_hardly_matter(result) -> None:  # type: ignore[no-untyped-def]
    """By edges; masks still keep the features of vehicles out of visual odometry."""
    truth = labelled().truth
    assert truth is not None
    other = calibrate(labelled(), truth.cTl.retract(AWAY), CalibrationConfig(method="edges"))
    step = gtsam.Pose3.Logmap(result.T_camera_lidar.between(other.T_camera_lidar))
    assert np.degrees(np.linalg.norm(step[:3])) < 0.05 and np.linalg.norm(step[3:]) < 0.01


@pytest.mark.slow
def test_pictures_of_another_street_are_refused() -> None:
    other = simulated(dataclasses.replace(STREET, seed=77))
    pictures = [frame.image.pixels for frame in other if frame.image is not None]
    stamps = [frame.image.stamp_ns for frame in unlabelled() if frame.image is not None]

    def exchanged(image: CameraImage) -> CameraImage:
        return dataclasses.replace(image, pixels=pictures[stamps.index(image.stamp_ns)])

    wrong = unlabelled().with_images(exchanged)
    assert wrong.truth is not None
    result = calibrate(wrong, wrong.truth.cTl)
    assert result.status != "ok"
    assert any("agree hardly better" in reason for reason in result.reasons)


def test_without_a_guess_and_without_motion_nothing_is_claimed() -> None:
    small = simulated(dataclasses.replace(STREET, frames=2, width=414, height=125, azimuth_step_deg=0.5))
    short = KeptDrive.of(small, sweep="known").with_images(no_mask).with_scans(no_classes)
    result = calibrate(short, None)
    assert result.status == "unobservable"
    assert "a start is needed" in result.reasons[0]


@pytest.mark.slow
def test_a_false_optimum_in_pitch_is_left() -> None:
    """On this street the search ends 1.6 deg and 21 cm off, in pitch and height, with half of the truth's
    score."""
    name = "own-543"
    street = source_of(name)
    assert street.truth is not None
    start = street.truth.cTl.retract(start_step(name))
    result = calibrate(street, start, CalibrationConfig(method="edges", check_contradictions=False))
    assert result.status == "ok"
    errors = errors_of(result, street.truth)
    assert errors.qad_deg < 0.3 and errors.atd_m < 0.03


@pytest.mark.slow
@pytest.mark.drives
@pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared")
@pytest.mark.parametrize(
    ("name", "shift", "deg", "metres", "seconds"),
    [("stop", 1, 0.2, 0.03, 0.015), ("parked", 1, 0.2, 0.05, 0.012)],
)
def test_real_drives_without_label_files(
    name: str, shift: int, deg: float, metres: float, seconds: float, tmp_path: Path
) -> None:
    """Only clouds, pictures, stamps and intrinsics are there."""
    without_label_files(DATA / f"kitti_2011_09_26_{name}", tmp_path)
    drive = open_source(tmp_path, image_shift=shift)
    assert drive.truth is not None
    start = drive.truth.cTl.retract(np.array([*np.radians([3.0, -4.0, 2.5]), 0.06, -0.08, 0.05]))
    result = calibrate(drive, start)
    assert result.method == "edges" and result.status == "ok"
    errors = errors_of(result, drive.truth)
    assert errors.qad_deg < deg and errors.atd_m < metres
    assert errors.time_offset_s is not None and abs(errors.time_offset_s) < seconds
