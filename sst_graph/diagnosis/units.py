"""Units and axes of clouds and the start."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.input_statistics import Ground, InputStatistics
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.types import FloatArray

_CAR_HEIGHT_M, _HIGHEST_CAR_M, _HIGHEST_VEHICLE_M = 1.5, 3.0, 4.4
"""Most vehicles are cars; trucks and buses are 4.3 m high at most. The median of drives among trucks is above
that of cars: then the height of the LiDAR decides."""
_LOWEST_VEHICLE_M = 0.5
"""Of the highest quarter: cars that are seen in part still show more, where the ground is in view [m]."""
_HIGHEST_LIDAR_M = 4.5
"""On the roof of a truck [m]."""
_LEAST_VEHICLES = 5
_LOG_TRUCKS = 1.1
"""Logarithm of how many times as high as a car the highest trucks are."""
_LENGTH_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 1.0 / 0.3048: "feet", 1.0 / 0.0254: "inches"}
_UPRIGHT = 0.7
"""Cosine between two directions that are the same one, roughly."""
_COARSE = 0.01
"""Step of rounded coordinates, as a share of the median range: some 10 cm, which displace outlines."""
_FARTHEST_START_M = 10.0
"""LiDAR and camera on one vehicle, a truck's length apart [m]."""


def clouds(drive: Drive) -> Finding | None:
    """Clouds in another unit than metres: vehicles and the ground below the LiDAR show it."""
    if drive.statistics is None:
        return None
    heights = vehicle_heights(drive.statistics)
    ground = usual_ground(drive)
    if len(heights) < _LEAST_VEHICLES or (ground is not None and ground.share < FLAT):
        return None
    middle, upper = float(np.median(heights)), float(np.quantile(heights, 0.75))
    high = ground is not None and ground.height > _HIGHEST_LIDAR_M
    highest = _HIGHEST_CAR_M if high else _HIGHEST_VEHICLE_M
    if middle < highest and (ground is None or upper > _LOWEST_VEHICLE_M):
        return None
    if middle <= 0.0:
        return Finding(
            "the points labelled vehicle have no height",
            f"median of {count_of(len(heights), 'vehicle')}: {middle:.3g}",
            "look at the column z of the clouds, then at the class numbers of the labels",
        )
    scale = middle / _CAR_HEIGHT_M
    evidence = f"vehicles are {middle:.3g} high in the median of {len(heights)}, a car is 1.5 m"
    if ground is not None:
        evidence += f"; the LiDAR is {ground.height:.3g} above the ground"
        if scale > 1.0 and ground.height < _HIGHEST_LIDAR_M and middle > 5.0 * ground.height:
            return Finding(
                "the points labelled vehicle are no vehicles, or the clouds are not in metres",
                evidence,
                "compare the class numbers of the labels with their table, then the unit of the clouds",
            )
    unit = min(_LENGTH_UNITS, key=lambda factor: abs(np.log(scale / factor)))
    named = (
        f"{_LENGTH_UNITS[unit]}, not metres" if -0.5 < np.log(scale / unit) < _LOG_TRUCKS else "not in metres"
    )
    factor = unit if "not metres" in named else scale
    return Finding(
        f"the clouds are {'in ' if 'not metres' in named else ''}{named}",
        evidence,
        f"multiply the points by {1.0 / factor:.3g}",
    )


def rounding(drive: Drive) -> Finding | None:
    """Clouds whose coordinates were rounded so coarsely that outlines cannot be found in them."""
    share = rounded_share(drive)
    if drive.statistics is None or share < _COARSE:
        return None
    step = float(np.median([scan.step for scan in drive.statistics.scans if scan.step > 0.0]))
    given = "whole metres" if abs(step - 1.0) < 1e-3 else f"rounded to steps of {step:.3g} m"
    return Finding(
        f"the coordinates of the clouds are {given}",
        f"{100.0 * share:.2g} % of the points' median distance",
        "give them as the LiDAR measures them, in float32 or with a step of a centimetre or less",
    )


def rounded_share(drive: Drive) -> float:
    """The step to which coordinates were rounded, as a share of the median range: free of the unit."""
    scans = () if drive.statistics is None else drive.statistics.scans
    shares = [scan.step / scan.median_range for scan in scans if scan.step > 0.0]
    return float(np.median(shares)) if shares else 0.0


def axes(drive: Drive, guess: gtsam.Pose3 | None) -> Finding | None:
    """Clouds in the camera's axes: the ground shows what is down. A start of which the camera's axes are not
    the clouds' is that of a LiDAR on its side, where its ground is below the camera."""
    ground = usual_ground(drive)
    if ground is None or ground.share < FLAT or ground.up[1] > -_UPRIGHT:
        return None
    R = np.eye(3) if guess is None else guess.rotation().matrix()
    if float((R @ ground.up)[1]) < -_UPRIGHT and R[2, 2] < _UPRIGHT:
        return None
    x, y, z = ground.up
    return Finding(
        "the clouds are in the camera's axes (x right, y down, z forward)",
        f"the ground's normal is {x:.2f} {y:.2f} {z:.2f}, expected 0 0 1",
        "give clouds in the LiDAR's axes (x forward, y left, z up), and a start that goes with them",
    )


def start_unit(guess: gtsam.Pose3 | None) -> Finding | None:
    """A start whose translation is in another unit than metres."""
    if guess is None:
        return None
    length = float(np.linalg.norm(guess.translation()))
    if length < _FARTHEST_START_M:
        return None
    unit, factor = ("millimetres", 1000.0) if length > 100.0 else ("centimetres", 100.0)
    return Finding(
        f"the translation of the start (Tr) is in {unit}, not metres",
        f"it is {length:.4g} long; as {unit} {length / factor:.2g} m",
        f"divide it by {factor:.0f}",
    )


FLAT = 0.75
"""Share of the points labelled ground on one plane: above 0.9 on streets, about a half for other things."""


def vehicle_heights(statistics: InputStatistics) -> FloatArray:
    """(k,) of all vehicles of the scans looked at closely."""
    return np.concatenate([np.zeros(0), *(scan.vehicle_heights for scan in statistics.scans)])


def usual_ground(drive: Drive) -> Ground | None:
    """The median ground of the scans; None where fewer than half of those looked at closely show one."""
    scans = () if drive.statistics is None else drive.statistics.scans
    grounds: Sequence[Ground] = [scan.ground for scan in scans if scan.ground is not None]
    if not grounds:
        return None
    up = np.median([ground.up for ground in grounds], axis=0)
    return Ground(
        up / max(float(np.linalg.norm(up)), 1e-9),
        float(np.median([ground.height for ground in grounds])),
        float(np.median([ground.share for ground in grounds])),
        float(np.median([ground.smooth for ground in grounds])),
    )
