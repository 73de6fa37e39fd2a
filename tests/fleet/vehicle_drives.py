"""Estimates of the drives of a vehicle whose calibration is known, with errors as their covariances say."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.fleet.vehicles.walk import DriveEstimate, WalkConfig
from sst_graph.marginal import CalibrationMarginal, Common

FloatArray = NDArray[np.float64]

FORWARD = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
RIG = gtsam.Pose3(FORWARD, np.array([0.06, -0.08, -0.27]))
SIGMAS = np.array([*np.radians([0.06, 0.10, 0.09]), 0.014, 0.016, 0.006, 0.005])
WEEK = 7.0


def vehicle(
    rng: np.random.Generator,
    steps: dict[int, FloatArray],
    wrong: dict[int, FloatArray] | None = None,
    count: int = 8,
    config: WalkConfig | None = None,
    lens: Mapping[str, FloatArray] | None = None,
) -> list[DriveEstimate]:
    """One drive a week.

    Args:
        steps: (7,) by the number of the first drive after it.
        wrong: (7,) error of single drives beyond what they claim.
        config: of the true random walk.
        lens: (7,) step of every drive by one deviation of each error that all have in common.
    """
    config = WalkConfig() if config is None else config
    rates = np.repeat(
        [np.radians(config.rotation_deg), config.translation_m, config.time_offset_s], [3, 3, 1]
    )
    cTl, time_offset_s = RIG, 0.02
    lens = {} if lens is None else lens
    shift = sum((rng.normal() * step for step in lens.values()), np.zeros(7))
    drives = []
    for k in range(count):
        way = rng.normal(size=7) * rates * np.sqrt(WEEK) if k else np.zeros(7)
        way = way + steps.get(k, np.zeros(7))
        cTl, time_offset_s = cTl.retract(way[:6]), time_offset_s + way[6]
        mixing = (np.eye(7) + 0.3 * rng.normal(size=(7, 7))) * SIGMAS[:, None]
        covariance = rng.uniform(0.5, 3.0) * mixing @ mixing.T
        error = rng.multivariate_normal(np.zeros(7), covariance) + (wrong or {}).get(k, np.zeros(7)) + shift
        information = np.linalg.inv(covariance + sum(np.outer(s, s) for s in lens.values()))
        at = cTl.retract(error[:6]), time_offset_s + error[6]
        marginal = CalibrationMarginal(*at, information, np.zeros(7), common=Common(lens))
        drives.append(DriveEstimate(f"drive_{k}", WEEK * k, marginal))
    return drives


def step(**sizes: float) -> FloatArray:
    """(7,) a step, by ``pitch_deg`` (about the LiDAR's y), ``yaw_deg`` (about its z), ``forward_m``,
    ``offset_s``."""
    found = np.zeros(7)
    found[1] = np.radians(sizes.get("pitch_deg", 0.0))
    found[2] = np.radians(sizes.get("yaw_deg", 0.0))
    found[3] = sizes.get("forward_m", 0.0)
    found[6] = sizes.get("offset_s", 0.0)
    return found
