"""Cameras with distortion, read from others' formats, and rectified to a pinhole (docs/how-to/cameras.md)."""

from __future__ import annotations

from sst_graph.cameras.brown_conrady import BrownConradyCamera
from sst_graph.cameras.double_sphere import DoubleSphereCamera
from sst_graph.cameras.fisheye import FisheyeCamera
from sst_graph.cameras.model import CameraModel
from sst_graph.cameras.rectification import Rectification, rectified_camera

__all__ = [
    "BrownConradyCamera",
    "CameraModel",
    "DoubleSphereCamera",
    "FisheyeCamera",
    "Rectification",
    "rectified_camera",
]
