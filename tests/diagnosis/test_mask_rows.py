"""Ground above the sky is a fault of the masks, unless the camera is mounted so by the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.diagnosis.labels import mask_rows
from sst_graph.drive.preparation import Drive
from sst_graph.types import Guess


def drive(rows: Callable[[float], float]) -> Drive:
    """A street whose mean rows, as shares of the height, are others."""
    plain = prepared_street()
    assert plain.statistics is not None
    images = tuple(
        replace(image, rows={c: rows(row) for c, row in image.rows.items()})
        for image in plain.statistics.images
    )
    return replace(plain, statistics=replace(plain.statistics, images=images))


def upside_down(row: float) -> float:
    return 1.0 - row


def as_taken(row: float) -> float:
    return row


def start(roll_deg: float) -> Guess:
    """The true extrinsic of a camera that is turned about its own axis."""
    roll = gtsam.Pose3(gtsam.Rot3.Rz(np.radians(roll_deg)), np.zeros(3))
    return Guess(roll * standing_street().truth.cTl)


@pytest.mark.parametrize("roll_deg", [160.0, 180.0, -150.0])
def test_a_camera_that_is_mounted_upside_down_is_no_fault(roll_deg: float) -> None:
    assert mask_rows(drive(upside_down), start(roll_deg)) is None


@pytest.mark.parametrize("guess", [start(0.0), start(20.0), Guess(None)])
def test_pictures_upside_down_are_named(guess: Guess) -> None:
    found = mask_rows(drive(upside_down), guess)
    assert found is not None and "upside down" in found.cause and " above " in found.evidence
    assert mask_rows(drive(as_taken), guess) is None


def test_upright_pictures_of_a_camera_that_is_said_to_hang_are_named() -> None:
    found = mask_rows(drive(as_taken), start(180.0))
    assert found is not None and " below " in found.evidence


@pytest.mark.parametrize("rows", [as_taken, upside_down])
def test_rows_of_a_camera_on_its_side_say_nothing(rows: Callable[[float], float]) -> None:
    assert mask_rows(drive(rows), start(90.0)) is None
