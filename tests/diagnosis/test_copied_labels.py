"""Points that were labelled by the masks repeat the pose by which they were projected."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import copied_labels
import gtsam
import numpy as np
import pytest
from copied_labels import labelled_by_mask

from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.diagnosis.labels import copied
from sst_graph.drive.preparation import Drive
from sst_graph.types import Guess, SemanticClass

CLASSES = (SemanticClass.VEHICLE,)
CAUSE = "the labels of the clouds and of the pictures are copies of each other"
AWAY = np.array([0.005, -0.004, 0.004, 0.03, -0.02, 0.02])


@cache
def street(frames: int = 8) -> KeptDrive:
    """Exact labels that were made apart: what agrees best without being copied."""
    return copied_labels.street(frames, label_noise=0.0)


def labelled_by_masks(drive: KeptDrive, cTl: gtsam.Pose3, round_down: bool) -> KeptDrive:
    """The drive with each point's class read from the mask at its pixel."""
    frames = (labelled_by_mask(frame, drive.camera, cTl, round_down) for frame in drive.frames)
    return replace(drive, frames=tuple(frames))


def prepared(drive: KeptDrive) -> Drive:
    return prepare_drives([drive], CalibrationConfig(decide_sweep=False))[0]


@pytest.mark.parametrize("round_down", [False, True])
def test_points_that_were_labelled_by_the_masks_are_named(round_down: bool) -> None:
    assert street().truth is not None
    start = street().truth.cTl.retract(AWAY)
    drive = prepared(labelled_by_masks(street(), start, round_down))
    found = copied(drive, Guess(start), CLASSES)
    assert found is not None and found.sentence.startswith(CAUSE) and "only 0.0 % are" in found.evidence
    # Where they were made with another pose, or it is not known, they are no copies by the start.
    assert copied(drive, Guess(street().truth.cTl), CLASSES) is None
    assert copied(drive, Guess(None), CLASSES) is None


def test_exact_labels_that_start_at_the_truth_are_no_copies() -> None:
    assert street().truth is not None
    assert copied(prepared(street()), Guess(street().truth.cTl), CLASSES) is None


def test_vehicles_that_lie_within_larger_masks_are_no_copies() -> None:
    """No vehicle's point beside its border is outside of the mask; points of the ground are inside of it."""
    assert street().truth is not None
    start = street().truth.cTl
    drive = prepared(labelled_by_masks(street(), start, False))

    def drawn_larger(mask: np.ndarray) -> np.ndarray:
        larger = mask.copy()
        for step in (1, 2):
            larger[:, step:][mask[:, :-step] == SemanticClass.VEHICLE] = SemanticClass.VEHICLE
        return larger

    images = tuple(replace(image, mask=drawn_larger(image.mask)) for image in drive.images)
    assert copied(replace(drive, images=images), Guess(start), CLASSES) is None


@pytest.mark.slow
def test_a_result_by_copied_labels_is_not_ok() -> None:
    """It is the start, with small sigmas."""
    whole = street(30)
    assert whole.truth is not None
    start = whole.truth.cTl.retract(2.0 * AWAY)
    result = calibrate(labelled_by_masks(whole, start, False), start)
    assert result.status == "not_converged" and result.reasons[0].startswith(CAUSE)
