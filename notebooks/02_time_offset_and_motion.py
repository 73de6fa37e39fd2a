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
# # What the time offset and the motion do
#
# Two clocks that disagree by 100 ms look like a calibration that is up to a metre off, but only while the
# vehicle moves. This notebook shows the error in the picture, and which motion separates it from the
# extrinsic.

# %%
import gtsam
import matplotlib.pyplot as plt
import numpy as np

from sst_graph.factors import Alignment, silhouette_factor
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.viz import draw_overlay

drive = simulate(
    SimulationConfig(
        seed=4,
        frames=8,
        width=621,
        height=188,
        azimuth_limit_deg=50.0,
        azimuth_step_deg=0.35,
        vehicle_density=0.3,
        motion="no_stop",
        moving_fraction=0.0,
        time_offset_s=0.1,
        label_noise=0.0,
    )
)
camera, truth = drive.camera, drive.truth

# %% [markdown]
# ## Two clocks
#
# `t_lidar = t_camera_stamp + time_offset_s`. Here the offset is +100 ms: an image stamped 0.2 s shows the
# world at 0.3 s of the LiDAR's clock. Pairing by equal stamps therefore pairs a scan with a picture of
# later.

# %%
stamps_s = drive.stamps_ns * 1e-9
figure, ax = plt.subplots(figsize=(9, 2.6))
ax.plot(stamps_s, np.full(len(stamps_s), 2), "s", label="scan")
ax.plot(stamps_s, np.full(len(stamps_s), 1), "o", mfc="none", color="tab:orange", label="image, as stamped")
ax.plot(
    stamps_s + truth.time_offset_s, np.zeros(len(stamps_s)), "o", color="tab:orange", label="image, in truth"
)
ax.plot([stamps_s, stamps_s + truth.time_offset_s], [1, 0], color="gray", linewidth=0.8)
ax.set(
    xlabel="time of the LiDAR's clock [s]", ylabel="sensor", yticks=[], ylim=(-0.5, 2.5), xlim=(-0.1, 1.15)
)
ax.legend(loc="upper right")
figure.tight_layout()

# %% [markdown]
# ## In the picture
#
# The twist of the camera is `[omega, v]` in its own frame. A static point that the camera sees at `cP` is at
# `Exp(-twist * tau) . cP` when `tau` has passed, `tau` being the image's true time minus the scan's. With
# equal stamps, `tau` is the offset itself. The extrinsic is the true one in both pictures, which show the
# right third of the image.

# %%
k, dt = 4, 1e-3
c_twist = gtsam.Pose3.Logmap(drive.wTc(stamps_s[k]).between(drive.wTc(stamps_s[k] + dt))) / dt
print("turning [deg/s]", np.degrees(c_twist[:3]).round(1), " moving [m/s]", c_twist[3:].round(1))
frame = drive[k]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
for ax, offset_s, title in (
    (axes[0], 0.0, "offset taken for 0"),
    (axes[1], truth.time_offset_s, "offset 100 ms"),
):
    ax.imshow(draw_overlay(frame, camera, truth.cTl, offset_s, c_twist)[..., ::-1])
    ax.set(title=title, xlabel="u [px, enlarged]", ylabel="v [px, enlarged]")
    ax.set(xlim=(760, 1242), ylim=(400, 190))
figure.tight_layout()

# %% [markdown]
# ## Near or far, straight on or turning
#
# Driving moves near points and hardly touches far ones; turning moves all of them alike, and much more. A
# point 3 m to the right of the camera's axis:

