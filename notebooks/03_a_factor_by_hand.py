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
# # A factor by hand
#
# The residual that carries the calibration, written from scratch: its equation, its sign on paper, its
# Jacobian compared with a numerical one, as a `gtsam.CustomFactor`, and in an optimisation.

# %%
import gtsam
import matplotlib.pyplot as plt
import numpy as np
from gtsam.utils.numerical_derivative import numericalDerivative11

import sst_graph
from sst_graph.factors import PinholeCamera, check_jacobians, custom_factor, silhouette_factor
from sst_graph.simulator import SimulationConfig, simulate

# %% [markdown]
# ## The equation
#
# A boundary point `lP` of the LiDAR belongs on the contour of its object's mask, near the pixel `q` where
# the contour's outward normal is `n`. The camera moves with the twist `w`:
#
# ```
# tau = t_image + time_offset - t_point          time from the point to the image [s]
# r   = n . (uv(Exp(-tau w) T_camera_lidar lP) - q)                          [px]
# ```
#
# ## The sign, on paper
#
# Focal length 700 px, a point 1 m to the right and 10 m ahead, the vehicle straight on at 10 m/s. At `tau =
# 0` the point is at u = 700 · 1 / 10 = 70 px right of the centre. The image of 0.1 s later sees it 9 m
# ahead, at 700 / 9 = 77.8 px: it moved *to the right*. So with `n` to the right, `dr/dtau` is positive, and
# at `tau = 0` it is f x v / z² = 700 · 1 · 10 / 100 = **+70 px/s**.

# %%
pinhole = PinholeCamera(700.0, 700.0, 0.0, 0.0, 1000, 1000)
forward = np.array([0, 0, 0, 0, 0, 10.0])
for tau in (0.0, 1e-6, 0.1):
    cP = gtsam.Pose3.Expmap(-tau * forward).transformFrom(np.array([1.0, 0.0, 10.0]))
    u = pinhole.project(cP[None])[0, 0]
    print(f"tau {tau:7.6f} s: u = {u:9.5f} px", f"({(u - 70) / tau:.3f} px/s)" if tau else "")

# %% [markdown]
# ## Matches to work with
#
# One simulated frame, while driving. `align_frame` pairs boundary points with contours, here at the true
# calibration. An `Alignment` holds what the equation needs.

# %%
drive = simulate(
    SimulationConfig(
        seed=4,
        frames=2,
        width=621,
        height=188,
        azimuth_limit_deg=50.0,
        azimuth_step_deg=0.35,
        vehicle_density=0.3,
        motion="no_stop",
        moving_fraction=0.0,
        time_offset_s=0.05,
    )
)
frame, camera, truth, stamp_s = drive[0], drive.camera, drive.truth, drive.stamps_ns[0] * 1e-9
l_twist = gtsam.Pose3.Logmap(drive.wTl(stamp_s).between(drive.wTl(stamp_s + 1e-3))) / 1e-3
c_twist = truth.cTl.AdjointMap() @ l_twist
calibration = sst_graph.CameraCalibration(camera, truth.cTl, truth.time_offset_s)
(matches,) = sst_graph.align_frame(
    frame.scan, frame.image, calibration, sst_graph.ScanMotion(l_twist)
).alignments

moved = gtsam.Pose3.Expmap(-truth.time_offset_s * c_twist) * truth.cTl
uvs = camera.project(moved.transformFrom(matches.lPs.T).T)
figure, ax = plt.subplots(figsize=(9, 3.6))
ax.imshow(frame.image.pixels[..., ::-1])
ax.quiver(
    *matches.pixels.T, *matches.normals.T, angles="xy", scale=45, width=0.0015, color="yellow", label="q, n"
)
ax.plot(*uvs.T, ".", color="red", markersize=3, label="uv(cP)")
ax.set(
    xlim=(250, 420), ylim=(130, 70), xlabel="u [px]", ylabel="v [px]", title=f"{len(matches)} matches in all"
)
ax.legend(loc="upper right")
figure.tight_layout()

# %% [markdown]
# ## Residual and Jacobian
#
# By the chain rule, with inner letters that meet. A right perturbation of the pose, `cTl Exp([omega, v])`,
# moves a point in the camera by `R (omega x P + v)`. The derivative by the offset is that of the motion:
# minus the twist's velocity at the point, `-(omega_w x cP + v_w)`.


