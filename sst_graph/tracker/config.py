"""Settings of the online tracker."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sst_graph.batch.config import CalibrationConfig, prepared_classes
from sst_graph.config import Settings, setting


@dataclass(frozen=True)
class DriftConfig(Settings):
    """Extrinsic and time offset as random walks."""

    enabled: bool = setting(
        False,
        doc="Estimate extrinsic and time offset as random walks, one value an epoch. Set where they "
        "drift (warming mounts, free clocks).",
    )
    rotation_deg: float = setting(
        0.005,
        at_least=1e-6,
        at_most=10.0,
        unit="deg/sqrt(s)",
        doc="Random walk of the rotation, each axis, with drift.enabled. Raise it for mounts that "
        "move faster.",
    )
    translation_m: float = setting(
        0.0005,
        at_least=1e-7,
        at_most=10.0,
        unit="m/sqrt(s)",
        doc="Random walk of the translation, each axis, with drift.enabled. Raise it for mounts that "
        "move faster.",
    )
    time_offset_s: float = setting(
        0.0001,
        at_least=1e-8,
        at_most=10.0,
        unit="s/sqrt(s)",
        doc="Random walk of the time offset, with drift.enabled. Raise it for clocks that drift faster.",
    )


@dataclass(frozen=True)
class AlarmConfig(Settings):
    """When the calibration counts as changed."""

    enabled: bool = setting(
        True,
        doc="Test each frame for a change of the calibration. Set to false to keep one estimate "
        "whatever frames show; a scan clock that is set still raises the alarm and begins a new one.",
    )
    chi2: float = setting(
        25.0,
        at_least=0.1,
        at_most=1e9,
        doc="Threshold of the test for a change. Raise it for fewer false alarms, lower it to see "
        "smaller changes.",
    )
    stamps: bool = setting(
        True,
        doc="Report a jump in a sensor's stamps as a change, too. Set to false for sensors without a "
        "steady rate.",
    )


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """What the tracker does with each frame.

    Attributes:
        calibration: classes, preparation, start, matches and limits, as for ``calibrate``.
        drift: random walks.
        alarm: changes of the calibration.
    """

    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    window: int = setting(
        60,
        at_least=8,
        at_most=1000,
        unit="scans",
        doc="Scans that are matched again as the estimate moves. Larger: surer, slower, and slower to"
        " follow a change.",
    )
    start_scans: int = setting(
        12,
        at_least=1,
        at_most=1000,
        unit="scans",
        doc="Scans before the first solution is tried. Raise it where few objects are in view.",
    )
    late_s: float = setting(
        1.5,
        at_least=0.001,
        at_most=60.0,
        doc="Images that come later than this behind the newest scan are refused. Raise it for slow "
        "segmentation.",
    )
    drift: DriftConfig = field(default_factory=DriftConfig)
    alarm: AlarmConfig = field(default_factory=AlarmConfig)

    @property
    def estimating(self) -> TrackerConfig:
        """These settings with a variable in the graph for each assumption to be estimated, and with objects
        without a class among the classes where edges are aligned."""
        calibration = self.calibration.estimating
        calibration = replace(calibration, classes=prepared_classes(calibration))
        if calibration.method == "edges":
            calibration = replace(calibration, lower_edges="never")
        return replace(self, calibration=calibration)

    def __post_init__(self) -> None:
        self.expect_at_least("window", self.start_scans, "start_scans")
