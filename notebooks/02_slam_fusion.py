# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Calibration inside a SLAM graph
#
# A vehicle drives along a simulated street in fog and returns in reverse. The fog takes the LiDAR's far
# points, half of the near ones, and blurs their range: LiDAR odometry from scan to scan is then poor along
# the street. Loop closures between the way there and the way back bound its drift. The camera is the better
# odometer, but its motion reaches the LiDAR's poses through the extrinsic and the time offset only, which
# nobody knows yet. So all of it goes into one graph:
#
# | factor | variables | from |
# |---|---|---|
# | `BetweenFactorPose3` | X(k), X(k+1) | scan-to-scan registration |
# | `BetweenFactorPose3`, robust | X(i), X(j) | loop closures |
# | `pose_alignment_factor` | X(k), X(k+1), E, D, mask biases | silhouettes of parked vehicles |
# | `camera_motion_factor` | X(k), X(k+1), X(k+2), E, D | visual odometry |

# %%
import itertools

import gtsam
import numpy as np

import sst_graph
from sst_graph.association.edge_matching import MatchConfig
from sst_graph.batch import calibrate_prepared
from sst_graph.drive.preparation import PrepareConfig, prepare_drive
from sst_graph.factors import (
    Between,
    CameraMotion,
    GroupedBias,
    RobustKernel,
    camera_motion_factor,
    pose_alignment_factor,
    time_offset_prior,
)
from sst_graph.objects.tracks import object_tracks
from sst_graph.odometry import RegisteredScan, loop_closures, metric_motions, scan_to_scan
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass

E, D, B = gtsam.symbol("E", 0), gtsam.symbol("D", 0), gtsam.symbol("B", 0)
VEHICLE = SemanticClass.VEHICLE


def X(k):
    return gtsam.symbol("X", k)


# %% [markdown]
# ## The drive, in one pass
#
# Every frame is read once: `prepare_drive` keeps boundary points, contours and image tracks, `RegisteredScan`
# what registration needs. Vehicles that move must be left out of such graphs; here none do.

# %%
fog = {"max_range_m": 20.0, "range_noise_m": 0.08, "drop_out": 0.5}
drive = simulate(
    SimulationConfig(
        seed=5,
        frames=44,
        width=621,
        height=188,
        motion="there_and_back",
        speed_mps=6.0,
        azimuth_step_deg=0.4,
        time_offset_s=0.05,
        vehicle_density=0.25,
        moving_fraction=0.0,
        **fog,
    )
)
scans = []


class OnePass:
    """The drive as it is read, its scans made ready for registration on the way."""

    name, camera, nominal, truth = drive.name, drive.camera, drive.nominal, drive.truth

    def __len__(self):
        return len(drive)

    def __getitem__(self, k):
        frame = drive[k]
        scans.append(RegisteredScan(frame.scan))
        return frame


# Contours stay where the masks have them: on small images following the picture brings nothing.
prepared = prepare_drive(OnePass(), [VEHICLE], PrepareConfig(image_edges=False))
tracks = object_tracks(prepared)
stamps_s = drive.stamps_ns * 1e-9
N = len(scans)

# %% [markdown]
# ## SLAM alone: LiDAR odometry and loop closures

# %%
slam_graph, odometry = gtsam.NonlinearFactorGraph(), gtsam.Values()
slam_graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
odometry.insert(X(0), gtsam.Pose3())
for k, motion in enumerate(scan_to_scan(scans)):
    noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
    slam_graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), motion.aTb, noise))
    odometry.insert(X(k + 1), odometry.atPose3(X(k)) * motion.aTb)

closures = loop_closures(scans, [odometry.atPose3(X(k)) for k in range(N)])
huber = gtsam.noiseModel.mEstimator.Huber.Create(1.5)
for loop in closures:
    noise = gtsam.noiseModel.Gaussian.Covariance(loop.motion.covariance)
    robust = gtsam.noiseModel.Robust.Create(huber, noise)
    slam_graph.add(gtsam.BetweenFactorPose3(X(loop.first), X(loop.second), loop.motion.aTb, robust))
slam = gtsam.LevenbergMarquardtOptimizer(slam_graph, odometry).optimize()
print(len(closures), "loop closures")

# %% [markdown]
# ## Calibration alone
#
# From the nominal extrinsic, which is 1.5 deg and 5 cm off; the time offset is taken for zero.

# %%
alone = calibrate_prepared([prepared], drive.nominal)
print(alone.status, alone.sigmas())

# %% [markdown]
# ## Both
#
# Where an image falls in the trajectory depends on the time offset, matches depend on everything: so they are
# made at an estimate, everything is optimised, and they are made again. Each image is aligned with the scan
# before it. Every vehicle has a mask bias of its own about the common one; without, the calibration is worse.
#
# This is the loop by hand, for the biases of single vehicles and for visual odometry at the same places.
# Without these, `sst_graph.AlignmentTerm` with `solve_with_terms` or `IncrementalTerms` does it
# (docs/graph/slam.md).

# %%


def places(values):
    """For every image: the scan before its true time, the poses around it and the LiDAR's motion there."""
    time_offset_s = float(values.atVector(D)[0])
    poses = [values.atPose3(X(k)) for k in range(N)]
    middles = 0.5 * (stamps_s[1:] + stamps_s[:-1])
    steps = [gtsam.Pose3.Logmap(a.between(b)) for a, b in itertools.pairwise(poses)]
    twists = np.array(steps) / np.diff(stamps_s)[:, None]
    rates = np.gradient(twists, middles, axis=0)
    found = []
    for stamp_s in stamps_s:
        a = int(np.clip(np.searchsorted(stamps_s, stamp_s + time_offset_s, "right") - 1, 0, N - 2))
        between = Between(X(a), X(a + 1), stamps_s[a + 1] - stamps_s[a], stamp_s - stamps_s[a])
        twist = twists[a] + (stamp_s + time_offset_s - middles[a]) * rates[a]
        found.append((a, between, sst_graph.ScanMotion(twist, rates[a])))
    return found


