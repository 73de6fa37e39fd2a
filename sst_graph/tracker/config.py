"""Settings of the online tracker."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sst_graph.batch.config import CalibrationConfig
from sst_graph.config import Settings, setting


@dataclass(frozen=True)
class DriftConfig(Settings):
    """Extrinsic and time offset as random walks.

    Attributes:
        enabled: False: one calibration for all time (until an alarm).
        rotation_deg: of the walk, each axis [deg / sqrt(s)].
        translation_m: of the walk, each axis [m / sqrt(s)].
        offset_s: of the walk [s / sqrt(s)].
    """

    enabled: bool = False
    rotation_deg: float = setting(0.005, at_least=1e-6, at_most=10.0)
    translation_m: float = setting(0.0005, at_least=1e-7, at_most=10.0)
    offset_s: float = setting(0.0001, at_least=1e-8, at_most=10.0)


@dataclass(frozen=True)
class AlarmConfig(Settings):
    """When the calibration counts as changed.

    Attributes:
        enabled: compare new frames with the estimate at all.
        chi2: threshold of the statistic, which follows chi-squared over the unknowns where nothing changes.
        stamps: a jump of either sensor's stamps against its frame interval is an alarm, too; not for sensors
            whose rate goes up and down, as of a camera whose exposure sets it.
    """

    enabled: bool = True
    chi2: float = setting(25.0, at_least=0.1, at_most=1e9)
    stamps: bool = True


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """What the tracker does with each frame.

    Attributes:
        calibration: classes, preparation, start, matches and limits, as for ``calibrate``.
        window: scans that can be matched again; more cost memory and, at the end, time.
        start_scans: scans before the first batch solution is tried; half as many between attempts.
        late_s: images that come later than this behind the newest scan, in true time, are refused [s].
        drift: random walks.
        alarm: changes of the calibration.
    """

    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    window: int = setting(60, at_least=8, at_most=1000)
    start_scans: int = setting(12, at_least=1, at_most=1000)
    late_s: float = setting(1.5, at_least=0.001, at_most=60.0)
    drift: DriftConfig = field(default_factory=DriftConfig)
    alarm: AlarmConfig = field(default_factory=AlarmConfig)

    @property
    def estimating(self) -> TrackerConfig:
        """The same with a variable in the graph for each assumption that is to be estimated."""
        return replace(self, calibration=self.calibration.estimating)

    def __post_init__(self) -> None:
        self.expect_at_least("window", self.start_scans, "start_scans")