# %%
offsets_s = np.linspace(-0.1, 0.1, 41)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
for ax, twist, title in (
    (axes[0], np.array([0, 0, 0, 0, 0, 10.0]), "straight on at 10 m/s"),
    (axes[1], np.array([0, np.radians(20), 0, 0, 0, 5.0]), "5 m/s, turning right at 20 deg/s"),
):
    for depth_m in (10.0, 20.0, 40.0):
        cPs = [
            gtsam.Pose3.Expmap(-twist * tau).transformFrom(np.array([3.0, 0.0, depth_m])) for tau in offsets_s
        ]
        uvs = camera.project(np.array(cPs))
        ax.plot(1e3 * offsets_s, uvs[:, 0] - uvs[20, 0], label=f"{depth_m:.0f} m away")
    ax.set(
        title=title,
        xlabel="time offset that is ignored [ms]",
        ylabel="object lies right of its points by [px]",
    )
    ax.legend()
figure.tight_layout()

# %% [markdown]
# ## Which motion tells offset from translation?
#
# At one speed straight on, the cloud shifted forward and the image taken later look the same: both move
# every point by the same amount. The information of the factors says so. Below, sixty boundary points are
# seen in each of ten frames, each with an error of 1 px across its outline; only the motion differs.

# %%
E, D = gtsam.symbol("E", 0), gtsam.symbol("D", 0)
values = gtsam.Values()
values.insert(E, truth.cTl)
values.insert(D, np.array([truth.time_offset_s]))
forward, turn = np.array([0, 0, 0, 0, 0, 1.0]), np.array([0, 1.0, 0, 0, 0, 0])
motions = {
    "standing": [0 * forward] * 10,
    "8 m/s, steady to 0.2 m/s": [speed * forward for speed in np.linspace(7.8, 8.2, 10)],
    "braking from 8 to 0 m/s": [speed * forward for speed in np.linspace(8, 0, 10)],
    "5 m/s, turning ±15 deg/s": [5 * forward + rate * turn for rate in np.radians(np.linspace(-15, 15, 10))],
}
figure, (ax, closer) = plt.subplots(1, 2, figsize=(9, 4.2))
for name, twists in motions.items():
    rng, information = np.random.default_rng(0), np.zeros((7, 7))
    for twist in twists:
        lPs = np.column_stack([rng.uniform(6, 30, 60), rng.uniform(-6, 6, 60), rng.uniform(-1.5, 0.5, 60)])
        angles = rng.choice([0.0, np.pi, -np.pi / 2], 60)  # right, left and top edges
        normals = np.column_stack([np.cos(angles), np.sin(angles)])
        pixels = camera.project(truth.cTl.transformFrom(lPs.T).T)
        matches = Alignment(camera, lPs, 0.0, pixels, sigmas_px=1.0, normals=normals)
        information += silhouette_factor(matches, E, D, twist).linearize(values).information()
    weak = np.linalg.eigvalsh(information)[0]
    if weak < 1e-3:
        print(f"{name}: not determined (smallest eigenvalue {weak:.1g})")
        continue
    covariance = np.linalg.inv(information)[np.ix_([3, 6], [3, 6])]
    sigma_cm, sigma_ms = np.sqrt(np.diag(covariance)) * [100, 1e3]
    print(f"{name}: forward {sigma_cm:.2f} cm, offset {sigma_ms:.2f} ms")
    circle = np.array([np.cos(np.linspace(0, 2 * np.pi, 100)), np.sin(np.linspace(0, 2 * np.pi, 100))])
    ellipse = 2 * np.linalg.cholesky(covariance) @ circle
    for axes in (ax, closer):
        axes.plot(100 * ellipse[0], 1e3 * ellipse[1], label=name)
ax.set(xlabel="error forward [cm]", ylabel="error of the time offset [ms]", title="2 sigma")
closer.set(xlabel="error forward [cm]", ylabel="error of the time offset [ms]", title="enlarged")
closer.set(xlim=(-2.0, 2.0), ylim=(-4.0, 4.0))
ax.legend()
figure.tight_layout()

# %% [markdown]
# Standing says nothing about the offset (its ellipse has no end, and is not drawn). One speed gives a long
# thin ellipse whose slope is that speed. A stop or a turn closes it. `calibrate` reports such a direction
# with its size and says what to record; the next notebooks show how.
