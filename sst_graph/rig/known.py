"""What is known about a rig beforehand: poses of cameras in one another, and a common trigger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.errors import ConfigError
from sst_graph.factors.arguments import checked_gtsam, checked_number, checked_several, checked_type
from sst_graph.types import ByValue, FloatArray

ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M = 0.03, 0.002
"""How well a calibration with a target is taken to know the pose between two cameras, along each axis."""
TRIGGER_SIGMA_S = 1e-4
"""How far apart the time offsets of cameras with one trigger may be: half a difference of exposure times."""


@dataclass(frozen=True, eq=False)
class KnownPose(ByValue):
    """The pose of one camera in another, known beforehand.

    Attributes:
        camera, reference: names; p_camera = T_camera_reference . p_reference.
        T_camera_reference: the pose.
        rotation_sigma_deg, translation_sigma_m: its deviation along each axis.

    Raises:
        ConfigError: one camera for both, or a sigma that is none.
        FactorError: no names, no pose.
    """

    camera: str
    reference: str
    T_camera_reference: gtsam.Pose3
    rotation_sigma_deg: float = ROTATION_SIGMA_DEG
    translation_sigma_m: float = TRANSLATION_SIGMA_M

    def __post_init__(self) -> None:
        for name in ("camera", "reference"):
            checked_type(f"{name} of KnownPose", getattr(self, name), str, "the name of a camera")
        checked_gtsam("T_camera_reference of KnownPose", self.T_camera_reference, gtsam.Pose3)
        if self.camera == self.reference:
            raise ConfigError(f"known pose of {self.camera!r}: found in itself, expected in another camera")
        for name in ("rotation_sigma_deg", "translation_sigma_m"):
            value = checked_number(f"{name} of KnownPose", getattr(self, name))
            if not 1e-9 <= value <= 1e3:
                raise ConfigError(
                    f"known pose of {self.camera!r}: {name}: found {value!r}, expected 1e-9 to 1e3"
                )

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) [rad, m]."""
        sigmas = np.repeat([np.radians(self.rotation_sigma_deg), self.translation_sigma_m], 3)
        return np.diag(sigmas**2)


@dataclass(frozen=True)
class KnownRig:
    """All that is known beforehand.

    Attributes:
        poses: of cameras in one another; those that join several of them are independent.
        one_trigger: all cameras have one time offset, to :data:`TRIGGER_SIGMA_S`.

    Raises:
        FactorError: something else than poses.
    """

    poses: tuple[KnownPose, ...] = ()
    one_trigger: bool = False

    def __post_init__(self) -> None:
        checked_type("poses of KnownRig", self.poses, (list, tuple), "a tuple of KnownPose")
        for pose in self.poses:
            checked_type("poses of KnownRig", pose, KnownPose, "a KnownPose")
        checked_type("one_trigger of KnownRig", self.one_trigger, bool, "True or False")

    def check(self, cameras: Sequence[str]) -> None:
        """Refuse poses of other cameras.

        Raises:
            ConfigError: naming the camera.
            FactorError: no names.
        """
        what, expected = "cameras of KnownRig.check", "the names of the cameras"
        checked_several(what, cameras, str, "the name of a camera", expected)
        for pose in self.poses:
            for name in (pose.camera, pose.reference):
                if name not in cameras:
                    raise ConfigError(f"known pose of camera {name!r}: expected one of {', '.join(cameras)}")


def poses_by_nominal(
    nominal: Mapping[str, gtsam.Pose3 | None],
    rotation_sigma_deg: float = ROTATION_SIGMA_DEG,
    translation_sigma_m: float = TRANSLATION_SIGMA_M,
) -> tuple[KnownPose, ...]:
    """The cameras' poses in the first one by the data's nominal extrinsics cTl (KITTI: by the P lines).

    Raises:
        ConfigError: a camera has none.
        FactorError: no dict of poses by the camera's name.
    """
    checked_type("nominal", nominal, Mapping, "a dict of poses by the camera's name")
    for name, cTl in nominal.items():
        checked_type("name of a camera", name, str, "a text")
        if cTl is not None:
            checked_gtsam(f"nominal of {name:.60}", cTl, gtsam.Pose3)
    if not nominal:
        raise ConfigError("nominal: found no camera, expected one or more")
    missing = [name for name, cTl in nominal.items() if cTl is None]
    if missing:
        raise ConfigError(f"camera {missing[0]!r}: the data bring no nominal extrinsic, expected one of each")
    (reference, aTl), *others = [(name, cTl) for name, cTl in nominal.items() if cTl is not None]
    return tuple(
        KnownPose(name, reference, cTl * aTl.inverse(), rotation_sigma_deg, translation_sigma_m)
        for name, cTl in others
    )
