"""Several cameras without labels: edges, with what the cameras have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from sst_graph import CalibrationConfig
from sst_graph.batch.by_edges.choice import choice_for_cameras
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.rig import KnownPose, KnownRig
from sst_graph.rig.calibrate import calibrate_rig_prepared, prepare_rig
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.simulator.rig import beside, stereo_pose, with_mounts
from sst_graph.types import Guess, SemanticClass

STREET = SimulationConfig(seed=507, frames=14, motion="turning", azimuth_limit_deg=50.0)
START = np.array([*np.radians([2.0, -1.5, 2.0]), 0.05, -0.05, 0.05])


@cache
def rig() -> Mapping[str, SimulatedDrive]:
    drive = simulate(STREET)
    return with_mounts(drive, {"right": beside(drive, stereo_pose())}, "left")


@pytest.mark.slow
def test_two_cameras_without_labels() -> None:
    """Each is right within its sigmas; their errors are mostly the same, so that the pose between them is
    known better than either; a known pose does not make them surer than the LiDAR allows.

    The lenses, which are each camera's own, are not tested: what that leaves open is not shared.
    """
    untested = AssumptionConfig(test=False)
    config = CalibrationConfig(method="edges", decide_sweep=False, assumptions=untested)
    drives = prepare_rig({name: [drive] for name, drive in rig().items()}, config)
    guesses = {name: Guess(drive.truth.cTl.retract(START)) for name, drive in rig().items()}
    alone = calibrate_rig_prepared(drives, guesses, config, KnownRig())
    assert alone.status == "ok"
    for name, drive in rig().items():
        one = alone[name]
        step = gtsam.Pose3.Logmap(one.T_camera_lidar.between(drive.truth.cTl))
        error = np.append(step, drive.config.time_offset_s - one.time_offset_s)
        assert one.method == "edges"
        assert error @ np.linalg.solve(one.covariance, error) < 2.0 * 7.0
        assert np.degrees(np.linalg.norm(error[:3])) < 0.3
        fit = one.fit
        assert fit is not None and fit.by_edges and len(fit.profiles) == 7
        assert fit.quality.by_chance is not None and fit.quality.share > 1.5 * fit.quality.by_chance
    sigmas = np.sqrt(np.diag(alone.covariance))
    shared = np.diag(alone.covariance[:7, 7:]) / (sigmas[:7] * sigmas[7:])
    assert (shared[:3] > 0.5).all()
    between = alone.relative_pose("right", "left")
    error = gtsam.Pose3.Logmap(stereo_pose().between(between.T_camera_reference))
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert error @ np.linalg.solve(between.covariance, error) < 2.0 * 6.0

    known = KnownRig((KnownPose("right", "left", stereo_pose()),), one_trigger=True)
    together = calibrate_rig_prepared(drives, guesses, config, known)
    assert together.status == "ok" and together.diagnostics["known_poses"][0]["used"]
    for name, one in together.cameras.items():
        fit, own = one.fit, alone[name].fit
        assert fit is not None and fit.by_edges and fit.profiles == fit.iterations == () and own is not None
        assert fit.quality.share == pytest.approx(own.quality.share, abs=0.03)
        assert fit.quality.share_at_start == pytest.approx(own.quality.share_at_start, abs=0.01)
    after = np.sqrt(np.diag(together.covariance))
    assert (after < 1.01 * np.minimum(np.tile(sigmas[:7], 2), np.tile(sigmas[7:], 2)) + 1e-4).all()
    # Pitch hangs on where upper edges lie between the beams, which both cameras see alike.
    assert after[1] > 0.8 * sigmas[[1, 8]].min()


def test_method_auto_is_edges_where_a_camera_has_no_labels() -> None:
    few = simulate(replace(STREET, frames=2))
    labelled = KeptDrive.of(few)
    nothing = labelled.with_images(lambda i: replace(i, mask=np.full_like(i.mask, SemanticClass.IGNORE)))
    config = CalibrationConfig()

    def method(*cameras: KeptDrive) -> str:
        return choice_for_cameras(config, [[camera] for camera in cameras])[0].method

    assert method(labelled, labelled) == "joint"
    assert method(labelled, nothing) == method(nothing, labelled) == method(nothing, nothing) == "edges"
    by_labels, _ = choice_for_cameras(replace(config, method="joint"), [[nothing]])
    assert by_labels.method == "joint"
