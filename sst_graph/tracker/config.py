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
        epoch_s: one calibration is estimated for each epoch of this length [s].
        rotation_deg: of the walk, each axis [deg / sqrt(s)].
        translation_m: of the walk, each axis [m / sqrt(s)].
        offset_s: of the walk [s / sqrt(s)].
        history: most epochs kept for smoothing; older ones are forgotten.
    """

    enabled: bool = False
    epoch_s: float = setting(1.0, at_least=0.01, at_most=100_000.0)
    rotation_deg: float = setting(0.005, at_least=1e-6, at_most=10.0)
    translation_m: float = setting(0.0005, at_least=1e-7, at_most=10.0)
    offset_s: float = setting(0.0001, at_least=1e-8, at_most=10.0)
    history: int = setting(5000, at_least=1, at_most=100_000)


@dataclass(frozen=True)
class AlarmConfig(Settings):
    """When the calibration counts as changed.

    Attributes:
        enabled: watch at all.
        kernel_px: scale of the kernel under which a new frame is compared with the estimate, wide enough
            for a step to stay in sight [px].
        frames: new frames that are compared together.
        chi2: threshold of the statistic, which follows chi-square over the unknowns where all is quiet.
        confirmations: frames in a row past the threshold; then it must hold without any one object, too
            (the threshold grows with the frames since) ...
        others: ... and this share of the statistic must remain.
        alone: a single object is believed once ``frames`` + ``confirmations`` frames say so, where the
            statistic is this many times the threshold.
        patience: frames in a row past the threshold after which it is given up: they are learnt from by then.
        lost: frames in a row, but for one of them, in which next to nothing of what ought to be in view meets
            the image's labels: the step is larger than matches reach.
        lost_share: share of the boundary points in view that is next to nothing.
        shown_deg: frames that agree with the estimate confirm it where a turn of the camera by this much
            about its x or its y axis would be past the threshold; under the wide kernel a turn of 1 degree
            looks like this one [deg].
        shown_s: the same of a jump of the clock [s].
        confirm_s: an estimate is ``unconfirmed`` where nothing has confirmed for longer where the camera
            looks ...
        confirm_offset_s: ... or the time offset, while the LiDAR is fast [s]:
        confirm_mps: faster than this; where it is slower, a jump of the clock can hardly be seen [m/s].
        stamps: a jump in the rhythm of either sensor's stamps is an alarm, too; not for sensors whose rate
            goes up and down, as of a camera whose exposure sets it.
        baseline: quiet frames over which the usual size of the statistic is learnt: real labels err more
            than any model says.
        start_chi2: a start is refused if the statistic of some of its own frames is larger: the calibration
            changed among them, or it was none.
        warm_up: frames after the start (or a restart) before a contradiction is called an alarm; until then
            the start is given up.
    """

    enabled: bool = True
    kernel_px: float = setting(12.0, at_least=0.1, at_most=1000.0)
    frames: int = setting(4, at_least=1, at_most=1000)
    chi2: float = setting(25.0, at_least=0.1, at_most=1e9)
    confirmations: int = setting(3, at_least=1, at_most=1000)
    others: float = setting(0.2, at_least=0.0, at_most=1.0)
    alone: float = setting(4.0, at_least=0.01, at_most=1000.0)
    patience: int = setting(20, at_least=1, at_most=10_000)
    lost: int = setting(8, at_least=1, at_most=10_000)
    lost_share: float = setting(0.12, at_least=0.0, at_most=1.0)
    shown_deg: float = setting(0.25, at_least=0.001, at_most=180.0)
    shown_s: float = setting(0.01, at_least=1e-5, at_most=10.0)
    confirm_s: float = setting(1.0, at_least=0.001, at_most=1e6)
    confirm_offset_s: float = setting(3.0, at_least=0.001, at_most=1e6)
    confirm_mps: float = setting(3.0, at_least=0.0, at_most=1000.0)
    stamps: bool = True
    baseline: int = setting(300, at_least=1, at_most=1_000_000)
    start_chi2: float = setting(15.0, at_least=1e-9, at_most=1e9)
    warm_up: int = setting(15, at_least=0, at_most=1_000_000)

    def __post_init__(self) -> None:
        self.expect_at_least("patience", max(self.frames, self.confirmations), "frames and confirmations")


@dataclass(frozen=True)
class AdoptionConfig(Settings):
    """When a candidate may replace the calibration in use.

    Attributes:
        held_out: frames, not yet used by the candidate, on which both are compared.
        margin: the candidate's held-out cost may exceed that of the one in use by this fraction.
    """

    held_out: int = setting(10, at_least=1, at_most=10_000)
    margin: float = setting(0.02, at_least=0.0, at_most=100.0)


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """What the tracker does with each frame.

    Attributes:
        calibration: classes, preparation, start, matches and limits, as for ``calibrate``.
        window: scans whose matches are renewed.
        images: most images that are kept, for any number of them may come while no scan does.
        renew: scans of the window matched anew at each frame, besides the newest; the next to leave first.
        renew_most: as many while the estimate moves.
        stale_sigmas: a match is stale where the estimate has moved farther since, in standard deviations.
        settle_scans: scans matched anew with each frame while a running tracker settles.
        start_scans: scans before the first batch solution is tried, and between attempts.
        restart_scans: the same after an alarm.
        start_work: work on a start that is done with each frame, in units of 1 to 4 ms, so that no frame
            takes long for it: the estimate comes when all is done, some twenty frames later, and until then
            the status is ``starting``. 0: all with one frame, which takes seconds.
        start_attempts: failed attempts near the last estimate after an alarm before the search begins anew.
        start_share: least share of the pairs that the first solution must still match.
        start_gain: by which fraction of the cost a start whose time offset was searched must be better.
        start_offset_step_s: damping of the time offset in the first solution, a step's prior deviation [s].
        min_frame_matches: fewest matches of a scan that enters the graph.
        late_s: images that come later than this behind the newest scan, in true time, are refused [s].
        drift: random walks.
        alarm: steps.
        adoption: held-out check.
    """

    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    window: int = setting(60, at_least=2, at_most=1000)
    images: int = setting(600, at_least=2, at_most=10_000)
    renew: int = setting(1, at_least=0, at_most=1000)
    renew_most: int = setting(4, at_least=0, at_most=1000)
    stale_sigmas: float = setting(0.3, at_least=0.0, at_most=1000.0)
    settle_scans: int = setting(5, at_least=1, at_most=1000)
    start_scans: int = setting(12, at_least=1, at_most=1000)
    restart_scans: int = setting(8, at_least=1, at_most=1000)
    start_work: int = setting(48, at_least=0, at_most=1_000_000)
    start_attempts: int = setting(2, at_least=1, at_most=1000)
    start_share: float = setting(0.7, at_least=0.0, at_most=1.0)
    start_gain: float = setting(0.1, at_least=0.0, at_most=1.0)
    start_offset_step_s: float = setting(0.005, at_least=1e-6, at_most=10.0)
    min_frame_matches: int = setting(8, at_least=1, at_most=1_000_000)
    late_s: float = setting(1.5, at_least=0.001, at_most=60.0)
    drift: DriftConfig = field(default_factory=DriftConfig)
    alarm: AlarmConfig = field(default_factory=AlarmConfig)
    adoption: AdoptionConfig = field(default_factory=AdoptionConfig)

    @property
    def searched_scans(self) -> int:
        """Latest scans of the window that a start may be made of: half of it, or twice what a start needs."""
        return max(2 * self.start_scans, 2 * self.restart_scans, self.window // 2)

    @property
    def estimating(self) -> TrackerConfig:
        """The same with a variable in the graph for each assumption that is to be estimated."""
        return replace(self, calibration=self.calibration.estimating)

    def __post_init__(self) -> None:
        scans = max(self.start_scans, self.restart_scans)
        self.expect_at_least("window", scans, "start_scans and restart_scans")
