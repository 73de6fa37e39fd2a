"""Configuration of the street simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from sst_graph.errors import ConfigError

Motion = Literal["mixed", "standing", "constant", "stop_and_go", "no_stop", "turning", "there_and_back"]
"""Ego motion: ``mixed`` stands, accelerates, turns and brakes; ``constant`` goes straight at one speed;
``there_and_back`` goes forward for half of the drive and returns in reverse."""
SweepSense = Literal["clockwise", "counterclockwise"]
"""Which way the scanner turns, seen from above."""
SweepStamp = Literal["forward", "start", "end"]
"""Which instant of a turn the scan's stamp names."""
SweepOutput = Literal["times", "raw", "compensated"]
"""What the data tell of a rolling sweep: the time of each point; the points as measured and no times; the
points moved to where they lie at the stamp by the true ego motion (moving objects stay as measured)."""


@dataclass(frozen=True)
class SimulationConfig:
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
        sweep_output: what the data tell of a rolling sweep.
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

    seed: int = 0
    frames: int = 60
    width: int = 1242
    height: int = 375
    frame_rate_hz: float = 9.65
    motion: Motion = "mixed"
    speed_mps: float = 8.5
    time_offset_s: float = 0.05
    rotation_error_deg: float = 1.5
    translation_error_m: float = 0.05
    vehicle_density: float = 0.13
    moving_fraction: float = 0.2
    truck_fraction: float = 0.08
    label_noise: float = 1.0
    rolling: bool = False
    sweep_sense: SweepSense = "clockwise"
    sweep_start_deg: float = 180.0
    sweep_stamp: SweepStamp = "forward"
    sweep_output: SweepOutput = "times"
    azimuth_limit_deg: float = 180.0
    azimuth_step_deg: float = 0.1728
    range_noise_m: float = 0.02
    drop_out: float = 0.03
    beam_divergence_mrad: float = 2.0
    max_range_m: float = 90.0

    def __post_init__(self) -> None:
        choices: dict[str, Any] = {
            "motion": Motion,
            "sweep_sense": SweepSense,
            "sweep_stamp": SweepStamp,
            "sweep_output": SweepOutput,
        }
        for name, kind in choices.items():
            if (choice := getattr(self, name)) not in get_args(kind):
                raise ConfigError(f"{name}: found {choice!r}, expected one of {', '.join(get_args(kind))}")
        limits: dict[str, tuple[float, float]] = {
            "seed": (0, 2**63 - 1),
            "frames": (1, 100_000),
            "width": (64, 8192),
            "height": (32, 4096),
            "frame_rate_hz": (1.0, 50.0),
            "speed_mps": (0.0, 40.0),
            "time_offset_s": (-0.5, 0.5),
            "rotation_error_deg": (0.0, 180.0),
            "translation_error_m": (0.0, 10.0),
            "vehicle_density": (0.0, 0.4),
            "moving_fraction": (0.0, 0.8),
            "truck_fraction": (0.0, 1.0),
            "label_noise": (0.0, 2.0),
            "sweep_start_deg": (-180.0, 180.0),
            "azimuth_limit_deg": (1.0, 180.0),
            "azimuth_step_deg": (0.02, 5.0),
            "range_noise_m": (0.0, 1.0),
            "drop_out": (0.0, 1.0),
            "beam_divergence_mrad": (0.0, 20.0),
            "max_range_m": (5.0, 200.0),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name}: found {value}, expected {low:g} to {high:g}")

    @property
    def period_s(self) -> float:
        """Time between two frames, and of one sweep [s]."""
        return 1.0 / self.frame_rate_hz

    @property
    def gives_times(self) -> bool:
        """Whether the data tell the time of each point."""
        return self.rolling and self.sweep_output == "times"