def add_silhouettes(graph, values, where, kernel_px):
    """Silhouettes of every image, and a bias for each vehicle in view."""
    seen = set()
    calibration = sst_graph.CameraCalibration(
        drive.camera,
        values.atPose3(E),
        float(values.atVector(D)[0]),
        {VEHICLE: float(values.atVector(B)[0])},
    )
    matching = sst_graph.FrameMatching(kernel=RobustKernel("geman_mcclure", kernel_px), config=MatchConfig())
    for image, (a, between, motion) in zip(prepared.images, where, strict=True):
        found = sst_graph.align_frame(prepared.scans[a], image, calibration, motion, matching)
        if not len(found):
            continue
        keys = [gtsam.symbol("o", tracks[a, VEHICLE, int(number)]) for number in found.objects[0]]
        biases, groups = np.unique(np.array(keys, dtype=np.uint64), return_inverse=True)
        biases = tuple(int(key) for key in biases)
        seen |= set(biases)
        bias = GroupedBias(biases, groups)
        graph.add(pose_alignment_factor(found.alignments, between, E, D, bias))
    for key in seen:
        graph.add(gtsam.BetweenFactorVector(B, key, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.5)))
    return seen


def add_visual_odometry(graph, values, where):
    """The camera's motions, metric by the depth that the present calibration gives to image features."""
    cTl, time_offset_s = values.atPose3(E), float(values.atVector(D)[0])

    def depth(k):
        a, between, motion = where[k]
        moved = cTl * gtsam.Pose3.Expmap(-(between.image_after_a_s + time_offset_s) * motion.l_twist)
        return moved.transformFrom(prepared.scans[a].depth_lPs.T.astype(float)).T

    # between two poses the body does not quite move with one twist
    rough = np.diag(np.repeat([3.5e-4, 4e-3], 3) ** 2)
    motions = metric_motions(prepared.image_pairs, drive.camera, depth)
    for (first, second), motion in zip(itertools.pairwise(where), motions, strict=True):
        if motion.ok:
            measured = CameraMotion(motion.aTb, motion.covariance + rough)
            graph.add(camera_motion_factor(first[1], second[1], E, D, measured))


values = gtsam.Values(slam)
values.insert(E, alone.T_camera_lidar)
values.insert(D, np.array([alone.time_offset_s]))
values.insert(B, np.zeros(1))
loose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.2, 0.5], 3))
for kernel_px in (5.0, 4.0, 3.0, 3.0, 3.0):
    graph = gtsam.NonlinearFactorGraph(slam_graph)
    graph.add(gtsam.PriorFactorPose3(E, drive.nominal, loose))
    graph.add(time_offset_prior(D, 0.0, 1.0))
    graph.add(time_offset_prior(B, 0.0, 3.0))
    where = places(values)
    seen = add_silhouettes(graph, values, where, kernel_px)
    add_visual_odometry(graph, values, where)
    start = gtsam.Values()
    for key in [E, D, B, *map(X, range(N))]:
        start.insert(key, values.atPose3(key) if key not in (D, B) else values.atVector(key))
    for key in seen:
        start.insert(key, values.atVector(key) if values.exists(key) else values.atVector(B))
    values = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
both = values

# %% [markdown]
# ## Errors

# %%


def rms(vectors):
    return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=1))))


def trajectory_errors(values):
    """Position [cm], and rotation [deg] and translation [cm] from scan to scan; RMS."""
    wTl = [drive.wTl(t) for t in stamps_s]
    true = [wTl[0].between(pose) for pose in wTl]
    found = [values.atPose3(X(k)) for k in range(N)]
    off = [f.translation() - t.translation() for f, t in zip(found, true, strict=True)]
    steps = np.array(
        [true[k].between(true[k + 1]).localCoordinates(found[k].between(found[k + 1])) for k in range(N - 1)]
    )
    return {
        "position_cm": 100 * rms(off),
        "step_deg": float(np.degrees(rms(steps[:, :3]))),
        "step_cm": 100 * rms(steps[:, 3:]),
    }


def calibration_errors(cTl, time_offset_s):
    d = drive.truth.cTl.localCoordinates(cTl)
    return {
        "rotation_deg": float(np.degrees(np.linalg.norm(d[:3]))),
        "translation_cm": float(100 * np.linalg.norm(d[3:])),
        "offset_ms": float(1e3 * abs(time_offset_s - drive.truth.time_offset_s)),
    }


table = {
    "odometry": trajectory_errors(odometry),
    "SLAM alone": trajectory_errors(slam),
    "calibration alone": calibration_errors(alone.T_camera_lidar, alone.time_offset_s),
    "both": trajectory_errors(both) | calibration_errors(both.atPose3(E), float(both.atVector(D)[0])),
}
for name, errors in table.items():
    print(f"{name:18s}", "  ".join(f"{key} {value:.3g}" for key, value in errors.items()))

# %% [markdown]
# One street proves little: `sst-graph experiment slam` makes the table of docs/measured/slam.md over several,
# in fog and in clear air, where LiDAR odometry is good to two millimetres a frame and the camera adds
# nothing to it.
