"""Tracks a simulated drive whose camera is knocked: the data of a figure.

``python docs/figures/make.py --measure`` runs it and writes alarm.csv beside this file.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import gtsam
import numpy as np

from sst_graph import CameraImage, PinholeCamera, Tracker
from sst_graph.experiments.wrong_drives import turned_picture
from sst_graph.simulator import SimulationConfig, simulate

FILE = Path(__file__).with_name("alarm.csv")
FRAMES, KNOCK, KNOCK_DEG = 130, 80, 1.0


@dataclass(frozen=True)
class Tracked:
    """The estimate after a frame.

    Attributes:
        frame: its number.
        turn_deg: turn of the camera about its vertical axis, from the truth of the beginning [deg].
        sigma_deg: standard deviation of that; nan without an estimate.
        status: of the update.
        alarm: whether it raises one.
    """

    frame: int
    turn_deg: float
    sigma_deg: float
    status: str
    alarm: bool


def turned(image: CameraImage, camera: PinholeCamera) -> CameraImage:
    """The image of a camera that looks further to the side."""
    R, border = gtsam.Rot3.Ry(np.radians(KNOCK_DEG)), {"borderMode": cv2.BORDER_REPLICATE}
    mask = turned_picture(image.mask, camera, R, cv2.INTER_NEAREST, **border)
    return replace(
        image, mask=mask, pixels=turned_picture(image.pixels, camera, R, cv2.INTER_LINEAR, **border)
    )


def measure(said: Callable[[str], None]) -> None:
    """Track the drive and write the file."""
    drive = simulate(
        SimulationConfig(seed=9110, frames=FRAMES, width=621, height=188, azimuth_limit_deg=60.0)
    )
    tracker = Tracker(drive.camera, None, drive.nominal)
    with FILE.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["frame", "turn_deg", "sigma_deg", "status", "alarm"])
        for number, frame in enumerate(drive):
            image = frame.image
            if image is not None and number >= KNOCK:
                frame = replace(frame, image=turned(image, drive.camera))
            update = tracker.add(frame)
            turn, sigma = np.nan, np.nan
            if update.covariance is not None:
                off = update.T_camera_lidar.rotation() * drive.truth.cTl.rotation().inverse()
                turn = np.degrees(gtsam.Rot3.Logmap(off)[1])
                # Turning about the camera's y axis is turning about the LiDAR's z axis.
                sigma = np.degrees(update.sigmas[2])
            table.writerow([number, f"{turn:.4g}", f"{sigma:.4g}", update.status, int(update.alarm)])
    said(f"{FILE.name}: {FRAMES} frames")


def read() -> Iterator[Tracked]:
    """The frames of the file."""
    with FILE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            numbers = float(row["turn_deg"]), float(row["sigma_deg"])
            yield Tracked(int(row["frame"]), *numbers, row["status"], row["alarm"] == "1")
