"""How far one calibration is from another: QAD, AEAD, ATD, time error, NEES.

QAD, AEAD and ATD are the metrics of SST-Calib (Kodaira et al., ITSC 2022). Conventions: :mod:`factors`.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.errors import DataError
from sst_graph.files.checked_values import MAX_SIGMA
from sst_graph.types import FloatArray, GroundTruth

FORWARD_R_OPTICAL = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Optical camera axes (x right, y down, z forward) turned to vehicle axes (x forward, y left, z up)."""
LINK_FROM_OPTICAL = gtsam.Pose3(FORWARD_R_OPTICAL, np.zeros(3))
"""Camera link (x forward, y left, z up) from the optical frame (x right, y down, z forward): REP 103."""


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared: e' P^-1 e, of the whole and of its parts.

    Where the covariance holds, the means over runs are 7, 3, 3 and 1.

    Attributes:
        joint: over all seven unknowns, or the six of the pose where the true offset is not known.
        rotation, translation: over the three rotation or translation unknowns, marginally.
        time_offset: over the offset alone, or None where its truth is not known.
    """

    joint: float
    rotation: float
    translation: float
    time_offset: float | None


@dataclass(frozen=True)
class TruthSigma:
    """How well a reference is known itself; standard deviations along each axis, without correlation.

    Attributes:
        rotation_deg: [deg].
        translation_m: [m].
        time_offset_s: [s].
    """

    rotation_deg: float
    translation_m: float
    time_offset_s: float

    def __post_init__(self) -> None:
        for name in ("rotation_deg", "translation_m", "time_offset_s"):
            if not 0.0 <= getattr(self, name) <= MAX_SIGMA:
                raise DataError(f"truth sigma: {name}", f"{getattr(self, name):g}", f"0 to {MAX_SIGMA:g}")

    @property
    def covariance(self) -> FloatArray:
        """(7, 7) in the order of a result's covariance."""
        sigmas = [np.radians(self.rotation_deg)] * 3 + [self.translation_m] * 3 + [self.time_offset_s]
        return np.diag(np.square(sigmas))


@dataclass(frozen=True)
class CalibrationErrors:
    """Errors of an estimate against the truth.

    Attributes:
        qad_deg: angle of the rotation between the two [deg].
        aead_deg: mean absolute difference of roll, pitch and yaw [deg].
        atd_m: mean absolute difference of x, y and z [m].
        time_offset_s: estimate - truth [s], or None where the truth is not known.
        nees: against the estimate's covariance, or None where it brings none.
    """

    qad_deg: float
    aead_deg: float
    atd_m: float
    time_offset_s: float | None
    nees: Nees | None


def quaternion_angle_deg(estimate: gtsam.Rot3, truth: gtsam.Rot3) -> float:
    """QAD = 2 arccos|p . q| of the two unit quaternions, in degrees, within [0, 180].

    Evaluated as the length of Log(p^-1 q): the same number, without the loss of arccos near 1 (1e-8 rad).
    """
    return float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(estimate.between(truth)))))


def turn_rad(a: gtsam.Pose3, b: gtsam.Pose3) -> float:
    """Angle between the rotations of two poses [rad]."""
    return float(np.linalg.norm(gtsam.Rot3.Logmap(a.rotation().between(b.rotation()))))


def euler_angles_deg(cRl: gtsam.Rot3) -> FloatArray:
    """(3,) roll, pitch, yaw [deg] of the LiDAR in the camera turned to vehicle axes.

    R = Rz(yaw) Ry(pitch) Rx(roll). The camera's optical axes are turned first to x forward, y left, z up
    (the LiDAR's usual axes): on optical axes a forward-looking pair stands in the gimbal lock.
    """
    return np.degrees(FORWARD_R_OPTICAL.compose(cRl).rpy())


def mean_euler_difference_deg(estimate: gtsam.Rot3, truth: gtsam.Rot3) -> float:
    """AEAD: mean absolute difference of :func:`euler_angles_deg`, each wrapped to +-180 degrees."""
    difference = euler_angles_deg(estimate) - euler_angles_deg(truth)
    return float(np.mean(np.abs((difference + 180.0) % 360.0 - 180.0)))


def mean_translation_difference_m(estimate: gtsam.Pose3, truth: gtsam.Pose3) -> float:
    """ATD: mean absolute difference of the x, y, z of T_camera_lidar [m]."""
    return float(np.mean(np.abs(estimate.translation() - truth.translation())))


def tangent_error(estimate: gtsam.Pose3, truth: gtsam.Pose3, time_error_s: float = 0.0) -> FloatArray:
    """(7,) e with truth = estimate . Exp(e[:6]) and e[6] = true - estimated offset [rad, m, s]."""
    xi = gtsam.Pose3.Logmap(estimate.between(truth))
    return np.append(np.asarray(xi, dtype=np.float64), -time_error_s)


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """e' P^-1 e of error (n,) against covariance (n, n), evaluated in units of the sigmas.

    Raises:
        DataError: the covariance is not positive definite.
    """
    root, sigmas = root_and_sigmas(covariance)
    return float(np.sum(np.linalg.solve(root, error / sigmas) ** 2))


def root_and_sigmas(covariance: FloatArray, place: str = "covariance") -> tuple[FloatArray, FloatArray]:
    """Cholesky factor (n, n) of the correlations of a covariance (n, n), and its sigmas (n,).

    Raises:
        DataError: the covariance is not positive definite.
    """
    sigmas = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    try:
        return np.linalg.cholesky(covariance / np.outer(sigmas, sigmas)), sigmas
    except np.linalg.LinAlgError:
        raise DataError(place, "a matrix that is not positive definite", "a covariance") from None


def calibration_errors(
    cTl: gtsam.Pose3,
    time_offset_s: float,
    truth: GroundTruth,
    covariance: FloatArray | None = None,
    truth_sigma: TruthSigma | None = None,
) -> CalibrationErrors:
    """Every metric of an estimate (cTl, time_offset_s [s], covariance (7, 7)) against the truth.

    Args:
        truth_sigma: of a truth that is a reference, known with an error of its own: the NEES is then that of
            their difference, e' (P + P_truth)^-1 e. None where the truth is exact.

    Raises:
        DataError: the covariance is not positive definite.
    """
    if covariance is not None and truth_sigma is not None:
        covariance = covariance + truth_sigma.covariance
    time_error = None if truth.time_offset_s is None else time_offset_s - truth.time_offset_s
    return CalibrationErrors(
        qad_deg=quaternion_angle_deg(cTl.rotation(), truth.cTl.rotation()),
        aead_deg=mean_euler_difference_deg(cTl.rotation(), truth.cTl.rotation()),
        atd_m=mean_translation_difference_m(cTl, truth.cTl),
        time_offset_s=time_error,
        nees=None if covariance is None else _nees_of_parts(cTl, truth.cTl, time_error, covariance),
    )


def _nees_of_parts(
    cTl: gtsam.Pose3, true_cTl: gtsam.Pose3, time_error_s: float | None, covariance: FloatArray
) -> Nees:
    """NEES of the whole, and of rotation, translation and offset each by its marginal."""
    error = tangent_error(cTl, true_cTl, 0.0 if time_error_s is None else time_error_s)

    def part(first: int, end: int) -> float:
        return nees(error[first:end], covariance[first:end, first:end])

    known = 6 if time_error_s is None else 7
    return Nees(part(0, known), part(0, 3), part(3, 6), None if time_error_s is None else part(6, 7))
