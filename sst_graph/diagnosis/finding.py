"""A likely fault in the data, as one sentence."""

from __future__ import annotations

from dataclasses import dataclass

INVERTED = "the start (Tr) is inverted", "give T_camera_lidar, from LiDAR to camera"
"""Cause and check of a start that leads from the camera to the LiDAR, by whatever data it is found."""
OF_LINK = (
    "the start (Tr) is that of the camera's link (x forward, y left, z up)",
    "give the pose in its optical frame (x right, y down, z forward)",
)
"""Cause and check of a start whose camera axes are not the optical ones."""


@dataclass(frozen=True)
class Finding:
    """A likely cause.

    Attributes:
        cause: the likely fault.
        evidence: for it, with numbers.
        check: what to inspect or change.
    """

    cause: str
    evidence: str
    check: str

    @property
    def sentence(self) -> str:
        return f"{self.cause} ({self.evidence}): {self.check}"
