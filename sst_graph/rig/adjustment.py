"""All cameras in one factor graph: their estimates as one Gaussian, and what is known of the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import gtsam
import numpy as np

from sst_graph.covariance.contradiction import Difference, name_step
from sst_graph.factors import camera_pose_factor
from sst_graph.factors.camera_pose import camera_pose_error
from sst_graph.graph.linear import information_inverse, ordering_of
from sst_graph.rig.known import TRIGGER_SIGMA_S, KnownPose, KnownRig
from sst_graph.rig.marginal import RigMarginal
from sst_graph.types import FloatArray

FALSE_ALARM = 1e-3
"""Probability that any known pose seems to contradict the estimates of a rig where none does."""


@dataclass(frozen=True)
class ComparedPose:
    """A known pose compared with the estimates.

    Attributes:
        known: which.
        difference: from the known to the estimated pose; 6 numbers.
        contradicted: whether they contradict each other.
    """

    known: KnownPose
    difference: Difference
    contradicted: bool

    @property
    def sentence(self) -> str:
        """The difference, in words."""
        known, named = self.known, name_step(self.difference, gtsam.Pose3())
        return (
            f"the known pose of {known.camera} in {known.reference} contradicts the estimates: they differ "
            f"from it in {named.sentence} (chi-squared {self.difference.chi2:.0f} of 6): check which camera "
            "moved, the cameras' names and the transform's direction"
        )


@dataclass(frozen=True)
class ComparedTrigger:
    """The time offsets of cameras that are said to have one trigger.

    Attributes:
        names: of the cameras.
        difference: of each further camera's time offset to the first one's [s], with its covariance.
        contradicted: whether the time offsets contradict it.
    """

    names: tuple[str, ...]
    difference: Difference
    contradicted: bool

    @property
    def sentence(self) -> str:
        """The differences, in words."""
        sigmas = np.sqrt(np.diag(self.difference.covariance))
        steps = zip(self.names[1:], self.difference.step, sigmas, strict=True)
        each = ", ".join(f"{name} {1e3 * step:+.1f} ± {1e3 * sigma:.1f} ms" for name, step, sigma in steps)
        return (
            f"one trigger of all cameras contradicts their time offsets: they differ from that of "
            f"{self.names[0]} by {each} (chi-squared {self.difference.chi2:.0f} of {len(sigmas)}): check "
            "whether the cameras are triggered together, and whether images were lost"
        )


def adjusted(marginal: RigMarginal, known: KnownRig) -> RigMarginal:
    """The Gaussian of the cameras, given what is known of the rig.

    The graph of :func:`rig_graph`, solved; without anything known the Gaussian itself.
    """
    if not known.poses and not known.one_trigger:
        return marginal
    graph, values = rig_graph(marginal, known), marginal.point()
    params = gtsam.LevenbergMarquardtParams()
    params.setlambdaInitial(1e-9)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    keys = [marginal.keys()[name] for name in marginal.names]
    information, _ = graph.linearize(values).hessian(ordering_of(chain.from_iterable(keys)))
    return replace(
        marginal,
        extrinsics=tuple(values.atPose3(E) for E, _ in keys),
        time_offsets_s=tuple(float(values.atVector(D)[0]) for _, D in keys),
        covariance=information_inverse(np.asarray(information)),
    )


def rig_graph(marginal: RigMarginal, known: KnownRig) -> gtsam.NonlinearFactorGraph:
    """The factor graph of a rig: the cameras' joint Gaussian on their extrinsics E and time offsets D, a
    factor for each known pose, and one between the first time offset and each other with one trigger."""
    graph, keys = gtsam.NonlinearFactorGraph(), marginal.keys()
    graph.add(marginal.factor())
    for pose in known.poses:
        E_b, E_c = keys[pose.reference][0], keys[pose.camera][0]
        graph.add(camera_pose_factor(E_b, E_c, pose.T_camera_reference, pose.covariance))
    if known.one_trigger:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, TRIGGER_SIGMA_S)
        first = keys[marginal.names[0]][1]
        for name in marginal.names[1:]:
            graph.add(gtsam.BetweenFactorVector(first, keys[name][1], np.zeros(1), noise))
    return graph


def compare_poses(
    marginal: RigMarginal, known: KnownRig, clusters: Sequence[float]
) -> tuple[ComparedPose, ...]:
    """Each known pose against the estimates of its two cameras.

    Args:
        clusters: of each camera, the effective number of clusters that its covariance rests on.
    """
    tests = len(known.poses) + known.one_trigger
    found = []
    for pose in known.poses:
        c, b = (marginal.names.index(name) for name in (pose.camera, pose.reference))
        bTl, cTl = marginal.extrinsics[b], marginal.extrinsics[c]
        step, _ = camera_pose_error(pose.T_camera_reference, bTl, cTl)
        estimated = marginal.relative_pose(pose.camera, pose.reference).covariance
        covariance = estimated + pose.covariance
        freedom = _freedom(step, covariance, estimated, min(clusters[b], clusters[c]))
        difference = Difference(step, covariance, freedom)
        found.append(ComparedPose(pose, difference, difference.p_value * tests < FALSE_ALARM))
    return tuple(found)


def compare_trigger(
    marginal: RigMarginal, known: KnownRig, clusters: Sequence[float]
) -> ComparedTrigger | None:
    """One trigger against the time offsets; None where it is not said that there is one."""
    if not known.one_trigger or len(marginal.names) < 2:
        return None
    n = len(marginal.names)
    offsets = np.arange(n) * 7 + 6
    J = np.column_stack([-np.ones(n - 1), np.eye(n - 1)])
    step = J @ np.array(marginal.time_offsets_s)
    estimated = J @ marginal.covariance[np.ix_(offsets, offsets)] @ J.T
    covariance = estimated + TRIGGER_SIGMA_S**2 * np.eye(n - 1)
    difference = Difference(step, covariance, _freedom(step, covariance, estimated, min(clusters)))
    contradicted = difference.p_value * (len(known.poses) + 1) < FALSE_ALARM
    return ComparedTrigger(marginal.names, difference, contradicted)


def _freedom(step: FloatArray, covariance: FloatArray, estimated: FloatArray, clusters: float) -> float:
    """Degrees of freedom of a covariance of which only a part is estimated, from so many clusters, along the
    step (Welch)."""
    along = np.linalg.solve(covariance, step)
    share = float(along @ estimated @ along) / max(float(along @ step), 1e-300)
    return max((clusters - 1.0) / max(share, 1e-9) ** 2, _LEAST_FREEDOM)


_LEAST_FREEDOM = 4.0
"""Least degrees of freedom, as of differences between drives: part of the covariance is the error model's."""
