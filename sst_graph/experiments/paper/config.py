"""Settings of the four tables, and the methods that stand in their rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.config import Method
from sst_graph.config import Settings, setting, with_overrides
from sst_graph.errors import ConfigError
from sst_graph.simulator import SimulationConfig

START = "start"
"""Row of the starts themselves."""
KITTI_PERIOD_S = 0.103652
"""Mean time between two frames of KITTI odometry 00 by its stamps [s]."""


@dataclass(frozen=True)
class Variant:
    """A row of a table: a method, and what is set otherwise.

    Attributes:
        method: of ``calibrate``.
        changes: overrides of its settings.
        has_time_offset: whether it estimates the time offset.
    """

    method: Method
    changes: tuple[str, ...] = ()
    has_time_offset: bool = False


VARIANTS: Mapping[str, Variant] = {
    "static": Variant("static"),
    "static-single": Variant("static", ("paper.bidirectional=false",)),
    "paper": Variant("paper", has_time_offset=True),
    "semalign": Variant("semalign"),
    "motion": Variant("motion", has_time_offset=True),
    "joint": Variant("joint", has_time_offset=True),
}
"""``static``: SST-Calib's static stage, bi-directional loss; ``static-single``: the same with w_l = 0."""


@dataclass(frozen=True)
class PaperTableConfig(Settings):
    """Drives, starts and methods of a table.

    Attributes:
        data: a KITTI odometry root, or drives with a reference calibration; simulated streets where empty.
        streets: number of simulated streets.
        seed: of the first street; the next ones follow.
        starts: of each drive, for every method the same.
        methods: rows of the table, names of VARIANTS.
        images_late: each image shows the world this many frame times after its scan; one group of rows each.
        standing: the streets stand; else they stand, accelerate, turn and brake.
        frames: of each street.
        kitti_frames: first frame and end of what is used of a sequence 00 that is long enough.
        speed_mps: cruising speed on the streets [m/s].
        period_s: time between two of their frames by the stamps [s].
        nominal_period_s: the same by the LiDAR's data sheet [s].
        start_deg, start_m: half widths of the starts' error, uniform by axis [deg], [m].
        failed_deg, failed_m: rotation (QAD) or translation (ATD) beyond which a run has failed.
        label_noise: of the simulator.
        jobs: processes; each takes a drive.
        plot: also draw the runs.
        calibration: settings of every method.
    """

    data: tuple[str, ...] = setting((), length=(0, 1000))
    streets: int = setting(20, at_least=1, at_most=10_000)
    seed: int = setting(0, at_least=0, at_most=10**15)
    starts: int = setting(1, at_least=1, at_most=10_000)
    methods: tuple[str, ...] = setting(("static", "joint"), length=(1, 100), choices=VARIANTS)
    images_late: tuple[int, ...] = setting((1,), at_least=-4, at_most=4, length=(1, 9))
    standing: bool = False
    frames: int = setting(40, at_least=1, at_most=10_000)
    kitti_frames: tuple[int, ...] = setting((520, 580), at_least=0, at_most=100_000, length=(2, 2))
    speed_mps: float = setting(8.5, at_least=0.0, at_most=40.0)
    period_s: float = setting(KITTI_PERIOD_S, at_least=0.02, at_most=1.0)
    nominal_period_s: float = setting(0.1, at_least=0.02, at_most=1.0)
    start_deg: float = setting(10.0, at_least=0.0, at_most=180.0)
    start_m: float = setting(0.1, at_least=0.0, at_most=100.0)
    failed_deg: float = setting(5.0, at_least=0.0, at_most=180.0)
    failed_m: float = setting(0.5, at_least=0.0, at_most=100.0)
    label_noise: float = setting(1.0, at_least=0.0, at_most=2.0)
    jobs: int = setting(1, at_least=1, at_most=1000)
    plot: bool = True
    calibration: CalibrationConfig = field(default_factory=lambda: CalibrationConfig(find_causes=False))

    def __post_init__(self) -> None:
        first, end = self.kitti_frames
        if end <= first:
            raise ConfigError(f"kitti_frames: found {first}, {end}, expected the first frame and a later end")

    def street(self, number: int, images_late: int) -> SimulationConfig:
        """The simulation of a street."""
        return SimulationConfig(
            seed=self.seed + number,
            frames=self.frames,
            motion="standing" if self.standing else "mixed",
            speed_mps=self.speed_mps,
            frame_rate_hz=1.0 / self.period_s,
            time_offset_s=images_late * self.period_s,
            label_noise=self.label_noise,
            azimuth_limit_deg=60.0,
        )

    def calibration_of(self, name: str) -> CalibrationConfig:
        """The settings of a row of the table."""
        variant = VARIANTS[name]
        return with_overrides(self.calibration, [f'method="{variant.method}"', *variant.changes])

    def nominal_offset_s(self, images_late: int) -> float:
        """The time offset by the data sheet's rate [s]."""
        return images_late * self.nominal_period_s
