"""Where an image falls in a trajectory: for factors on the poses around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam

from .arguments import checked_positive
from .custom.variables import body_in_lidar, checked_key, key_name
from .errors import FactorError


@dataclass(frozen=True)
class Between:
    """An image between two poses of a trajectory.

    Attributes:
        X_a, X_b: keys of the poses wTb before and after (Pose3), distinct.
        seconds: from X_a to X_b, in the LiDAR's clock [s].
        image_after_a_s: image stamp minus stamp of X_a [s]; the offset is added to it. The image may fall
            beyond X_a or X_b: the twist then goes on.
        X_scan: key of wTb at the stamp of the scan that the image is aligned with, where that is another pose
            than X_a.
        bTl: pose of the LiDAR in the body, known; None where the poses are the LiDAR's own.

    Raises:
        FactorError: no keys, one key for both poses, or no time between them.
    """

    X_a: int
    X_b: int
    seconds: float
    image_after_a_s: float
    X_scan: int | None = None
    bTl: gtsam.Pose3 | None = None

    def __post_init__(self) -> None:
        for name in ("X_a", "X_b", "X_scan"):
            if name != "X_scan" or self.X_scan is not None:
                object.__setattr__(self, name, checked_key("Between", name, getattr(self, name)))
        if self.X_a == self.X_b:
            raise FactorError("keys of Between", f"{key_name(self.X_a)} for X_a and X_b", "distinct keys")
        object.__setattr__(self, "seconds", checked_positive("seconds between the poses", self.seconds))
        _ = self.lTb  # checked

    @cached_property
    def lTb(self) -> gtsam.Pose3:
        """Pose of the body in the LiDAR."""
        return body_in_lidar("Between", self.bTl)

    @property
    def X_s(self) -> int:
        """Key of the pose at the scan's stamp."""
        return self.X_a if self.X_scan is None else self.X_scan

    @property
    def image_after_middle_s(self) -> float:
        """Image stamp minus the middle between X_a and X_b [s]."""
        return self.image_after_a_s - 0.5 * self.seconds
