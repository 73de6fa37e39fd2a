"""What the tracker refuses to take in, and why."""

from __future__ import annotations

import numpy as np

from factors.camera import PinholeCamera
from sst_graph.errors import DataError
from sst_graph.estimators.window import Window
from sst_graph.types import CameraImage, Scan


def check_image(
    image: CameraImage, camera: PinholeCamera, window: Window, offset_s: float, late_s: float
) -> None:
    """An image of the camera's size, not far behind the newest scan in true time.

    Raises:
        DataError: it is not.
    """
    expected = (camera.height, camera.width)
    if image.mask.shape != expected:
        raise DataError("tracker", f"a mask of {image.mask.shape}", f"{expected}, the camera's size")
    newest = window.last_stamp_ns
    if newest is not None and window.images:
        late = (newest - image.stamp_ns) * 1e-9 - offset_s
        if late > late_s and image.stamp_ns < window.images[-1].stamp_ns:
            raise DataError(
                "tracker", f"an image {late:.2f} s behind the newest scan", f"at most {late_s:g} s"
            )


def check_scan(scan: Scan, window: Window) -> None:
    """A finite, fully labelled scan, later than the newest.

    Raises:
        DataError: it is not.
    """
    if not np.isfinite(scan.points).all():
        raise DataError("tracker", "points that are NaN or inf", "finite points")
    if len(scan.points) != len(scan.classes):
        raise DataError("tracker", f"{len(scan.classes)} labels", f"{len(scan.points)}, one a point")
    newest = window.last_stamp_ns
    if newest is not None and scan.stamp_ns <= newest:
        raise DataError("tracker", f"a scan of stamp {scan.stamp_ns} ns", f"one after {newest} ns")
