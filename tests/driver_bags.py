"""Bags of a rolling street, whose points have times after the stamp or of the LiDAR's own clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bags import CLOUD, EPOCH_NS, IMAGE, INFO, MASK, chain, table_of, writing
from numpy.lib import recfunctions

from sst_graph.data import KittiSource
from sst_graph.data.arrays import read_labels
from sst_graph.data.images import read_mask
from sst_graph.simulator import SimulationConfig

STREET = SimulationConfig(
    seed=5, frames=20, width=414, height=125, azimuth_limit_deg=50.0, azimuth_step_deg=0.3,
    vehicle_density=0.3, moving_fraction=0.0, time_offset_s=0.03, motion="no_stop", speed_mps=6.0,
    rolling=True,
)  # fmt: skip
HALF_S = 0.0144
"""Of the sweep within 50 deg of forward, where the stamps of the street are."""
BOOT_NS = EPOCH_NS - 5_000_123_456_789
"""When the LiDAR's clock began at 0."""
DRIFT = 30e-6


@dataclass(frozen=True)
class Driver:
    """How a driver stamps and counts.

    Attributes:
        own_clock: times of points are seconds of the LiDAR's own clock; else after the stamp.
        later_s: of the stamp after the start of the sweep.
        arrives_s: after the stamp.
        jitter_s: standard deviation of what is added to stamps.
        lost: every third scan lacks the first third of its returns.
    """

    own_clock: bool
    later_s: float = 0.0
    arrives_s: float = 0.11
    jitter_s: float = 0.0
    lost: bool = False


def bag_of_driver(drive: KittiSource, path: Path, driver: Driver) -> Path:
    rng = np.random.default_rng(0)
    with writing(path, "mcap") as out:
        make = out.messages
        out.add("/tf_static", make.transforms(chain(drive.nominal)), EPOCH_NS)
        out.add(INFO, make.info(drive.camera), EPOCH_NS)
        for k in range(len(drive)):
            scan, image = drive.read_scan(k), drive.read_image(k)
            assert scan is not None and scan.offsets_s is not None and image is not None
            labels = read_labels(drive.files.labels[k], len(scan.points))
            start_ns = EPOCH_NS + scan.stamp_ns - round(HALF_S * 1e9)
            after_s = scan.offsets_s.astype(np.float64) + HALF_S
            stamp_ns = start_ns + round((driver.later_s + driver.jitter_s * rng.standard_normal()) * 1e9)
            times = after_s - (stamp_ns - start_ns) * 1e-9
            if driver.own_clock:
                times = (start_ns - BOOT_NS) * 1e-9 * (1.0 + DRIFT) + after_s
            table = recfunctions.append_fields(
                recfunctions.repack_fields(recfunctions.drop_fields(table_of(scan, labels), "time")),
                "timestamp",
                times,
                usemask=False,
            )
            if driver.lost and k % 3 == 1:
                table = table[after_s > 0.01]
            out.add(CLOUD, make.cloud(stamp_ns, table), stamp_ns + round(driver.arrives_s * 1e9))
            stamp_ns = EPOCH_NS + image.stamp_ns
            out.add(IMAGE, make.image(stamp_ns, image.pixels), stamp_ns)
            out.add(MASK, make.image(stamp_ns, read_mask(drive.files.masks[k]), "mono8"), stamp_ns)
    return path
