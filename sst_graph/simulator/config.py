"""Configuration of the street simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sst_graph.config import Settings, setting
from sst_graph.sweep_timing import SweepStamp

Motion = Literal["mixed", "standing", "constant", "stop_and_go", "no_stop", "turning", "there_and_back"]
"""Ego motion: ``mixed`` stands, accelerates, turns and brakes; ``constant`` goes straight at one speed;
``there_and_back`` goes forward for half of the drive and returns in reverse."""
SweepSense = Literal["clockwise", "counterclockwise"]
"""Which way the scanner turns, seen from above."""
SweepOutput = Literal["times", "raw", "compensated"]
"""What the data hold of a rolling sweep: the time of each point; the points as measured and no times; the
points moved to where they lie at the stamp by the true ego motion (moving objects stay as measured)."""

_MOST_PIXELS, _LONGEST_S, _FARTHEST_M = 10_000_000, 1000.0, 5000.0
"""Larger images take more than 1.5 GB; a longer drive or street takes more than that or a minute to build."""


@dataclass(frozen=True)
class SimulationConfig(Settings):
    """A simulated drive; equal configurations give equal drives.

    Attributes:
        seed: of everything random: street, vehicles, extrinsic, noise.
        frames: number of scans and of images.
        width, height: image size [px]; the focal length grows with the width (KITTI's at 1242).
        frame_rate_hz: scans and images a second [Hz].
        motion: profile of the ego motion.
        speed_mps: cruising speed [m/s].
        time_offset_s: true offset; an image stamped t shows the world at LiDAR time t + offset [s].
        rotation_error_deg: size of the angle between the nominal and the true extrinsic [deg].
        translation_error_m: distance between the nominal and the true extrinsic [m].
        vehicle_density: vehicles per metre of street, both sides together [1/m].
        moving_fraction: share of the vehicles around that move, 0 to 0.8.
        truck_fraction: share of trucks among the parked vehicles.
        label_noise: level of the segmentation's imperfection, 0 (exact) to 2.
        rolling: True: each point is measured at its own time within the sweep; False: the whole scan at
            its stamp.
        sweep_sense: which way the scanner turns.
        sweep_start_deg: azimuth at which a turn begins and ends, counter-clockwise from forward [deg].
        sweep_stamp: the instant that a scan's stamp names; of a turn that begins ahead, ``forward`` is its
            start.
        sweep_output: what the data hold of a rolling sweep.
        azimuth_limit_deg: points beyond this azimuth, either side of forward, are cut off [deg].
        azimuth_step_deg: nominal angle between two firings of one laser [deg].
        range_noise_m: standard deviation of the range [m].
        drop_out: share of returns lost on ordinary surfaces (dark paint, glass and far things lose
            more); 0 switches all losses off.
        beam_divergence_mrad: full width of the laser beam [mrad]; 0 makes ideal rays. A return comes
            from one of two sub-beams half a radius to the left or right of the reported direction,
            so that borders are blurred but not moved; vertical width is not modelled.
        max_range_m: returns beyond this range are lost [m].
    """

    seed: int = setting(0, at_least=0, at_most=2**63 - 1)
    frames: int = setting(60, at_least=1, at_most=100_000)
    width: int = setting(1242, at_least=64, at_most=8192)
    height: int = setting(375, at_least=32, at_most=4096)
    frame_rate_hz: float = setting(9.65, at_least=1.0, at_most=50.0)
    motion: Motion = "mixed"
    speed_mps: float = setting(8.5, at_least=0.0, at_most=40.0)
    time_offset_s: float = setting(0.05, at_least=-0.5, at_most=0.5)
    rotation_error_deg: float = setting(1.5, at_least=0.0, at_most=180.0)
    translation_error_m: float = setting(0.05, at_least=0.0, at_most=10.0)
    vehicle_density: float = setting(0.13, at_least=0.0, at_most=0.4)
    moving_fraction: float = setting(0.2, at_least=0.0, at_most=0.8)
    truck_fraction: float = setting(0.08, at_least=0.0, at_most=1.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    rolling: bool = False
    sweep_sense: SweepSense = "clockwise"
    sweep_start_deg: float = setting(180.0, at_least=-180.0, at_most=180.0)
    sweep_stamp: SweepStamp = "forward"
    sweep_output: SweepOutput = "times"
    azimuth_limit_deg: float = setting(180.0, at_least=1.0, at_most=180.0)
    azimuth_step_deg: float = setting(0.1728, at_least=0.02, at_most=5.0)
    range_noise_m: float = setting(0.02, at_least=0.0, at_most=1.0)
    drop_out: float = setting(0.03, at_least=0.0, at_most=1.0)
    beam_divergence_mrad: float = setting(2.0, at_least=0.0, at_most=20.0)
    max_range_m: float = setting(90.0, at_least=5.0, at_most=200.0)

    def __post_init__(self) -> None:
        way_m = 0.0 if self.motion == "standing" else self.speed_mps * self.period_s
        self.expect_at_most("width", _MOST_PIXELS / self.height, f"{_MOST_PIXELS} px in all, with height")
        self.expect_at_most("frames", _LONGEST_S / self.period_s, f"{_LONGEST_S:g} s at frame_rate_hz")
        if way_m > 0.0:
            self.expect_at_most(
                "frames", _FARTHEST_M / way_m, f"{_FARTHEST_M:g} m at speed_mps, frame_rate_hz"
            )

    @property
    def period_s(self) -> float:
        """Time between two frames, and of one sweep [s]."""
        return 1.0 / self.frame_rate_hz

    @property
    def gives_times(self) -> bool:
        """Whether the data have the time of each point."""
        return self.rolling and self.sweep_output == "times"
