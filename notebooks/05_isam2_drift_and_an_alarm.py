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
# # Frame by frame: iSAM2, drift and an alarm
#
# The tracker keeps a window of frames in an iSAM2 graph. It estimates extrinsic and time offset with every
# frame, notices when somebody knocks the camera, and can follow a calibration that drifts.

# %%
import dataclasses

import cv2
import gtsam
import matplotlib.pyplot as plt
import numpy as np

from sst_graph import CalibrationConfig, Tracker, TrackerConfig
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.initialization.global_search import SearchConfig
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker.config import AlarmConfig, DriftConfig

drive = KeptDrive.of(
    simulate(
        SimulationConfig(
            seed=3,
            frames=28,
            width=621,
            height=188,
            azimuth_limit_deg=42.0,
            azimuth_step_deg=0.35,
            max_range_m=50.0,
            vehicle_density=0.3,
            time_offset_s=0.03,
            motion="no_stop",
            speed_mps=6.0,
            moving_fraction=0.0,
        )
    )
)
camera, truth = drive.camera, drive.truth
stamps_s = np.array([1e-9 * frame.scan.stamp_ns for frame in drive])

# %% [markdown]
# ## A camera that turns
#
# A turn of the camera about its vertical axis is a warp of its picture by `K R inv(K)`. Only the mask
# matters here.


# %%
def turned(frame, degrees):
    """The frame of a camera that looks further to the side."""
    warp = camera.matrix @ gtsam.Rot3.Ry(np.radians(degrees)).matrix() @ np.linalg.inv(camera.matrix)
    how = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_REPLICATE}
    mask = cv2.warpPerspective(frame.image.mask, warp, (camera.width, camera.height), **how)
    return dataclasses.replace(frame, image=dataclasses.replace(frame.image, mask=mask))


def yaw_deg(update):
    """How far the estimated camera has turned from the true one of the beginning [deg]."""
    return np.degrees(gtsam.Rot3.Logmap(update.T_camera_lidar.rotation() * truth.cTl.rotation().inverse())[1])


# %% [markdown]
# ## A knock
#
# From frame 14 on the camera looks 1.5° further to the side. Every call of `add` returns a `TrackUpdate`:
# estimate, covariance, status, and the statistic of the test for a change. The drive is short, so the
# tracker is told to start from the nominal calibration with six scans, and to believe that start after four
# more.

# %%
KNOCK, KNOCK_DEG = 14, 1.5
calibration = CalibrationConfig(search=SearchConfig(enabled=False))
tracker = Tracker(camera, TrackerConfig(calibration=calibration, start_scans=6), drive.nominal)
tracker.monitor.changes.warm_up_scans = 4
updates = [tracker.add(turned(frame, KNOCK_DEG) if frame.index >= KNOCK else frame) for frame in drive]
alarms = [update.frame for update in updates if update.alarm]
print("alarm in frame", alarms, " status by frame:", " ".join(update.status for update in updates))

# %% [markdown]
# The first estimate needs some frames. The statistic compares the latest four frames with the estimate, so
# the first frame after the knock raises it nearly to the threshold, and the second past it. Three frames in
# a row past the threshold make the alarm. The old estimate is then dropped, and a new one is made of the
# frames after the knock.

# %%
known = [update for update in updates if update.covariance is not None]
figure, (above, below) = plt.subplots(2, 1, figsize=(9, 5.2), sharex=True)
yaws = np.array([yaw_deg(update) for update in known])
# Turning about the camera's y axis is turning about the LiDAR's z axis, the other way round.
two_sigma = 2 * np.degrees([update.sigmas[2] for update in known])
above.errorbar(
    [update.frame for update in known], yaws, two_sigma, fmt="o", capsize=3, label="estimate, ±2 sigma"
)
above.step(
    range(len(drive)),
    [KNOCK_DEG * (k >= KNOCK) for k in range(len(drive))],
    where="mid",
    color="k",
    label="truth",
)
above.set(ylabel="turn of the camera [deg]")
tested = [update for update in updates if update.chi2 is not None]
below.semilogy(
    [update.frame for update in tested], [update.chi2 for update in tested], "o", label="statistic"
)
below.axhline(tracker.setup.config.alarm.chi2, color="gray", linestyle="--", label="threshold")
below.set(xlabel="frame", ylabel="chi2 over its usual size [-]")
for ax in (above, below):
    ax.axvline(KNOCK - 0.5, color="tab:orange", linewidth=0.8)
    for frame_number in alarms:
        ax.axvline(frame_number, color="tab:red", label="alarm")
    ax.legend(loc="upper left")
figure.tight_layout()

# %% [markdown]
# ## A drift
#
# A mount that warms up turns the camera by 0.03° a frame, 0.3° a second. A tracker that takes the
# calibration for constant averages over its window and lags behind, with a sigma that knows nothing of it.
# With `drift.enabled`, extrinsic and offset are random walks: one value an epoch of 1 s, joined by factors
# that say how far they may walk. Alarms are off in both, for a drift as quick as this one is a change, too.

# %%
DRIFT_DEG = 0.03
tracked = {}
for name, drift in (
    ("taken for constant", DriftConfig()),
    ("random walk", DriftConfig(enabled=True, rotation_deg=0.3)),
):
    settings = TrackerConfig(
        calibration=calibration, start_scans=6, drift=drift, alarm=AlarmConfig(enabled=False)
    )
    drifting = Tracker(camera, settings, drive.nominal)
    found = [drifting.add(turned(frame, DRIFT_DEG * frame.index)) for frame in drive]
    tracked[name] = [update for update in found if update.covariance is not None]

# %% [markdown]
# The random walk follows more closely, and the truth lies in its band. Where an epoch begins (frames 10 and
# 20) the band widens by what the calibration may have walked; frames of the epoch narrow it again.

# %%
figure, ax = plt.subplots(figsize=(9, 3.6))
for name, found in tracked.items():
    yaws = np.array([yaw_deg(update) for update in found])
    sigma_deg = np.degrees([update.sigmas[2] for update in found])
    numbers = [update.frame for update in found]
    (line,) = ax.plot(numbers, yaws, ".-", label=name)
    ax.fill_between(numbers, yaws - 2 * sigma_deg, yaws + 2 * sigma_deg, color=line.get_color(), alpha=0.2)
ax.plot(range(len(drive)), DRIFT_DEG * np.arange(len(drive)), "k", label="truth")
ax.set(xlabel="frame", ylabel="turn of the camera [deg]", ylim=(-1, 2.5), title="estimate and 2 sigma")
ax.legend()
figure.tight_layout()

# %% [markdown]
# ## Looking back
#
# Later frames tell about earlier epochs. `history()` smooths over all epochs since the last alarm.

# %%
smoothed = drifting.estimate.history()
middles_s = np.array([1e-9 * entry.stamp_ns for entry in smoothed]) + 0.5
back_deg = [
    np.degrees(gtsam.Rot3.Logmap(entry.cTl.rotation() * truth.cTl.rotation().inverse())[1])
    for entry in smoothed
]
figure, ax = plt.subplots(figsize=(6, 3.2))
spread_deg = 2 * np.degrees([entry.covariance[2, 2] ** 0.5 for entry in smoothed])
ax.errorbar(middles_s, back_deg, spread_deg, fmt="o", capsize=4, label="epochs, smoothed, ±2 sigma")
ax.plot(stamps_s, DRIFT_DEG * np.arange(len(drive)), "k", label="truth")
ax.set(xlabel="middle of the epoch [s]", ylabel="turn of the camera [deg]")
ax.legend()
figure.tight_layout()
