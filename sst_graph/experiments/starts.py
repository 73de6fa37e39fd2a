"""The truth of a drive, wrong starts around it, and errors against it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np

from sst_graph.data import open_source
from sst_graph.data.info.needed_labels import missing_labels
from sst_graph.errors import ConfigError, DataError
from sst_graph.metrics import CalibrationErrors, calibration_errors
from sst_graph.result import CalibrationResult
from sst_graph.simulator import simulate
from sst_graph.types import Calibration, FloatArray, GroundTruth, Source


def truth_of(source: Source) -> GroundTruth:
    """The reference calibration of a drive.

    Raises:
        ConfigError: it brings none.
    """
    if source.truth is None:
        raise ConfigError(f"{source.name}: found no reference calibration, expected one")
    return source.truth


def expect_labels(source: Source, methods: Iterable[str]) -> None:
    """Require the labels that methods need: without them every run would count as a failure of the method.

    Raises:
        DataError: a method lacks them, or a frame cannot be read.
    """
    for method in methods:
        if missing := missing_labels([source], method):
            expected = f"both for method {method}, beside the drive (docs/reference/formats.md)"
            raise DataError(source.name, f"no {' and no '.join(missing)}", expected)


def start_near(cTl: gtsam.Pose3, half_deg: float, half_m: float, rng: np.random.Generator) -> gtsam.Pose3:
    """The extrinsic with an error uniform by axis within half widths [deg], [m], in its tangent space."""
    turn = np.radians(half_deg) * rng.uniform(-1.0, 1.0, 3)
    return cTl.retract(np.concatenate([turn, half_m * rng.uniform(-1.0, 1.0, 3)]))


def drive_of(place: str, number: int, config: Any) -> Source:
    """The drive in a folder, or the street of a number where there is none.

    Args:
        config: of an experiment, with ``image_shift`` for folders, and ``street`` and ``seed`` for streets.
    """
    if place:
        return open_source(place, image_shift=config.image_shift)
    return simulate(dataclasses.replace(config.street, seed=config.seed + number))


def errors_of(result: CalibrationResult, truth: GroundTruth) -> CalibrationErrors:
    """Errors of a result, and its NEES."""
    return calibration_errors(result.T_camera_lidar, result.time_offset_s, truth, result.covariance)


def error_of(estimate: Calibration, truth: GroundTruth) -> FloatArray:
    """(7,) estimate less truth in the tangent space of the estimate, as its covariance [rad, m, s].

    An unknown true offset is 0.
    """
    return -estimate.local_coordinates(Calibration(truth.cTl, truth.time_offset_s or 0.0))
