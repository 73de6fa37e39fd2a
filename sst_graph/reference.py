"""A calibration read from a file of any format of :mod:`sst_graph.imports`, as a start or as the truth."""

from __future__ import annotations

from pathlib import Path

from sst_graph.imports import ImportOptions, import_calibration
from sst_graph.types import Calibration, GroundTruth


def read_reference(path: Path, camera: str | None = "image_2") -> GroundTruth:
    """The calibration of ``camera`` (None: of the only one) in a file; its format is recognized by the
    contents.

    The offset is the file's [s], where it says one; a KITTI ``calib.txt`` has none.

    Raises:
        DataError: a missing or unreadable file, one of no known format, or without a usable pose.
        ConfigError: a ``calib.txt``, and ``camera`` is no KITTI camera.
        EstimationError: a marginal that leaves a direction open.
        MissingDependencyError: a YAML file, and PyYAML is not installed.
    """
    imported = import_calibration(path, ImportOptions(camera=camera))
    return GroundTruth(imported.cTl, imported.time_offset_s)


def load_initial(path: Path, camera: str | None = "image_2") -> Calibration:
    """Start of a calibration from a file; the time offset is 0 where the file has none.

    Raises:
        DataError, ConfigError, EstimationError, MissingDependencyError: as :func:`read_reference`.
    """
    reference = read_reference(path, camera)
    return Calibration(reference.cTl, reference.time_offset_s or 0.0)
