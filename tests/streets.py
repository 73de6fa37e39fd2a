"""Small simulated drives that several test modules look at, made once a process."""

from __future__ import annotations

import dataclasses
import tempfile
from functools import cache
from pathlib import Path

import cv2
import gtsam
import numpy as np
from stored import simulated, stored

from sst_graph import Tracker, TrackerConfig
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.experiments.wrong_drives import turned_picture, with_distortion
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.types import CameraImage, Frame, SemanticClass

HALF_SIZE = SimulationConfig(
    width=621, height=188, azimuth_limit_deg=50.0, azimuth_step_deg=0.3, vehicle_density=0.3
)
"""A street with many vehicles, at half the usual size."""

TRACKED_STREET = dataclasses.replace(
    HALF_SIZE,
    seed=3,
    frames=36,
    time_offset_s=0.03,
    motion="no_stop",
    speed_mps=6.0,
    moving_fraction=0.0,
)
"""A drive for the tracker."""

SHORT_STREET = SimulationConfig(
    seed=4,
    frames=20,
    width=414,
    height=125,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.35,
    vehicle_density=0.3,
    time_offset_s=0.0,
    rotation_error_deg=0.3,
    translation_error_m=0.02,
    motion="no_stop",
    speed_mps=6.0,
)
"""A short drive in small pictures."""
SOON = ("start_scans=8", "calibration.search.enabled=false")
"""Settings with which a tracker starts early on it."""


@cache
def standing_street(label_noise: float = 1.0) -> SimulatedDrive:
    """Three frames of a standing drive at half the usual size."""
    return simulated(
        SimulationConfig(
            seed=3,
            frames=3,
            width=621,
            height=188,
            motion="standing",
            time_offset_s=0.0,
            azimuth_step_deg=0.35,
            label_noise=label_noise,
        )
    )


@cache
def prepared_street(label_noise: float = 1.0) -> Drive:
    """:func:`standing_street`, reduced to what calibration needs of its vehicles."""
    config, classes = PrepareConfig(use_visual_odometry=False), [SemanticClass.VEHICLE]
    street = standing_street(label_noise)
    return stored((street.config, config), lambda: prepare_drive(street, classes, config))


CROWDED_STREET = dataclasses.replace(HALF_SIZE, seed=5000, frames=20, time_offset_s=0.1)
"""A drive with a stop past many vehicles."""


@cache
def crowded_street(k1: float = 0.0) -> KeptDrive:
    """:data:`CROWDED_STREET`, through a lens with radial distortion."""
    return with_distortion(crowded_street(), k1) if k1 else KeptDrive.of(simulated(CROWDED_STREET))


EARLY_START = TrackerConfig(start_scans=8)
"""The first estimate comes with the eighth frame, where its work is not spread over frames."""


def picked_frames(fast: SimulatedDrive, count: int, first: int, clock_set: bool) -> list[Frame]:
    """Every third scan of a fast drive with its image; from a frame on that of the next third of a period.

    Its stamps jump against their interval as those of a camera whose clock was set: ``clock_set`` makes it
    one, by the pictures of the scans' own instants.
    """
    frames = []
    for k in range(count):
        scan, image = fast.read_scan(3 * k), fast.read_image(3 * k + (k >= first and not clock_set))
        assert scan is not None and image is not None
        stamp_ns = int(fast.stamps_ns[3 * k + (k >= first)])
        frames.append(Frame(k, scan=scan, image=dataclasses.replace(image, stamp_ns=stamp_ns)))
    return frames


def tracker_from_truth(street: SimulatedDrive, config: TrackerConfig = EARLY_START) -> Tracker:
    """A tracker that starts from the truth without a search, and at once when it has enough scans."""
    calibration = config.calibration
    search = dataclasses.replace(calibration.search, enabled=False)
    config = dataclasses.replace(config, calibration=dataclasses.replace(calibration, search=search))
    tracker = Tracker(street.camera, config, street.truth.cTl, street.truth.time_offset_s or 0.0)
    tracker.initializer.work_per_frame = None
    return tracker


def saved_tracker(frames: int) -> bytes:
    """Checkpoint of a tracker of :data:`TRACKED_STREET` after some frames, made once a session."""

    def make() -> bytes:
        street = simulated(TRACKED_STREET)
        tracker = tracker_from_truth(street)
        for position in range(frames):
            tracker.add(street[position])
        return checkpoint_of(tracker)

    return stored((TRACKED_STREET, EARLY_START, frames), make)


def checkpoint_of(tracker: Tracker) -> bytes:
    """The file that it saves."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "tracker.npz")
        tracker.save(path)
        return path.read_bytes()


def sigmas_apart(tracker: Tracker, cTl: gtsam.Pose3, time_offset_s: float) -> float:
    """Mahalanobis distance of a tracker's estimate from a calibration."""
    point = tracker.estimate.point
    step = np.append(gtsam.Pose3.Logmap(point.cTl.between(cTl)), time_offset_s - point.time_offset_s)
    return float(np.sqrt(step @ np.linalg.solve(tracker.estimate.covariance[:7, :7], step)))


def turned(image: CameraImage, street: SimulatedDrive, R: gtsam.Rot3, **border: int) -> CameraImage:
    """The image of a turned camera; ``border`` says what it shows where it did not look before."""
    mask = turned_picture(image.mask, street.camera, R, cv2.INTER_NEAREST, **border)
    return dataclasses.replace(image, mask=mask)


def knocked(image: CameraImage, street: SimulatedDrive, degrees: float) -> CameraImage:
    """The image of a camera turned about its vertical axis."""
    return turned(image, street, gtsam.Rot3.Ry(np.radians(degrees)), borderMode=cv2.BORDER_REPLICATE)


LENS_STREET = SimulationConfig(
    seed=504,
    frames=12,
    motion="no_stop",
    azimuth_limit_deg=50.0,
    width=828,
    height=250,
    vehicle_density=0.3,
)
"""A street whose lens edges tell."""
