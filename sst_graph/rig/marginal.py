"""The estimates of all cameras of a rig as one Gaussian: a factor in gtsam, and the poses between cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import ConfigError, count_of
from sst_graph.factors import FactorError
from sst_graph.factors.arguments import checked_array, checked_gtsam, checked_number, checked_type, described
from sst_graph.factors.custom.variables import checked_keys
from sst_graph.graph.linear import information_inverse, quadratic_factor
from sst_graph.graph.state import time_offset_key
from sst_graph.rig.influences import UNKNOWNS
from sst_graph.types import ByValue, FloatArray


def rig_keys(number: int) -> tuple[int, int]:
    """Default keys of camera ``number``: of its extrinsic (Pose3) and its time offset (``Vector(1)``)."""
    return int(gtsam.symbol("E", number)), time_offset_key(number)


@dataclass(frozen=True, eq=False)
class RelativePose(ByValue):
    """The pose of one camera in another, as estimated.

    Attributes:
        camera, reference: names; p_camera = T_camera_reference . p_reference.
        T_camera_reference: the pose.
        covariance: (6, 6) of it [rot rad, trans m], right perturbation, so along the reference's axes.
        time_offset_s: the camera's time offset less the reference's [s].
        time_offset_sigma_s: its deviation [s].
    """

    camera: str
    reference: str
    T_camera_reference: gtsam.Pose3
    covariance: FloatArray
    time_offset_s: float
    time_offset_sigma_s: float


@dataclass(frozen=True, eq=False)
class RigMarginal(ByValue):
    """A Gaussian over the extrinsics and time offsets of n cameras.

    Attributes:
        names: of the cameras.
        extrinsics: cTl of each.
        time_offsets_s: of each [s].
        covariance: (7 n, 7 n), camera by camera [rot rad, trans m, offset s], right perturbations.

    Raises:
        FactorError: not one pose and one finite offset a name, or a covariance of another shape.
    """

    names: tuple[str, ...]
    extrinsics: tuple[gtsam.Pose3, ...]
    time_offsets_s: tuple[float, ...]
    covariance: FloatArray

    def __post_init__(self) -> None:
        of = "of RigMarginal"
        checks: dict[str, Callable[[str, Any], object]] = {
            "names": lambda what, name: checked_type(what, name, str, "the name of a camera"),
            "extrinsics": lambda what, cTl: checked_gtsam(what, cTl, gtsam.Pose3),
            "time_offsets_s": checked_number,
        }
        for field, check in checks.items():
            several = getattr(self, field)
            checked_type(f"{field} {of}", several, (tuple, list), "a tuple, one for each camera")
            if len(several) != len(self.names):
                found = count_of(len(several), "entry", "entries")
                raise FactorError(f"{field} {of}", found, f"{len(self.names)}, one for each camera")
            for one in several:
                check(f"{field} {of}", one)
        n = UNKNOWNS * len(self.names)
        object.__setattr__(self, "covariance", checked_array(f"covariance {of}", self.covariance, (n, n)))

    def keys(self) -> dict[str, tuple[int, int]]:
        """Default keys of extrinsic and time offset by the camera's name: (E0, D0), (E1, D1), ..."""
        return {name: rig_keys(number) for number, name in enumerate(self.names)}

    def _checked(self, keys: Mapping[str, tuple[int, int]] | None) -> dict[str, tuple[int, int]]:
        """Keys of all cameras."""
        if keys is None:
            return self.keys()
        what, expected = "keys of a rig's marginal", f"keys (E, D) of each of {', '.join(self.names)}"
        checked_type(what, keys, Mapping, f"a dict with {expected}")
        named: dict[str, Any] = {}
        for name in self.names:
            pair = keys.get(name)
            if not (isinstance(pair, tuple | list) and len(pair) == 2):
                raise FactorError(what, f"{described(pair)} for {name}", expected)
            named |= {f"E of {name}": pair[0], f"D of {name}": pair[1]}
        found = iter(checked_keys("a rig's marginal", named))
        return {name: (next(found), next(found)) for name in self.names}

    def point(self, keys: Mapping[str, tuple[int, int]] | None = None) -> gtsam.Values:
        """The estimate as values; arguments and errors as of :meth:`factor`."""
        values, keys = gtsam.Values(), self._checked(keys)
        for name, cTl, time_offset_s in zip(self.names, self.extrinsics, self.time_offsets_s, strict=True):
            E, D = keys[name]
            values.insert(E, cTl)
            values.insert(D, np.array([time_offset_s]))
        return values

    def factor(self, keys: Mapping[str, tuple[int, int]] | None = None) -> gtsam.LinearContainerFactor:
        """The Gaussian as one factor on the extrinsics and time offsets of all cameras.

        Args:
            keys: of extrinsic and time offset, by the camera's name; by default :meth:`keys`.

        Raises:
            FactorError: no such pair for a camera, or one key for two variables.
        """
        keys = self._checked(keys)
        information = information_inverse(self.covariance)
        variables: list[tuple[int, slice]] = []
        for i, name in enumerate(self.names):
            E, D = keys[name]
            at = UNKNOWNS * i
            variables += [(E, slice(at, at + 6)), (D, slice(at + 6, at + 7))]
        return quadratic_factor(variables, information, self.point(keys))

    def of_camera(self, name: str) -> FloatArray:
        """(7, 7) covariance of one camera."""
        own = self._columns(name)
        return self.covariance[np.ix_(own, own)]

    def relative_pose(self, camera: str, reference: str) -> RelativePose:
        """The pose of one camera in another, and the difference of their time offsets."""
        c, b = self._columns(camera), self._columns(reference)
        i, j = self.names.index(camera), self.names.index(reference)
        cTl, bTl = self.extrinsics[i], self.extrinsics[j]
        pair = self.covariance[np.ix_([*c, *b], [*c, *b])]
        Ad = np.asarray(bTl.AdjointMap())
        J = np.zeros((7, 14))
        J[:6, :6], J[:6, 7:13] = Ad, -Ad
        J[6, 6], J[6, 13] = 1.0, -1.0
        covariance = J @ pair @ J.T
        return RelativePose(
            camera,
            reference,
            cTl * bTl.inverse(),
            0.5 * (covariance[:6, :6] + covariance[:6, :6].T),
            self.time_offsets_s[i] - self.time_offsets_s[j],
            float(np.sqrt(max(covariance[6, 6], 0.0))),
        )

    def relative_poses(self) -> tuple[RelativePose, ...]:
        """The pose of every camera but the first in the one before it, as Kalibr's chain has it."""
        pairs: Sequence[tuple[str, str]] = list(zip(self.names[1:], self.names[:-1], strict=True))
        return tuple(self.relative_pose(camera, reference) for camera, reference in pairs)

    def _columns(self, name: str) -> list[int]:
        if not (isinstance(name, str) and name in self.names):
            raise ConfigError(f"camera: found {described(name)}, expected one of {', '.join(self.names)}")
        at = UNKNOWNS * self.names.index(name)
        return list(range(at, at + UNKNOWNS))
