"""Findings from the difference between result and start."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from sst_graph.diagnosis.finding import OF_LINK, Finding
from sst_graph.diagnosis.fit import LabelFit
from sst_graph.metrics import FORWARD_R_OPTICAL, quaternion_angle_deg
from sst_graph.types import FloatArray

_SEQUENCES = ("xyz", "zyx", "XYZ", "ZYX", "yxz", "YXZ", "zxy", "ZXY")
"""Orders in which roll, pitch and yaw are applied."""
_SEARCHED_DEG = 35.0
"""A start nearer than this to the result is good enough for the search [deg]."""
_NEAR_DEG, _DESIGN_DEG = 5.0, 15.0
"""A start within this of a wrong conversion is one; a rig's axes are within this of a right angle [deg]."""
_BASELINE_M, _ALIGNED_DEG, _SIGMAS = (0.25, 1.5), 3.0, 6.0
"""Stereo baselines of vehicles [m], how parallel the two cameras are [deg], and the least certainty."""
_SIDEWAYS = 0.9
"""Cosine to the camera's x axis."""


def wrong_start(guess: gtsam.Pose3, free: LabelFit | None) -> Finding | None:
    """A start that is turned farther away from where the labels agree than is searched around it.

    Args:
        free: what a search without a start finds, for certain.
    """
    if free is None:
        return None
    turned = quaternion_angle_deg(guess.rotation(), free.cTl.rotation())
    if turned < _SEARCHED_DEG:
        return None
    share = 100.0 * free.explained
    general = Finding(
        "the start (Tr) is wrong",
        f"the labels agree {turned:.0f} deg away from it, where {share:.0f} % of the outlines meet",
        "correct it, or calibrate with --init none",
    )
    return start_finding(guess, free, general)


def start_finding(guess: gtsam.Pose3, found: LabelFit, finding: Finding) -> Finding:
    """The finding, unless the start's angles were just taken in the wrong unit, or its axes are a link's."""
    start, right = guess.rotation(), found.cTl.rotation()
    link_deg = quaternion_angle_deg(FORWARD_R_OPTICAL.inverse() * start, right)
    known = [(link_deg, *OF_LINK)]
    for factor, unit, other in (
        (np.pi / 180.0, "radians", "degrees"),
        (180.0 / np.pi, "degrees", "radians"),
    ):
        cause = f"the angles of the start (Tr) are {unit} that were taken as {other}"
        check = "convert them before the rotation is made"
        known.append((_converted_deg(start, right, factor), cause, check))
    nearest_deg, cause, check = min(known)
    return replace(finding, cause=cause, check=check) if nearest_deg < _NEAR_DEG else finding


def other_camera(
    guess: gtsam.Pose3 | None, result: gtsam.Pose3, covariance: FloatArray, by_labels: bool = True
) -> Finding | None:
    """A result that is parallel to the start and shifted sideways by a stereo baseline: the images are of the
    other camera.

    Args:
        covariance: (7, 7) of the result.
        by_labels: the result is by masks, not by what the pictures show.
    """
    if guess is None or quaternion_angle_deg(guess.rotation(), result.rotation()) > _ALIGNED_DEG:
        return None
    way = result.translation() - guess.translation()
    length = float(np.linalg.norm(way))
    if not _BASELINE_M[0] < length < _BASELINE_M[1] or abs(way[0]) < _SIDEWAYS * length:
        return None
    across = result.rotation().matrix()[0]
    sigma = float(np.sqrt(across @ covariance[3:6, 3:6] @ across))
    if abs(way[0]) < _SIGMAS * sigma:
        return None
    side = "right" if way[0] < 0.0 else "left"
    compared = "the masks (or the pictures with them)" if by_labels else "the pictures"
    folder = "masks, and that of the pictures," if by_labels else "pictures"
    return Finding(
        f"{compared} are those of another camera, {100.0 * abs(way[0]):.0f} cm to the {side}",
        f"along the camera's x axis the start is {-100.0 * way[0]:+.0f} +- {100.0 * sigma:.0f} cm off",
        f"compare the folder of the {folder} with the camera (P0 to P3) of the calibration",
    )


def _converted_deg(guess: gtsam.Rot3, found: gtsam.Rot3, factor: float) -> float:
    """How far the start is from the found rotation with its angles times a factor [deg].

    They are angles of a rig as designed, in right angles: in the wrong unit a degree more is a radian more.
    """
    nearest = 180.0
    for inverse, sequence in product((False, True), _SEQUENCES):
        R = found.matrix().T if inverse else found.matrix()
        with warnings.catch_warnings():
            # At a gimbal lock any of the angles will do.
            warnings.simplefilter("ignore", UserWarning)
            angles = Rotation.from_matrix(_right_angled(R)).as_euler(sequence)
        right = 0.5 * np.pi * np.round(angles / (0.5 * np.pi))
        wrong = Rotation.from_euler(sequence, right * factor).as_matrix()
        nearest = min(nearest, quaternion_angle_deg(gtsam.Rot3(wrong.T if inverse else wrong), guess))
    return nearest


def _right_angled(R: FloatArray) -> FloatArray:
    """The nearest rotation by right angles, if it is near; R itself otherwise."""
    rounded = np.zeros((3, 3))
    rows = np.abs(R).argmax(axis=1)
    rounded[np.arange(3), rows] = np.sign(R[np.arange(3), rows])
    if len(set(rows.tolist())) < 3 or np.linalg.det(rounded) < 0.0:
        return R
    near = quaternion_angle_deg(gtsam.Rot3(rounded), gtsam.Rot3.ClosestTo(R)) < _DESIGN_DEG
    return rounded if near else R
