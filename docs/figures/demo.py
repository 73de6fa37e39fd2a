"""Takes the pictures of README and *Start* from a demo: ``python docs/figures/make.py --demo out/demo``.

The picture of the report is taken by a browser, chromium or google-chrome, without a window.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import cv2
import gtsam
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from sst_graph import SemanticClass, open_source
from sst_graph.cli.pictures import camera_twist
from sst_graph.data.frame_parts import RecentReader
from sst_graph.result import read_result
from sst_graph.viz import draw_overlay

FRAME = 12
WRONG: dict[str, tuple[float, float]] = {
    "right": (0.0, 0.0),
    "0.3 deg off in yaw": (0.3, 0.0),
    "1 deg off in yaw": (1.0, 0.0),
    "10 cm off to the right": (0.0, 0.1),
}
"""Errors of calibrations that a picture compares: about the camera's y axis [deg], along its x axis [m]."""
CUT_PX, ENLARGED = (160, 96), 3
"""Part of a picture around a vehicle that is shown of each, and how much larger it is shown."""
WIDTH, QUALITY = 1000, 82
VERDICT_PX = (860, 560)
CLOSE_UPS_PX = (1400, 960)
"""Sizes of the windows that show the head of the report, and two rows of its close-ups."""

Picture = NDArray[np.uint8]


def take(folder: Path, into: Path) -> None:
    """Write demo_inputs.jpg, demo_overlay.jpg, demo_wrong.jpg, demo_report.png and demo_close_ups.jpg."""
    _save(into / "demo_inputs.jpg", _inputs(folder / "drive"))
    _save(into / "demo_wrong.jpg", _wrong(folder))
    overlay = folder / "calibration" / f"overlay_drive_00_{FRAME:06d}.png"
    picture = cv2.imread(str(overlay))
    if picture is None:
        raise SystemExit(f"{overlay}: found no picture, expected one of make demo")
    _save(into / "demo_overlay.jpg", np.asarray(picture, np.uint8))
    report = folder / "calibration" / "report.html"
    _photograph(report, into / "demo_report.png", VERDICT_PX)
    take_close_ups(report, into / "demo_close_ups.jpg")


def take_close_ups(report: Path, path: Path) -> None:
    """The first six close-ups of a report."""
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder) / "page.html", Path(folder) / "page.png"
        hidden = "<style>h1, section:not(#objects), #objects > :not(.grid) { display: none }</style>"
        page.write_text(report.read_text(encoding="utf-8") + hidden, encoding="utf-8")
        _photograph(page, picture, CLOSE_UPS_PX)
        _save(path, np.asarray(cv2.imread(str(picture)), np.uint8))


def _inputs(folder: Path) -> Picture:
    """A picture with its mask, and the scan from above with its labels."""
    frame = open_source(folder, camera="image_2")[FRAME]
    image, scan = frame.image, frame.scan
    if image is None or scan is None:
        raise SystemExit(f"{folder}: found no frame {FRAME} with both sensors")
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.0), width_ratios=(2.55, 1))
    shown = (
        np.repeat(image.pixels[..., None], 3, axis=2) if image.pixels.ndim == 2 else image.pixels[..., ::-1]
    )
    vehicle = (image.mask == SemanticClass.VEHICLE)[..., None]
    left.imshow(np.where(vehicle, (0.45 * shown + 0.55 * np.array([250, 190, 0])), shown).astype(np.uint8))
    left.set_title("image_2 and semantic_2: the picture, vehicles in its mask", fontsize=9)
    ahead = scan.points[:, 0] > 0.0
    x, y = scan.points[ahead, 0], scan.points[ahead, 1]
    vehicles = scan.classes[ahead] == SemanticClass.VEHICLE
    right.plot(-y[~vehicles], x[~vehicles], ",", color="#8b949e")
    right.plot(-y[vehicles], x[vehicles], ",", color="#c77700")
    right.set(xlim=(-22.0, 22.0), ylim=(0.0, 40.0), aspect="equal")
    right.set_title("velodyne and labels, from above", fontsize=9)
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
    figure.tight_layout(pad=0.4)
    figure.set_dpi(200)
    figure.canvas.draw()
    canvas: Any = figure.canvas
    return np.asarray(canvas.buffer_rgba())[..., 2::-1].copy()


def _wrong(folder: Path) -> Picture:
    """The same part of an overlay under the result and under three that are wrong."""
    drive = open_source(folder / "drive", camera="image_2")
    result = read_result(folder / "calibration")
    frame = drive[FRAME]
    if frame.image is None:
        raise SystemExit(f"{folder}: found no image of frame {FRAME}, expected a demo's")
    mask = (frame.image.mask == SemanticClass.VEHICLE).astype(np.uint8)
    found = cv2.connectedComponentsWithStats(mask)[2][1:]
    whole = (found[:, cv2.CC_STAT_WIDTH] < 0.8 * CUT_PX[0]) & (found[:, cv2.CC_STAT_HEIGHT] < 0.8 * CUT_PX[1])
    left, top, wide, high = found[whole][np.argmax(found[whole, cv2.CC_STAT_AREA]), :4]
    reader, parts = RecentReader(drive), []
    for words, (yaw_deg, right_m) in WRONG.items():
        error = gtsam.Pose3(gtsam.Rot3.Ry(np.radians(yaw_deg)), np.array([right_m, 0.0, 0.0]))
        cTl = error * result.T_camera_lidar
        c_twist = camera_twist(reader, FRAME, cTl)
        picture = draw_overlay(frame, drive.camera, cTl, result.time_offset_s, c_twist)
        strip = picture.shape[0] - drive.camera.height
        x = int(np.clip(left + wide // 2 - CUT_PX[0] // 2, 0, picture.shape[1] - CUT_PX[0]))
        y = int(np.clip(top + high // 2 - CUT_PX[1] // 2, 0, drive.camera.height - CUT_PX[1])) + strip
        part = picture[y : y + CUT_PX[1], x : x + CUT_PX[0]]
        part = cv2.resize(part, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_NEAREST)
        part = cv2.copyMakeBorder(part, 26, 4, 3, 3, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        cv2.putText(part, words, (5, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (30, 30, 30), 1, cv2.LINE_AA)
        parts.append(part)
    return np.asarray(np.vstack([np.hstack(parts[:2]), np.hstack(parts[2:])]), np.uint8)


def _save(path: Path, picture: Picture) -> None:
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", np.asarray(small), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise SystemExit(f"{path}: cannot be written as JPEG")
    path.write_bytes(data.tobytes())
    print(path)


def _photograph(page: Path, path: Path, size: tuple[int, int]) -> None:
    """The head of a page, as a browser shows it in a window of width and height [px]."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit(
            "found no chromium and no google-chrome, expected one to take a picture of the report"
        )
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
                f"--user-data-dir={profile}", "--window-size={},{}".format(*size),
                f"--screenshot={path}", page.resolve().as_uri(),
            ],
            check=True, capture_output=True,
        )  # fmt: skip
    print(path)
