# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Calibration inside a SLAM graph
#
# A SLAM back-end already has the poses of the vehicle as variables. The calibration joins as two more,
# extrinsic and time offset, tied to the poses by one factor an image. Both are then solved together, and the
# calibration's covariance contains the uncertainty of the trajectory.
#
# | factor | variables | from |
# |---|---|---|
# | `BetweenFactorPose3` | X(k), X(k+1) | scan-to-scan registration |
# | `BetweenFactorPose3`, robust | X(i), X(j) | loop closures |
# | `AlignmentTerm` | X(k), X(k+1), E, D | an image's silhouettes |

# %%
import gtsam
import matplotlib.pyplot as plt
import numpy as np
from gtsam.symbol_shorthand import D, E, X

from sst_graph import AlignmentKeys, AlignmentTerm, IncrementalTerms, Trajectory, solve_with_terms
from sst_graph.odometry import RegisteredScan, loop_closures, scan_to_scan
from sst_graph.simulator import SimulationConfig, simulate

# %% [markdown]
# ## The drive
#
# There and back along a street, in reverse, so that there are loops to close. Haze takes the far points and
# blurs the range.

# %%
drive = simulate(
    SimulationConfig(
        seed=5,
        frames=20,
        frame_rate_hz=5.0,
        width=621,
        height=188,
        azimuth_limit_deg=70.0,
        azimuth_step_deg=0.4,
        max_range_m=40.0,
        range_noise_m=0.05,
        drop_out=0.2,
        motion="there_and_back",
        speed_mps=6.0,
        vehicle_density=0.25,
        moving_fraction=0.0,
        time_offset_s=0.05,
    )
)
frames = list(drive)
scans = [RegisteredScan(frame.scan) for frame in frames]
stamps_ns = [frame.scan.stamp_ns for frame in frames]

# %% [markdown]
# ## Your SLAM: odometry and loop closures

# %%
slam_graph, odometry = gtsam.NonlinearFactorGraph(), gtsam.Values()
slam_graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
odometry.insert(X(0), gtsam.Pose3())
for k, motion in enumerate(scan_to_scan(scans)):
    noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
    slam_graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), motion.aTb, noise))
    odometry.insert(X(k + 1), odometry.atPose3(X(k)) * motion.aTb)

closures = loop_closures(scans, [odometry.atPose3(X(k)) for k in range(len(scans))], every=2, min_seconds=1.2)
huber = gtsam.noiseModel.mEstimator.Huber.Create(1.5)
for loop in closures:
    noise = gtsam.noiseModel.Gaussian.Covariance(loop.motion.covariance)
    robust = gtsam.noiseModel.Robust.Create(huber, noise)
    slam_graph.add(gtsam.BetweenFactorPose3(X(loop.first), X(loop.second), loop.motion.aTb, robust))
slam = gtsam.LevenbergMarquardtOptimizer(slam_graph, odometry).optimize()
print(len(closures), "loop closures")

# %% [markdown]
# ## The calibration joins
#
# Two variables with priors that say what is known beforehand, and a term for each image with the scans that
# may be nearest to its true time. A term matches anew at every estimate, for where an image falls in the
# trajectory depends on the offset.

