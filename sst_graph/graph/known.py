"""What is known of a calibration beside the matches, as one more factor of the graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.elimination import Unknowns
from sst_graph.graph.linear import quadratic_factor
from sst_graph.graph.state import EXTRINSIC, State, nuisance_key, time_offset_key
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class KnownCalibration:
    """A Gaussian on extrinsic and first time offset, which may follow parameters of assumptions.

    Attributes:
        state: its mean, which takes these parameters for 0.
        covariance: (7, 7).
        steps: (7,) step from the calibration to the mean by one unit of each of them, by name [rad, m, s].
    """

    state: State
    covariance: FloatArray
    steps: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def information(self) -> FloatArray:
        """(7, 7)."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    def with_share(self, share: float) -> KnownCalibration:
        """What is known, with a share of its information."""
        return replace(self, covariance=self.covariance / share)

    def columns(self, names: Sequence[str]) -> FloatArray:
        """(7, k) steps by parameters; 0 by those that the mean does not follow."""
        own = [self.steps.get(name, np.zeros(7)) for name in names]
        return np.asarray(np.reshape(own, (len(names), 7)).T, np.float64)

    def shared(self, names: Sequence[str]) -> FloatArray:
        """(7, k) information that extrinsic and offset share with parameters."""
        return np.asarray(self.information @ self.columns(names), np.float64)

    def factor(self, free: Sequence[str] = ()) -> gtsam.LinearContainerFactor:
        """[Log(E_0^-1 E); D - D_0] + s theta, linear about the mean (E_0, D_0).

        Args:
            free: names of the assumptions whose parameters theta are variables of the graph.
        """
        names = [name for name in free if name in self.steps]
        jacobian = np.hstack([np.eye(7), self.columns(names)])
        variables = [(EXTRINSIC, slice(0, 6)), (time_offset_key(), slice(6, 7))]
        variables += [(nuisance_key(name), slice(7 + k, 8 + k)) for k, name in enumerate(names)]
        point = gtsam.Values()
        point.insert(EXTRINSIC, self.state.cTl)
        point.insert(time_offset_key(), np.array(self.state.time_offsets_s[:1]))
        for name in names:
            point.insert(nuisance_key(name), np.zeros(1))
        return quadratic_factor(variables, jacobian.T @ self.information @ jacobian, point)


def information_beside(prior: KnownCalibration | None, unknowns: Unknowns) -> FloatArray:
    """(n, n) information of what is known beside the matches on all unknowns, estimated parameters that its
    mean follows among them; 0 where nothing is."""
    if prior is None:
        return np.zeros((unknowns.size, unknowns.size))
    jacobian = np.zeros((7, unknowns.size))
    jacobian[:, :7] = np.eye(7)
    for name, step in prior.steps.items():
        if nuisance_key(name) in unknowns.keys:
            jacobian[:, unknowns.column(nuisance_key(name))] = step
    return np.asarray(jacobian.T @ prior.information @ jacobian)


def motion_steps(camera: PinholeCamera, cTl: gtsam.Pose3) -> dict[str, FloatArray]:
    """(7,) step of a calibration by motion alone by one unit of each parameter that it follows, by name
    [rad, m, s]."""
    found = {name: each.motion_step for name, each in ASSUMPTIONS.items()}
    return {name: step(camera, cTl) for name, step in found.items() if step is not None}
