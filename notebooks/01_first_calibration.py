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
# # A first calibration
#
# From a recorded drive to the pose of the LiDAR in the camera, the time offset of their clocks, and how far
# to trust both. The drive is simulated and written to disk as KITTI lays it out, so the notebook needs no
# data.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import sst_graph
from sst_graph.export import export_text
from sst_graph.metrics import calibration_errors
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.viz import draw_overlay

folder = Path(tempfile.mkdtemp()) / "drive"
street = SimulationConfig(
    seed=1,
    frames=12,
    width=621,
    height=188,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.35,
    max_range_m=60.0,
    vehicle_density=0.25,
    time_offset_s=0.1,
)
sequence = write_drive(simulate(street), folder)

# %% [markdown]
# ## Three lines
#
# `drive.nominal` is the calibration that the data bring: here it is 1.5° and 5 cm off, as after an assembly
# by hand. It is the first guess; `None` works too. Nothing is known of the time offset.

# %%
drive = sst_graph.open_source(folder, sweep="compensated")  # all points of a scan are at its stamp
result = sst_graph.calibrate(drive, drive.nominal)
print(result.status, result.T_camera_lidar, f"time offset {1e3 * result.time_offset_s:.1f} ms", sep="\n")

# %% [markdown]
# `status` is `ok` when the data determine all seven unknowns; otherwise `result.reasons` say what is
# missing.
#
# ## What a person sees
#
# The points of one scan over the picture of the same stamp. Vehicle points are green where the mask says
# vehicle, and red elsewhere. In the first row, extrinsic and time offset are the first guess.

# %%
frame = drive[1]
figure, axes = plt.subplots(2, 1, figsize=(9, 6.4))
for ax, title, cTl, offset_s in (
    (axes[0], "first guess", drive.nominal, 0.0),
    (axes[1], "calibrated", result.T_camera_lidar, result.time_offset_s),
):
    ax.imshow(draw_overlay(frame, drive.camera, cTl, offset_s)[..., ::-1])
    ax.set(title=title, xlabel="u [px, enlarged]", ylabel="v [px, enlarged]")
figure.tight_layout()

# %% [markdown]
# ## What the estimate is made of
#
# Where a scan line leaves a car, the car's outline must be. Each such boundary point has a residual: its
# distance to the outline of the mask, across it. The labels are imperfect on purpose, so not all of them
# reach zero. `attainable` is what a perfect calibration would get with such labels.

# %%
fit = result.fit
quality = fit.quality
print(f"{quality.points} points; within 1.5 px: {quality.share:.0%}, attainable: {quality.attainable:.0%}")
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
left.hist(fit.points.residuals_px, bins=np.arange(-8, 8.1, 0.5))
left.axvspan(-1.5, 1.5, color="tab:green", alpha=0.15, label="within 1.5 px")
left.set(xlabel="distance to the outline [px]", ylabel="boundary points", title="at the result")
left.legend()
places = [result.initial, *(step.cTl for step in fit.iterations)]
turned = [np.degrees(result.T_camera_lidar.localCoordinates(place)[:3]) for place in places]
right.plot(np.linalg.norm(turned, axis=1), "o-", label="rotation from the result [deg]")
kernels = [step.kernel_px / 10.0 for step in fit.iterations]
right.plot(range(1, len(kernels) + 1), kernels, "--", label="robust kernel [10 px]")
right.set(
    xlabel="outer iteration (0: the start; matched again)",
    ylabel="rotation [deg], kernel [10 px]",
    title="convergence",
)
right.legend()
figure.tight_layout()

# %% [markdown]
# ## How good it is
#
# A simulated drive knows the truth. Every estimate comes with its standard deviation; the error should lie
# within two of them about 95 times of 100. NEES is the squared error in units of the covariance: about 7 for
# the seven unknowns.

# %%
errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, drive.truth, result.covariance)
print(f"rotation {errors.qad_deg:.3f} deg, translation {100 * errors.atd_m:.2f} cm (ATD)")
print(f"time offset {1e3 * errors.time_offset_s:.1f} ms, NEES {errors.nees.joint:.1f} of 7")
step = drive.truth.cTl.localCoordinates(result.T_camera_lidar)
error = np.append(step, result.time_offset_s - drive.truth.time_offset_s)
sigma = np.sqrt(np.diag(result.covariance))
figure, axes = plt.subplots(1, 3, figsize=(9, 3))
for ax, part, unit, names, title in (
    (axes[0], slice(0, 3), np.degrees(1.0), ["x", "y", "z"], "rotation [deg]"),
    (axes[1], slice(3, 6), 100.0, ["x", "y", "z"], "translation [cm]"),
    (axes[2], slice(6, 7), 1e3, ["offset"], "time offset [ms]"),
):
    ax.errorbar(names, unit * error[part], 2 * unit * sigma[part], fmt="o", capsize=6)
    ax.axhline(0.0, color="gray", linewidth=0.8)
    ax.set(xlabel="unknown, along the LiDAR's axes", ylabel="error", title=f"{title}, ±2 sigma")
figure.tight_layout()

# %% [markdown]
# ## What others read
#
# `result.to_json()` is the file that `sst-graph calibrate` writes. `export_text` writes the formats of
# others; each states its direction and the sign of its offset.

# %%
print(export_text(result, "kalibr"))
