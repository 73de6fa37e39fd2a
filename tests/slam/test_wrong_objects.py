"""The calibration in a user's own graph refuses what is no argument of it, in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from alignment_streets import D, E, X, simulated_street
from wrong_objects import POSE, check_refusals

import sst_graph
from sst_graph import AlignmentKeys, AlignmentTerm, CalibrationMarginal, CameraCalibration, ScanMotion
from sst_graph.slam.align import VEHICLES
from sst_graph.slam.config import RematchConfig

FITS: dict[str, set[str]] = {
    "cTl": {"Pose3", "int"},
    "time_offset_s": {"int", "float"},
    "bTl": {"Pose3", "None"},
    "T_camera_reference": {"Pose3"},
    "biases_px": {"dict"},
    "camera": {"text"},
    "config": {"None"},
    "reference": {"text"},
    "rotation_sigma_deg": {"int", "float"},
    "translation_sigma_m": {"int", "float"},
    "poses": {"empty"},
    "one_trigger": {"True"},
    "classes": {"empty"},
    "E_key": {"int"},
    "D_key": {"int"},
    "l_twist": set(),
    "l_acceleration": {"None"},
    "l_velocities": {"dict"},
    "lTs": {"Pose3"},
    "from_ns": {"int", "negative"},
    "kernel_px": {"int", "float"},
    "information": {"int", "float"},
    "AlignmentTerm.camera": set(),
    "AlignmentTerm.l_velocities": {"empty"},
    "CameraCalibration.cTl": {"Pose3"},
    "CameraCalibration.camera": set(),
    "CameraCalibration.time_offset_s": {"int", "negative", "float"},
}
"""Which of the wrong objects are right after all: by name of the argument, or of function and argument."""


@pytest.fixture(scope="module")
def right() -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Every function with arguments that fit."""
    street = simulated_street(5)
    graph, values = street.whole(street.start(1))
    keys = AlignmentKeys(street.trajectory(), E, D)
    terms = [street.term(2, keys)]
    matches = [terms[0].matched(values, 40.0)]
    assert matches[0].factor is not None
    matched = gtsam.NonlinearFactorGraph(graph)
    matched.add(matches[0].factor)
    calibration = CameraCalibration(street.camera, street.cTl, 0.1)
    motion = ScanMotion(np.zeros(6), lTs=POSE, from_ns=0)
    marginal = CalibrationMarginal(POSE, 0.1, np.eye(7), np.zeros(7))
    scan, image = street.scans[2], street.images[2]
    term = {"scans": [scan], "image": image, "camera": street.camera, "keys": keys}
    term |= {"config": terms[0].config, "l_velocities": ()}
    solved = {"graph": graph, "values": values, "config": RematchConfig()}
    named = {"camera": "b", "reference": "a", "T_camera_reference": POSE}
    sigmas = {"rotation_sigma_deg": 0.1, "translation_sigma_m": 0.1}
    moving = {"l_twist": np.zeros(6), "l_acceleration": np.zeros(6), "l_velocities": {}}
    return {
        "Trajectory": (sst_graph.Trajectory, {"keys": [X(0)], "stamps_ns": [0]}),
        "AlignmentKeys": (
            AlignmentKeys,
            {"trajectory": keys.trajectory, "cTl": E, "time_offset_s": D, "biases_px": {}, "bTl": POSE},
        ),
        "AlignmentTerm": (AlignmentTerm, term),
        "IncrementalTerms": (
            sst_graph.IncrementalTerms,
            {"solver": gtsam.ISAM2(), "keys": keys, "config": RematchConfig()},
        ),
        "solve_with_terms": (sst_graph.solve_with_terms, {"terms": terms, **solved}),
        "calibration_covariance": (
            sst_graph.calibration_covariance,
            {"matches": matches, **solved, "graph": matched},
        ),
        "AlignmentTerm.matched": (
            terms[0].matched,
            {"values": values, "kernel_px": 40.0, "information": 0.5},
        ),
        "AlignmentTerm.place": (terms[0].place, {"values": values}),
        "TermMatches.moved_px": (matches[0].moved_px, {"values": values}),
        "TermMatches.predicted_sigma_px": (
            matches[0].predicted_sigma_px,
            {"values": values, "covariance": np.eye(7)},
        ),
        "CameraCalibration": (
            CameraCalibration,
            {"camera": street.camera, "cTl": POSE, "time_offset_s": 0.1, "biases_px": {}},
        ),
        "ScanMotion": (ScanMotion, {**moving, "lTs": POSE, "from_ns": 0}),
        "FrameMatching": (
            sst_graph.FrameMatching,
            {"classes": (), "kernel": sst_graph.FrameMatching().kernel, "config": None},
        ),
        "align_frame": (
            sst_graph.align_frame,
            {"scan": scan, "image": image, "calibration": calibration, "motion": motion},
        ),
        "follow_objects": (sst_graph.follow_objects, {"scans": [scan], "wTls": [POSE], "classes": VEHICLES}),
        "KnownPose": (sst_graph.KnownPose, {**named, **sigmas}),
        "KnownRig": (sst_graph.KnownRig, {"poses": (), "one_trigger": True}),
        "marginal.factor": (marginal.factor, {"E_key": E, "D_key": D}),
        "marginal.point": (marginal.point, {"E_key": E, "D_key": D}),
        "marginal.to_json": (marginal.to_json, {"E_key": E, "D_key": D}),
        "marginal.plus": (marginal.plus, {"other": marginal}),
    }


def test_what_is_no_argument_is_refused_in_one_sentence(
    right: dict[str, tuple[Callable[..., Any], dict[str, Any]]],
) -> None:
    def in_one_sentence(said: str) -> None:
        assert "found" in said and "expected" in said and len(said) < 300, said

    for name, (call, arguments) in right.items():
        check_refusals(name, call, arguments, FITS, in_one_sentence)
