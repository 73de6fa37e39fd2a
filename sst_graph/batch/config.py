"""Settings of a calibration, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from sst_graph.baselines.semalign import SemAlignConfig
from sst_graph.baselines.sst_calib import PaperConfig
from sst_graph.config import Settings
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.covariance.unknown_motion import UnknownMotionConfig
from sst_graph.drive.preparation import PrepareConfig
from sst_graph.graph.outer_loop import JointConfig
from sst_graph.hand_eye.solution import MotionConfig
from sst_graph.initialization.candidates import StartConfig
from sst_graph.odometry.sweep import SweepConfig
from sst_graph.types import SemanticClass

Method = Literal["joint", "paper", "static", "semalign", "motion"]
UseMotion = Literal["auto", "always", "never"]


@dataclass(frozen=True)
class LowerEdgesConfig(Settings):
    """When edges towards the ground are matched.

    Attributes:
        use: ``auto`` where the labels agree about them, class by class.
    """

    use: Literal["auto", "always", "never"] = "auto"


@dataclass(frozen=True)
class ContradictionConfig(Settings):
    """Whether parts of the data are compared with one another.

    Attributes:
        check: solve drives, and stretches of each, by themselves and compare the answers; costs about as
            much time as the calibration.
    """

    check: bool = True


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """What to do and how; one part a stage, written beside every result.

    Attributes:
        method: ``joint`` (default), ``paper`` (SST-Calib to the letter), ``static`` (its static stage),
            ``semalign`` (sampled starts, points to pixels), ``motion`` (LiDAR odometry
            against visual odometry).
        classes: semantic classes to align.
        time_offset_per_drive: each drive has a time offset of its own, instead of one for all.
        use_motion: whether method joint also uses camera and LiDAR motion (hand-eye), as a factor and as a
            check. ``auto``: where the labels alone determine all seven unknowns (a direction that only the
            motion determines stays reported as unobservable), and the points of a scan share one time (a
            rolling sweep is compensated by the very motion, which then lags a few milliseconds behind).
        sweep: how the times of the points are decided where the data bring none.
        prepare: what is taken from every frame.
        start: the search for a start.
        joint: the outer and inner loop.
        lower_edges: when method joint matches edges towards the ground.
        paper: both stages of the paper.
        semalign: sampled starts.
        motion: hand-eye calibration.
        assumptions: what is assumed: considered in the covariance, tested, or estimated.
        unknown_motion: what the covariance has beside that of the matches where a single scan does not show
            motion; both 0 where the vehicle stood.
        observability: when a direction counts as unobservable.
        contradictions: when method joint finds that drives, or parts of one, contradict each other.
        check_stamps: call an answer not converged where a sensor's stamps jump against their own frame
            interval, for then there is no one time offset; not for sensors whose rate goes up and down.
        find_causes: where a result of method joint may be wrong or is missing, try changes of the data that
            would make the labels agree (mirrored, inverted, ...) and name what helps; takes up to a minute.
    """

    method: Method = "joint"
    classes: tuple[SemanticClass, ...] = (SemanticClass.VEHICLE,)
    time_offset_per_drive: bool = False
    use_motion: UseMotion = "auto"
    sweep: SweepConfig = field(default_factory=SweepConfig)
    prepare: PrepareConfig = field(default_factory=PrepareConfig)
    start: StartConfig = field(default_factory=StartConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    lower_edges: LowerEdgesConfig = field(default_factory=LowerEdgesConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)
    semalign: SemAlignConfig = field(default_factory=SemAlignConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    assumptions: AssumptionConfig = field(default_factory=AssumptionConfig)
    unknown_motion: UnknownMotionConfig = field(default_factory=UnknownMotionConfig)
    observability: ObservabilityConfig = field(default_factory=ObservabilityConfig)
    contradictions: ContradictionConfig = field(default_factory=ContradictionConfig)
    check_stamps: bool = True
    find_causes: bool = True

    @property
    def estimating(self) -> CalibrationConfig:
        """The same with a variable in method joint's graph for each assumption that is to be estimated."""
        graph = replace(self.joint.graph, estimate=self.assumptions.estimate)
        return replace(self, joint=replace(self.joint, graph=graph))