# %%
graph, values = gtsam.NonlinearFactorGraph(slam_graph), gtsam.Values(slam)
values.insert(E(0), drive.nominal)
values.insert(D(0), np.zeros(1))
loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.05, 0.05, 0.1, 0.1, 0.1]))
calibration_priors = gtsam.NonlinearFactorGraph()
calibration_priors.add(gtsam.PriorFactorPose3(E(0), drive.nominal, loose))
calibration_priors.add(gtsam.PriorFactorVector(D(0), np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
graph.push_back(calibration_priors)

keys = AlignmentKeys(Trajectory([X(k) for k in range(len(frames))], stamps_ns), E(0), D(0))
terms = [
    AlignmentTerm([f.scan for f in frames[max(0, k - 1) : k + 2]], frame.image, drive.camera, keys)
    for k, frame in enumerate(frames)
]
solution = solve_with_terms(graph, values, terms)
sigma = np.sqrt(np.diag(solution.covariance))
print("converged:", solution.converged, "after", solution.rounds, "rounds of matching")
for warning in solution.warnings:
    print(warning)

# %% [markdown]
# ## Calibration, before and after

# %%
units, names = (
    np.array([np.degrees(1.0)] * 3 + [100.0] * 3 + [1e3]),
    ["rot x", "rot y", "rot z", "x", "y", "z", "offset"],
)
start = np.append(drive.truth.cTl.localCoordinates(drive.nominal), -drive.truth.time_offset_s)
error = np.append(
    drive.truth.cTl.localCoordinates(solution.values.atPose3(E(0))),
    solution.values.atVector(D(0))[0] - drive.truth.time_offset_s,
)
figure, ax = plt.subplots(figsize=(8, 3.4))
ax.plot(range(7), units * start, "x", color="tab:red", label="start")
ax.errorbar(
    range(7), units * error, 2 * units * sigma, fmt="o", capsize=5, label="in the SLAM graph, ±2 sigma"
)
ax.axhline(0.0, color="gray", linewidth=0.8)
ax.set(xticks=range(7), xticklabels=names, yscale="symlog", xlabel="unknown", ylabel="error [deg, cm, ms]")
ax.legend()
figure.tight_layout()

# %% [markdown]
# ## The trajectory

# %%
wTl = [drive.wTl(1e-9 * stamp) for stamp in stamps_ns]
position = {
    name: np.array([found.atPose3(X(k)).translation() for k in range(len(frames))])
    for name, found in (("odometry", odometry), ("with loops", slam), ("with the camera", solution.values))
}
true = np.array([wTl[0].between(pose).translation() for pose in wTl])
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
left.plot(*true[:, :2].T, "k-", linewidth=5, alpha=0.2, label="truth")
# Two of the lines nearly agree: the later one is thin and dashed, so that both show.
for (name, found), style, width in zip(position.items(), ("-", "-", "k--"), (1.0, 2.5, 1.2), strict=True):
    left.plot(*found[:, :2].T, style, linewidth=width, label=name)
    right.plot(100 * np.linalg.norm(found - true, axis=1), style, linewidth=width, label=name)
left.set(xlabel="forward [m]", ylabel="left [m]", title="from above")
right.set(xlabel="scan", ylabel="error of the position [cm]")
left.legend()
right.legend()
figure.tight_layout()

# %% [markdown]
# In a graph as small as this the camera adds little to the trajectory: it is the calibration that gains.
# `sst-graph experiment slam` measures both over several streets.
#
# ## The same, as the frames come
#
# `IncrementalTerms` wraps a solver of yours, here `ISAM2`, and swaps the factors of its terms as the
# estimate moves. Loop closures enter with the later of their two scans.
#
# While the kernel is wide (`update.kernel_px`), the covariance is the solver's own: it counts matches as
# independent and contains the proximal prior, and is too small. So the curves below rise once, where the
# kernel has become narrow and the cluster-robust covariance takes over.

# %%
parameters = gtsam.ISAM2Params()
parameters.relinearizeSkip = 1
parameters.setRelinearizeThreshold(1e-4)  # the default, 0.1 (rad, m, s), is far too coarse here
trajectory = Trajectory()
online = IncrementalTerms(gtsam.ISAM2(parameters), AlignmentKeys(trajectory, E(0), D(0)))
history = []
for k, frame in enumerate(frames):
    factors, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(slam_graph.size()):
        if max(slam_graph.at(i).keys()) == X(k):
            factors.add(slam_graph.at(i))
    new.insert(X(k), odometry.atPose3(X(k)))
    if k == 0:
        factors.push_back(calibration_priors)
        new.insert(E(0), drive.nominal)
        new.insert(D(0), np.zeros(1))
    trajectory.append(X(k), stamps_ns[k])
    near = [f.scan for f in frames[max(0, k - 1) : k + 1]]
    term = AlignmentTerm(near, frame.image, drive.camera, AlignmentKeys(trajectory, E(0), D(0)))
    history.append(online.update(factors, new, [term]))
history.append(online.converge())

# %%
sigmas = np.array([units * np.sqrt(np.diag(update.covariance)) for update in history])
figure, ax = plt.subplots(figsize=(8, 3.4))
for column, label in ((2, "rotation about z [deg]"), (3, "forward [cm]"), (6, "time offset [ms]")):
    ax.semilogy(np.arange(1, len(sigmas)), sigmas[1:, column], ".-", label=label)
ax.set(xlabel="frame", ylabel="sigma [deg, cm, ms]", title="ISAM2: what each frame adds")
ax.legend()
figure.tight_layout()
