# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A calibration in five lines
#
# A short drive is simulated first, so that the notebook needs no data; yours is opened by its path.

# %%
import tempfile
from pathlib import Path

import sst_graph
from sst_graph.export import export_text
from sst_graph.metrics import calibration_errors
from sst_graph.simulator import SimulationConfig, simulate, write_drive

folder = Path(tempfile.mkdtemp()) / "drive"
street = SimulationConfig(
    seed=1, frames=30, width=621, height=188, azimuth_limit_deg=60.0, time_offset_s=0.1, vehicle_density=0.2
)
write_drive(simulate(street), folder)

# %% [markdown]
# The five lines (with the import above). `drive.nominal` is the calibration that the data bring, used as a
# guess; `None` works too.

# %%
drive = sst_graph.open_source(folder)
result = sst_graph.calibrate(drive, drive.nominal)
print(result.status, result.T_camera_lidar, f"{1e3 * result.time_offset_s:.1f} ms", result.sigmas())
for reason in result.reasons:
    print(reason)

# %% [markdown]
# This drive knows the truth, so the errors can be told. NEES is the squared error in the result's own
# sigmas: about 7 for the seven unknowns where the covariance is honest.

# %%
errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, drive.truth, result.covariance)
print(errors)

# %% [markdown]
# The file that `sst-graph calibrate` writes, and the formats of others:

# %%
print(result.to_json()[:300])
print(export_text(result, "kalibr"))
