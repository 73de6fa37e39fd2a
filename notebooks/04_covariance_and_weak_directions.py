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
# # Covariance and weak directions
#
# Outlines of objects at one speed cannot tell a LiDAR farther forward from an image taken later. The
# covariance shows it, the inspection says what to record next, and the marginals of two drives put together
# settle it. (The motion of both sensors, which is left out here, would tell them apart by the pitching of the
# body.)

# %%
import matplotlib.pyplot as plt
import numpy as np

import sst_graph
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.export import fuse_marginals, marginal_of_result
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.viz.inspection import inspection_plots

street = {
    "seed": 2,
    "width": 621,
    "height": 188,
    "azimuth_limit_deg": 50.0,
    "azimuth_step_deg": 0.35,
    "max_range_m": 60.0,
    "vehicle_density": 0.25,
    "moving_fraction": 0.0,
    "time_offset_s": 0.05,
}
steady = KeptDrive.of(simulate(SimulationConfig(frames=10, motion="constant", **street)))
standing = KeptDrive.of(simulate(SimulationConfig(frames=3, motion="standing", **street)))
truth = steady.truth

# %%
outlines = sst_graph.CalibrationConfig(use_motion="never")
result = sst_graph.calibrate(steady, steady.nominal, outlines)
print(result.status)
for weak in result.weak_directions:
    print(weak.sentence)

# %% [markdown]
# ## The covariance
#
# It is 7x7: rotation x y z [rad], translation x y z [m], time offset [s], by right perturbation, so along
# the LiDAR's axes (x forward, y left, z up). Divided by the standard deviations it tells what trades with
# what. Look at the pair *x* and *offset*.

# %%
names = ["rot x", "rot y", "rot z", "x", "y", "z", "offset"]
sigma = np.sqrt(np.diag(result.covariance))
figure, ax = plt.subplots(figsize=(5, 4.2))
shown = ax.imshow(result.covariance / np.outer(sigma, sigma), cmap="RdBu", vmin=-1, vmax=1)
ax.set(xticks=range(7), yticks=range(7), xticklabels=names, yticklabels=names)
ax.set(xlabel="unknown", ylabel="unknown", title="correlation [-]")
figure.colorbar(shown)
figure.tight_layout()

# %% [markdown]
# ## Why not simply the inverse Hessian?
#
# Neighbouring boundary points of one object share the error of its mask. Taken for independent, hundreds of
# them seem to determine the calibration far better than they do. The result's covariance counts each side of
# an object as one cluster. Here is the Hessian of the same matches, weights included, beside it.

# %%
points = result.fit.points
whitened = points.J * (np.sqrt(points.weights) / points.sigmas_px)[:, None]
independent = np.linalg.inv(whitened.T @ whitened)
units = np.array([np.degrees(1.0)] * 3 + [100.0] * 3 + [1e3])
figure, ax = plt.subplots(figsize=(8, 3.4))
ax.bar(np.arange(7) - 0.2, units * np.sqrt(np.diag(independent)), 0.4, label="matches taken for independent")
ax.bar(np.arange(7) + 0.2, units * sigma, 0.4, label="cluster-robust, as reported")
ax.set(xticks=range(7), xticklabels=names, yscale="log", xlabel="unknown", ylabel="sigma [deg, cm, ms]")
ax.legend()
figure.tight_layout()

# %% [markdown]
# ## What to record next
#
# The inspection predicts the covariance after more frames of several kinds of motion, by the views of this
# record. A bar below 1 means that the weakest direction is within the limits of status `ok`.

# %%
inspection = sst_graph.inspect_result(result, next_frames=10)
inspection_plots(inspection)["record_next.png"]

# %% [markdown]
# ## A second drive
#
# So a stop is recorded: three frames at rest. They say nothing about the offset, but all about the pose.
# Each drive gives a marginal: a quadratic cost on extrinsic and time offset, with the covariance of its
# result. Their sum is the calibration by both, without reading a single frame again. What each errs by alone
# becomes less; what both may err by together, such as a principal point that is off, does not. The streets
# have the same seed, so the two share a few errors of masks.

# %%
second = sst_graph.calibrate(standing, standing.nominal, outlines)
fused = fuse_marginals([marginal_of_result(result), marginal_of_result(second)])
cTl, time_offset_s = fused.best()
figure, ax = plt.subplots(figsize=(7, 4))
angle = np.linspace(0.0, 2.0 * np.pi, 200)
for label, pose, offset_s, covariance in (
    ("one speed", result.T_camera_lidar, result.time_offset_s, result.covariance),
    ("standing", second.T_camera_lidar, second.time_offset_s, second.covariance),
    ("both", cTl, time_offset_s, fused.covariance()),
):
    centre = np.array([truth.cTl.localCoordinates(pose)[3], offset_s - truth.time_offset_s])
    half = np.linalg.cholesky(covariance[np.ix_([3, 6], [3, 6])])
    x, y = centre[:, None] + 2 * half @ np.array([np.cos(angle), np.sin(angle)])
    (line,) = ax.plot(100 * x, 1e3 * y, label=label)
    ax.plot(100 * centre[0], 1e3 * centre[1], ".", color=line.get_color())
    sigma_cm, sigma_ms = 100 * covariance[3, 3] ** 0.5, 1e3 * covariance[6, 6] ** 0.5
    print(f"{label}: sigma forward {sigma_cm:.2f} cm, offset {sigma_ms:.2f} ms")
ax.plot(0, 0, "k+", markersize=12, label="truth")
ax.set(xlabel="error forward [cm]", ylabel="error of the time offset [ms]", title="2 sigma")
ax.set(xlim=(-50, 50), ylim=(-60, 60))
ax.legend()
figure.tight_layout()
