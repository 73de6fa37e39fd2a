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
# # Your own data: a ROS bag
#
# From a bag to a calibration, with the commands that you would type. The bag is a simulated drive as a
# vehicle records it: images, masks, camera_info, clouds with a label for each point, and /tf_static. With a
# bag of your own, begin at *What is in it*.

# %%
import json
import tempfile
from pathlib import Path

import cv2
import gtsam
import matplotlib.pyplot as plt
import numpy as np

import sst_graph
from sst_graph.cli import main
from sst_graph.simulator import SimulationConfig, simulate, write_bag
from sst_graph.viz import draw_overlay

folder = Path(tempfile.mkdtemp())
bag, result = str(folder / "bag"), str(folder / "result")
street = SimulationConfig(
    seed=7,
    frames=12,
    width=621,
    height=188,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.35,
    max_range_m=60.0,
    vehicle_density=0.25,
    time_offset_s=0.06,
)
drive = simulate(street)
written = write_bag(drive, bag)

# %% [markdown]
# ## What is in it
#
# `main([...])` is the command `sst-graph ...`. This bag has two topics of images, so the options say which
# is which; with one of a kind no option is needed.

# %%
topics = ["--image-topic", "/camera/image_rect", "--mask-topic", "/camera/mask"]
print("exit code", main(["info", bag, *topics]))

# %% [markdown]
# Read the end first: it says for which method something is missing. Without masks and labels, `--method
# edges` needs none.
#
# ## Does it look right before any calibration?
#
# The projected cloud should at least roughly resemble the picture. If it is mirrored, turned by 90° or
# empty, the transforms in /tf_static are wrong; then use `--init none`, or a file.

# %%
source = sst_graph.open_source(bag, image_topic=topics[1], mask_topic=topics[3])
frame = source[0]
figure, ax = plt.subplots(figsize=(9, 3.2))
ax.imshow(draw_overlay(frame, source.camera, source.nominal, 0.0)[..., ::-1])
ax.set(title="the start, by /tf_static", xlabel="u [px, enlarged]", ylabel="v [px, enlarged]")
figure.tight_layout()

# %% [markdown]
# ## Calibrate
#
# `--sweep compensated` says that all points of a cloud belong to its stamp, as a driver with motion
# compensation gives them. Leave it out where each point has its own time. The exit code is 0 for status
# `ok`, 3 where the result is not to be trusted.

# %%
code = main(["calibrate", bag, *topics, "--sweep", "compensated", "--out", result])
print("exit code", code)

# %% [markdown]
# ## What was written
#
# `calibration.json` for programs, `report.html` to look at, `report.md`, and overlays: before above, after
# below.

# %%
print(sorted(path.name for path in Path(result).iterdir()))
found = json.loads(Path(result, "calibration.json").read_text())
print("true offset 60 ms, found", f"{1e3 * found['time_offset_s']:.1f} ms")
picture = cv2.imread(str(sorted(Path(result).glob("overlay_*.png"))[0]))
figure, ax = plt.subplots(figsize=(9, 6.4))
ax.imshow(picture[..., ::-1])
ax.set(title="before and after", xlabel="u [px, enlarged]", ylabel="v [px, enlarged]")
figure.tight_layout()

# %% [markdown]
# ## How far to trust it
#
# The sigmas in the picture, where a person can judge them: how far a point at some distance may be off, in
# pixels. Then what to record if that is not enough.

# %%
calibration = sst_graph.CalibrationResult.from_json(Path(result, "calibration.json").read_text())
ranges_m = np.linspace(4.0, 60.0, 57)
sigma_px = []
for range_m in ranges_m:
    lP = np.array([range_m, 0.0, 0.0])
    cP = calibration.T_camera_lidar.transformFrom(lP)[None]
    R = calibration.T_camera_lidar.rotation().matrix()
    J = calibration.camera.uv_H_cP(cP)[0] @ R @ np.hstack([-gtsam.Rot3.Hat(lP), np.eye(3)])
    sigma_px.append(np.sqrt(np.diag(J @ calibration.covariance[:6, :6] @ J.T)))
figure, ax = plt.subplots(figsize=(7, 3.4))
ax.plot(ranges_m, sigma_px, label=["across", "down"])
ax.set(
    xlabel="distance straight ahead, vehicle at rest [m]", ylabel="sigma in the picture [px]", ylim=(0, None)
)
ax.legend()
figure.tight_layout()

# %%
print("exit code", main(["inspect", result, "--next", "6"]))

# %% [markdown]
# `main(["export", result, "--to", "ros-tf"])` and its siblings write it for others.
