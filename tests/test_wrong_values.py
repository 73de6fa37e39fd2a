"""Results, rigs and options of any type: accepted, or refused by one of the package's errors."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import gtsam
import numpy as np
import pytest
from calibrations import turned
from rigs import marginal_of
from rigs import result_of as rig_result_of

from sst_graph import CalibrationResult, inspect_result, open_source, read_result, read_rig
from sst_graph.data.source import SourceOptions
from sst_graph.errors import ConfigError, SstGraphError

WRONG_VALUES: list[Any] = [
    None,
    3,
    "x",
    b"x",
    [],
    {},
    np.zeros(3),
    float("nan"),
    (1, 2),
    print,
    gtsam.Pose3(),
]


@pytest.mark.parametrize("wrong", WRONG_VALUES, ids=lambda value: type(value).__name__)
def test_values_of_any_type_in_results(wrong: Any) -> None:
    """Accepted, or refused by one of the package's errors; nothing else."""
    result = turned(3)
    rig = rig_result_of(marginal_of(2))
    options = SourceOptions()
    for record in (result, rig, options):
        for field in dataclasses.fields(record):
            if field.init:
                with contextlib.suppress(SstGraphError):
                    dataclasses.replace(record, **{field.name: wrong})
    for call in (
        lambda: inspect_result(result, wrong),
        lambda: CalibrationResult.from_json(wrong),
        lambda: open_source(".", loader=wrong),
        lambda: read_result(wrong),
        lambda: read_rig(wrong),
    ):
        with contextlib.suppress(SstGraphError):
            call()


def test_what_results_refuse() -> None:
    result = turned(3)
    for change, message in (
        ({"T_camera_lidar": np.eye(4)}, r"T_camera_lidar: found .*, expected a gtsam.Pose3"),
        ({"covariance": np.eye(7).tolist()}, r"covariance: found .*, expected an array of numbers of shape"),
        ({"status": np.zeros(3)}, "status"),
        ({"reasons": ("one", 2)}, "one of reasons: found 2, expected a str"),
        ({"camera": "image_2"}, "camera: found the text 'image_2', expected a PinholeCamera"),
    ):
        with pytest.raises(SstGraphError, match=message):
            dataclasses.replace(result, **change)
    with pytest.raises(ConfigError, match="next_frames: found the text 'ten', expected at least 1"):
        inspect_result(result, "ten")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="loader: found 5, expected the name"):
        open_source(".", loader=5)  # type: ignore[arg-type]
