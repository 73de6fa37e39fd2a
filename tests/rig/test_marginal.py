"""The Gaussian of a rig: as a factor, and the poses between its cameras."""

from __future__ import annotations

import pickle

import gtsam
import numpy as np
import pytest
from rigs import marginal_of
from wrong_objects import WRONG

from sst_graph.errors import ConfigError
from sst_graph.factors import FactorError


def test_the_factor_is_the_quadratic_of_the_covariance() -> None:
    marginal, rng = marginal_of(3), np.random.default_rng(2)
    factor, values = marginal.factor(), marginal.point()
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    d = 1e-3 * rng.standard_normal(21)
    moved = gtsam.Values()
    for k, name in enumerate(marginal.names):
        E, D = marginal.keys()[name]
        step = d[7 * k : 7 * k + 7]
        moved.insert(E, marginal.extrinsics[k].retract(step[:6]))
        moved.insert(D, np.array([marginal.time_offsets_s[k] + step[6]]))
    expected = 0.5 * float(d @ np.linalg.solve(marginal.covariance, d))
    assert factor.error(moved) == pytest.approx(expected, rel=1e-6)


def test_poses_between_cameras_are_compared_by_value() -> None:
    one, again = (marginal_of(3).relative_poses() for _ in range(2))
    assert one == again and hash(one[0]) == hash(again[0]) and one[0] != one[1]
    assert pickle.loads(pickle.dumps(one[0])) == one[0]


def test_marginals_of_the_factor_are_the_covariance() -> None:
    """By gtsam, on keys of the user's own."""
    marginal = marginal_of(2)
    keys = {"cam0": (gtsam.symbol("x", 1), gtsam.symbol("x", 2)), "cam1": (7, 8)}
    graph = gtsam.NonlinearFactorGraph()
    graph.add(marginal.factor(keys))
    marginals = gtsam.Marginals(graph, marginal.point(keys))
    found = marginals.jointMarginalCovariance([keys["cam0"][0], 7])
    own = [*range(6), *range(7, 13)]
    np.testing.assert_allclose(
        found.fullMatrix(), marginal.covariance[np.ix_(own, own)], rtol=1e-6, atol=1e-12
    )


def test_relative_pose_against_samples() -> None:
    marginal = marginal_of(2, seed=3, scale=0.1)
    pose = marginal.relative_pose("cam1", "cam0")
    bTl, cTl = marginal.extrinsics
    assert pose.T_camera_reference.equals(cTl * bTl.inverse(), 1e-12)
    rng = np.random.default_rng(4)
    steps = rng.multivariate_normal(np.zeros(14), marginal.covariance, 4000)
    found = []
    for step in steps:
        sampled = cTl.retract(step[7:13]) * bTl.retract(step[:6]).inverse()
        late = step[13] - step[6]
        found.append(np.append(gtsam.Pose3.Logmap(pose.T_camera_reference.between(sampled)), late))
    expected = np.sqrt(np.diag(np.cov(np.array(found).T)))
    claimed = np.append(np.sqrt(np.diag(pose.covariance)), pose.time_offset_sigma_s)
    np.testing.assert_allclose(claimed, expected, rtol=0.06)


def test_common_errors_cancel_between_cameras() -> None:
    """Two cameras at one place with all errors in common: their relative pose is known exactly."""
    marginal = marginal_of(2)
    own = marginal.of_camera("cam0")
    same = type(marginal)(
        marginal.names, (marginal.extrinsics[0],) * 2, (0.0, 0.0), np.kron(np.ones((2, 2)), own)
    )
    pose = same.relative_pose("cam1", "cam0")
    assert np.abs(pose.covariance).max() < 1e-12 and pose.time_offset_sigma_s < 1e-9


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match="cam0, cam1"):
        marginal_of(2).relative_pose("cam7", "cam0")


def test_keys_of_another_kind_are_refused() -> None:
    marginal = marginal_of(2)
    right = {"cam0": (1, 2), "cam1": (3, 4)}
    for call in (marginal.factor, marginal.point):
        for kind, wrong in WRONG.items():
            if kind != "None":
                with pytest.raises(FactorError, match="rig's marginal"):
                    call(wrong)
            for pair in (wrong, (wrong, 2)):
                if kind != "int" or pair is wrong:
                    with pytest.raises(FactorError, match="rig's marginal"):
                        call({**right, "cam0": pair})
        with pytest.raises(FactorError, match="distinct keys"):
            call({**right, "cam1": (1, 4)})
