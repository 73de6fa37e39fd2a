"""Settings of a calibration, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from sst_graph.baselines.semalign import SemAlignConfig
from sst_graph.baselines.sst_calib import PaperConfig
from sst_graph.config import Settings, setting
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
    """When edges towards the ground are matched."""

    use: Literal["auto", "always", "never"] = setting(
        "auto",
        doc="Match edges towards the ground: auto where the labels of both sides agree on them, class"
        " by class; never for hand-drawn outlines that cover the gap below vehicles.",
    )


@dataclass(frozen=True)
class ContradictionConfig(Settings):
    """Whether parts of the data are compared with one another."""

    check: bool = setting(
        True,
        doc="Test whether drives, and parts of a drive, contradict one another. Set to false to save time.",
    )


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """What to do and how; one part a stage, written beside every result.

    Attributes:
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
    """

    method: Method = setting(
        "joint",
        doc="What estimates: joint (extrinsic and time offset), motion (LiDAR against visual "
        "odometry, no labels), paper (SST-Calib as printed), static (its first stage), semalign. "
        "Change to compare, or where there are no labels.",
    )
    classes: tuple[SemanticClass, ...] = setting(
        (SemanticClass.VEHICLE,),
        doc="Semantic classes whose edges are aligned. Add pole, person, ... where both sides label "
        "them well; leave out classes that are labelled on one side only.",
    )
    time_offset_per_drive: bool = setting(
        False,
        doc="One time offset for each drive instead of one for all. Set where the clocks were restarted "
        "between drives.",
    )
    use_motion: UseMotion = setting(
        "auto",
        doc="Whether method joint adds hand-eye constraints from LiDAR and visual odometry. auto: "
        "where the labels alone determine all unknowns and the scans are not rolling. always: "
        "where constant speed leaves the offset open; never: where visual odometry is poor.",
    )
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
    check_stamps: bool = setting(
        True,
        doc="Report a result as not converged where a sensor's stamps jump. Set to false for sensors "
        "without a steady rate.",
    )
    find_causes: bool = setting(
        True,
        doc="Where a result is not ok, try changes of the data (mirrored, inverted, ...) that would "
        "make the labels agree. Set to false to save up to a minute.",
    )

    @property
    def estimating(self) -> CalibrationConfig:
        """The same with a variable in method joint's graph for each assumption that is to be estimated."""
        graph = replace(self.joint.graph, estimate=self.assumptions.estimate)
        return replace(self, joint=replace(self.joint, graph=graph))
