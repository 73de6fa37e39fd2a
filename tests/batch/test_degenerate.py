"""Drives that cannot tell everything: a large sigma in the right direction, and ``unobservable``."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from stored import simulated
from streets import TRACKED_STREET

from sst_graph import CalibrationConfig, CalibrationResult, calibrate
from sst_graph.config import with_overrides
from sst_graph.result import Status
from sst_graph.simulator import SimulatedDrive
from sst_graph.types import Frame, Scan, SemanticClass, Source

VEHICLE, IGNORE = int(SemanticClass.VEHICLE), int(SemanticClass.IGNORE)


class Showing:
    """A drive whose vehicles are labelled only where they are among some, scan by scan."""

    def __init__(self, drive: SimulatedDrive, chosen: Callable[[Scan], list[int]]) -> None:
        self.drive, self.chosen = drive, chosen
        self.name, self.camera = drive.name, drive.camera
        self.nominal, self.truth = drive.nominal, drive.truth

    def __len__(self) -> int:
        return len(self.drive)

    def __getitem__(self, position: int) -> Frame:
        frame = self.drive[position]
        scan, image = frame.scan, frame.image
        assert scan is not None and image is not None
        kept, classes, mask = self.chosen(scan), scan.classes.copy(), image.mask.copy()
        classes[(classes == VEHICLE) & ~np.isin(scan.instances, kept)] = IGNORE
        mask[(mask == VEHICLE) & ~np.isin(image.instances, kept)] = IGNORE
        scan, image = dataclasses.replace(scan, classes=classes), dataclasses.replace(image, mask=mask)
        return dataclasses.replace(frame, scan=scan, image=image)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))


def vehicles_of(scan: Scan) -> dict[int, NDArray[np.float32]]:
    """Points of each vehicle of a scan."""
    assert scan.instances is not None
    own = np.where(scan.classes == VEHICLE, scan.instances, 0)
    return {int(name): scan.points[own == name] for name in np.unique(own) if name}


def street(**settings: object) -> SimulatedDrive:
    return simulated(dataclasses.replace(TRACKED_STREET, **{"frames": 14, **settings}))  # type: ignore[arg-type]


def checked(
    drive: Source, *settings: str, status: Status = "unobservable", doubtful: bool = False
) -> tuple[CalibrationResult, NDArray[np.float64]]:
    """The answer, which has a status and is right within its covariance; its errors (7,) [rad, m, s].

    Args:
        doubtful: it may be called ``not_converged``, too.
    """
    result = calibrate(drive, drive.nominal, with_overrides(CalibrationConfig(), list(settings)))
    truth = drive.truth
    assert truth is not None and truth.time_offset_s is not None
    turn = gtsam.Pose3.Logmap(result.T_camera_lidar.between(truth.cTl))
    error = np.append(turn, truth.time_offset_s - result.time_offset_s)
    assert result.status == status or (doubtful and result.status == "not_converged")
    assert bool(result.weak_directions) is (status == "unobservable")
    nees = float(error @ np.linalg.solve(result.covariance, error))
    assert nees < 24.3  # 99.9 % of chi-squared, 7
    return result, error


@pytest.mark.slow
def test_constant_speed() -> None:
    """Outlines do not separate forward and time offset; the pitching of the body does."""
    drive = street(motion="constant", frames=16)
    result, _ = checked(drive, "use_motion=never")
    (weak,) = result.weak_directions
    assert abs(weak.vector[3]) > 0.5 and abs(weak.vector[6]) > 0.1  # forward against the offset
    assert "record a stop" in weak.advice
    sigmas = np.sqrt(np.diag(result.covariance))
    assert sigmas[3] > 5.0 * sigmas[4] and sigmas[6] > 0.005
    moved, error = checked(drive, status="ok")
    assert not moved.weak_directions and abs(error[3]) < 0.05 and abs(error[6]) < 0.01


def test_one_frame_of_a_moving_vehicle() -> None:
    """Its motion is not known, and shifts the answer by speed times delay: 18 cm here."""
    result, error = checked(street(frames=1))
    sigmas = np.sqrt(np.diag(result.covariance))
    assert np.abs(error[3:6]).max() > 0.1 and (sigmas[3:6] > 0.5).all() and sigmas[6] > 0.1
    assert "a single scan does not show how the vehicle moved" in result.reasons[0]


def test_one_frame_of_a_vehicle_that_stands_as_its_driver_says() -> None:
    stood = ("unknown_motion.speed_mps=0", "unknown_motion.turn_deg_per_s=0")
    result, _ = checked(street(frames=1, motion="standing", time_offset_s=0.0), *stood)
    sigmas = np.sqrt(np.diag(result.covariance))
    assert (sigmas[3:6] < 0.1).all() and sigmas[6] > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_one_object(seed: int) -> None:
    """With so little in view that explains little the pose may be wrong altogether, and that is said, too."""
    drive = street(seed=seed)
    seen = Counter[int]()
    for frame in drive:
        assert frame.scan is not None
        seen.update({name: len(points) for name, points in vehicles_of(frame.scan).items()})
    largest = [name for name, _ in seen.most_common(1)]
    alone, _ = checked(Showing(drive, lambda scan: largest), doubtful=True)
    sigmas = np.sqrt(np.diag(alone.covariance))
    assert np.degrees(sigmas[0]) > 0.3 and (sigmas[4:6] > 0.02).all()  # roll, left, up


@pytest.mark.slow
def test_all_vehicles_on_one_side() -> None:
    """Roll, and what is sideways or up, are what the other side would tell."""

    def left(scan: Scan) -> list[int]:
        return [name for name, points in vehicles_of(scan).items() if float(points[:, 1].mean()) > 0.0]

    drive = street()
    both = calibrate(drive, drive.nominal, CalibrationConfig(use_motion="never"))
    one, _ = checked(Showing(drive, left), "use_motion=never")
    ratio = np.sqrt(np.diag(one.covariance) / np.diag(both.covariance))
    assert ratio[0] > 1.5 and ratio[4] > 2.0 and ratio[5] > 2.0


def test_how_fast_is_a_deviation() -> None:
    with pytest.raises(Exception, match="speed_mps"):
        with_overrides(CalibrationConfig(), ["unknown_motion.speed_mps=-1"])