# %%
def silhouette(cTl, offset, *, jacobians):
    """n . (uv(cP) - q) [px], one row a match."""
    tau = (float(offset[0]) + matches.base_taus_s[0]) * c_twist
    mTl = gtsam.Pose3.Expmap(-tau) * cTl  # the LiDAR in the camera of the image's instant
    cPs = mTl.transformFrom(matches.lPs.T).T
    error = np.einsum("ni,ni->n", matches.normals, camera.project(cPs) - matches.pixels)
    if not jacobians:
        return error, None
    r_H_cP = np.einsum("ni,nij->nj", matches.normals, camera.uv_H_cP(cPs))
    R = mTl.rotation().matrix()
    cP_H_cTl = np.array([R @ np.hstack([-gtsam.Rot3.Hat(lP), np.eye(3)]) for lP in matches.lPs])
    cP_H_offset = -(np.cross(c_twist[:3], cPs) + c_twist[3:])
    r_H_cTl = np.einsum("nj,njk->nk", r_H_cP, cP_H_cTl)
    return error, [r_H_cTl, np.einsum("nj,nj->n", r_H_cP, cP_H_offset)[:, None]]


# %% [markdown]
# A numerical Jacobian is right to ten digits at best, where its step is neither too long (curvature) nor too
# short (rounding). A wrong sign or a missing term shows as a flat line near 1.

# %%
start = truth.cTl.retract(
    np.array([0.01, -0.02, 0.015, 0.03, -0.05, 0.04])
)  # a generic point: nothing is zero
offset = np.array([0.03])
_, (by_pose, by_offset) = silhouette(start, offset, jacobians=True)
steps = np.logspace(-10, -1, 19)
difference = [
    [
        np.abs(
            numericalDerivative11(lambda x: silhouette(x, offset, jacobians=False)[0], start, h) - by_pose
        ).max()
        / np.abs(by_pose).max(),
        np.abs(
            numericalDerivative11(lambda x: silhouette(start, x, jacobians=False)[0], offset, h) - by_offset
        ).max()
        / np.abs(by_offset).max(),
    ]
    for h in steps
]
figure, ax = plt.subplots(figsize=(6, 3.6))
ax.loglog(steps, difference, "o-", label=["by the extrinsic", "by the time offset"])
ax.set(xlabel="step of the numerical derivative [rad, m, s]", ylabel="largest relative difference [-]")
ax.legend()
figure.tight_layout()

# %% [markdown]
# ## As a factor
#
# `gtsam.CustomFactor` calls back for the error and, where `H` is a list, for the Jacobians. It trusts what
# it gets: a Jacobian that is unset or has a wrong number of rows crashes the process.

# %%
E, D = gtsam.symbol("E", 0), gtsam.symbol("D", 0)
noise = gtsam.noiseModel.Diagonal.Sigmas(matches.sigmas_px)


def callback(factor, values, H):
    error, pieces = silhouette(values.atPose3(E), values.atVector(D), jacobians=H is not None)
    if H is not None:
        H[0], H[1] = pieces
    return error


by_hand = gtsam.CustomFactor(noise, [E, D], callback)

# %% [markdown]
# `custom_factor` takes the same function, and checks shapes and finiteness at every call. `check_jacobians`
# does the comparison above at once. And the package's own factor, with the same matches but a robust kernel,
# agrees where residuals are small.

# %%
checked = custom_factor(noise, [E, D], silhouette, dims=[6, 1], rows=len(matches))
values = gtsam.Values()
values.insert(E, start)
values.insert(D, offset)
report = check_jacobians(checked, values)
own = silhouette_factor(matches, E, D, c_twist)
print(report)
print("errors:", by_hand.error(values), checked.error(values), "robust:", own.error(values))

# %% [markdown]
# ## In an optimisation
#
# Seven unknowns, one frame, frozen matches. Two priors hold what a single frame cannot tell. The plain
# factor lets every outlier pull; a robust one ends closer to the truth.

# %%
found = {}
for name, factor in (("by hand, squares", by_hand), ("silhouette_factor, robust", own)):
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    graph.add(gtsam.PriorFactorPose3(E, start, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    graph.add(gtsam.PriorFactorVector(D, offset, gtsam.noiseModel.Isotropic.Sigma(1, 0.05)))
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found[name] = (optimum.atPose3(E), optimum.atVector(D))
    turned = np.degrees(np.linalg.norm(truth.cTl.localCoordinates(optimum.atPose3(E))[:3]))
    print(f"{name}: {turned:.3f} deg, {1e3 * (optimum.atVector(D)[0] - truth.time_offset_s):+.1f} ms off")

figure, ax = plt.subplots(figsize=(7, 3.4))
bins = np.arange(-12, 12.1, 0.5)
ax.hist(silhouette(start, offset, jacobians=False)[0], bins, alpha=0.4, label="start")
for name, (cTl, seconds) in found.items():
    ax.hist(silhouette(cTl, seconds, jacobians=False)[0], bins, histtype="step", linewidth=1.6, label=name)
ax.set(xlabel="residual [px]", ylabel="matches")
ax.legend()
figure.tight_layout()
