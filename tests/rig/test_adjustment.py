"""What is known of a rig, fused with the estimates of its cameras."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from rigs import marginal_of

from sst_graph.errors import ConfigError
from sst_graph.factors.camera_pose import camera_pose_error
from sst_graph.inspect.reasons import short_reason
from sst_graph.rig import KnownPose, KnownRig, RigMarginal
from sst_graph.rig.adjustment import adjusted, compare_poses, compare_trigger
from sst_graph.rig.known import TRIGGER_SIGMA_S, poses_by_nominal


def _pose(marginal: RigMarginal, error: np.ndarray | None = None, **sigmas: float) -> KnownPose:
    bTl, cTl = marginal.extrinsics[:2]
    step = gtsam.Pose3.Expmap(np.zeros(6) if error is None else error)
    return KnownPose("cam1", "cam0", cTl * bTl.inverse() * step, **sigmas)


def test_nothing_known_changes_nothing() -> None:
    marginal = marginal_of(3)
    assert adjusted(marginal, KnownRig()) is marginal


def test_as_the_linear_update_has_it() -> None:
    """Small errors: the Kalman update in closed form."""
    marginal = marginal_of(2, scale=0.05)
    known = _pose(marginal, 1e-4 * np.array([1.0, -2, 0.5, 3, 1, -1]))
    error, H = camera_pose_error(known.T_camera_reference, *marginal.extrinsics)
    assert H is not None
    J = np.zeros((6, 14))
    J[:, :6], J[:, 7:13] = H
    P = marginal.covariance
    K = P @ J.T @ np.linalg.inv(J @ P @ J.T + known.covariance)
    step, after = -K @ error, P - K @ J @ P
    found = adjusted(marginal, KnownRig((known,)))
    for k in range(2):
        moved = marginal.extrinsics[k].localCoordinates(found.extrinsics[k])
        np.testing.assert_allclose(moved, step[7 * k : 7 * k + 6], atol=2e-7)
        late = found.time_offsets_s[k] - marginal.time_offsets_s[k]
        assert late == pytest.approx(step[7 * k + 6], abs=1e-7)
    sigmas = np.sqrt(np.outer(np.diag(after), np.diag(after)))
    np.testing.assert_allclose(found.covariance / sigmas, after / sigmas, atol=2e-3)


def test_an_exact_pose_carries_the_better_camera_over_to_the_weaker() -> None:
    marginal = marginal_of(2)
    covariance = np.zeros((14, 14))
    covariance[:7, :7] = np.diag([1e-4] * 3 + [1e-3] * 3 + [1e-3]) ** 2
    covariance[7:, 7:] = np.diag([1.0] * 3 + [2.0] * 3 + [1.0]) ** 2
    marginal = replace(marginal, covariance=covariance)
    known = _pose(marginal, rotation_sigma_deg=1e-6, translation_sigma_m=1e-6)
    found = adjusted(marginal, KnownRig((known,), one_trigger=True))
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[7:10].max() < 1.1e-4
    # An angle of 0.1 mrad at the lever arm between the cameras moves the other one.
    arm = np.linalg.norm(known.T_camera_reference.translation())
    assert sigmas[10:13].max() < 1.1e-3 + 1.1e-4 * arm
    assert sigmas[13] == pytest.approx(np.hypot(1e-3, TRIGGER_SIGMA_S), rel=1e-3)


@pytest.mark.parametrize(("turn_deg", "contradicted"), [(0.0, False), (0.1, False), (3.0, True)])
def test_a_pose_that_contradicts_the_estimates(turn_deg: float, contradicted: bool) -> None:
    """The estimates of both cameras are known to 0.06 deg, from 50 sides of objects each."""
    marginal = marginal_of(2)
    known = _pose(marginal, np.array([0.0, np.radians(turn_deg), 0, 0, 0, 0]))
    (compared,) = compare_poses(marginal, KnownRig((known,)), [50.0, 50.0])
    assert compared.contradicted is contradicted
    if contradicted:
        assert "known pose of cam1 in cam0 contradicts" in compared.sentence
        assert "rotation by 3.0" in compared.sentence and "chi-squared" in compared.sentence
        assert short_reason(compared.sentence) == (
            "the known pose of cam1 in cam0 contradicts the estimates: check which camera moved, "
            "the cameras' names and the transform's direction"
        )


def test_false_alarms_are_as_rare_as_they_should_be() -> None:
    """Estimates drawn from their covariance: the p-value of a known pose is uniform."""
    marginal, rng = marginal_of(2, scale=0.2), np.random.default_rng(5)
    known = _pose(marginal)
    p_values = []
    for step in rng.multivariate_normal(np.zeros(14), marginal.covariance, 400):
        measured = gtsam.Pose3.Expmap(np.sqrt(np.diag(known.covariance)) * rng.standard_normal(6))
        moved = replace(
            marginal,
            extrinsics=tuple(
                cTl.retract(step[7 * k : 7 * k + 6]) for k, cTl in enumerate(marginal.extrinsics)
            ),
        )
        drawn = replace(known, T_camera_reference=known.T_camera_reference * measured)
        (compared,) = compare_poses(moved, KnownRig((drawn,)), [1e9, 1e9])
        p_values.append(compared.difference.p_value)
    assert abs(np.mean(p_values) - 0.5) < 0.05
    assert 0.02 < np.mean(np.array(p_values) < 0.05) < 0.09


def test_few_clusters_need_a_larger_difference() -> None:
    marginal = marginal_of(2)
    known = _pose(marginal, np.array([0.0, 0.008, 0, 0, 0, 0]))
    many, few = (
        compare_poses(marginal, KnownRig((known,)), [clusters] * 2)[0].difference.p_value
        for clusters in (1e9, 6.0)
    )
    assert few > 10.0 * many


def test_one_trigger() -> None:
    marginal = replace(marginal_of(3), time_offsets_s=(0.05, 0.051, 0.049))
    compared = compare_trigger(marginal, KnownRig(one_trigger=True), [50.0] * 3)
    assert compared is not None and not compared.contradicted
    found = adjusted(marginal, KnownRig(one_trigger=True))
    assert np.ptp(found.time_offsets_s) < 5 * TRIGGER_SIGMA_S
    apart = replace(marginal, time_offsets_s=(0.05, 0.05, 0.15))
    compared = compare_trigger(apart, KnownRig(one_trigger=True), [50.0] * 3)
    assert compared is not None and compared.contradicted
    assert "cam2 +100.0" in compared.sentence
    assert short_reason(compared.sentence) == (
        "one trigger of all cameras contradicts their time offsets: check whether the cameras are "
        "triggered together, and whether images were lost"
    )
    assert compare_trigger(marginal, KnownRig(), [50.0] * 3) is None


def test_what_cannot_be_known() -> None:
    with pytest.raises(ConfigError, match="in itself"):
        KnownPose("a", "a", gtsam.Pose3())
    with pytest.raises(ConfigError, match="rotation_sigma_deg"):
        KnownPose("a", "b", gtsam.Pose3(), rotation_sigma_deg=0.0)
    with pytest.raises(ConfigError, match="'c': expected one of a, b"):
        KnownRig((KnownPose("c", "a", gtsam.Pose3()),)).check(["a", "b"])
    with pytest.raises(ConfigError, match="'b': the data bring no nominal extrinsic"):
        poses_by_nominal({"a": gtsam.Pose3(), "b": None})
