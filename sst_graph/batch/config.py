"""Settings of a calibration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from sst_graph.baselines.sst_calib import PaperConfig
from sst_graph.config import Settings, internal, setting
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.covariance.unknown_motion import UnknownMotionConfig
from sst_graph.drive.preparation import PrepareConfig
from sst_graph.features.lidar_edges import MAX_RANGE_M
from sst_graph.graph.matching import GraphConfig
from sst_graph.graph.outer_loop import JointConfig
from sst_graph.initialization.global_search import SearchConfig
from sst_graph.odometry.lidar import LidarOdometryConfig
from sst_graph.types import SemanticClass

Method = Literal["auto", "joint", "paper", "static", "semalign", "motion", "edges", "both"]
UseMotion = Literal["auto", "always", "never"]
UseLowerEdges = Literal["auto", "always", "never"]


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """What to do and how; written beside every result.

    Attributes:
        search: the global search for a start.
        lidar_odometry: the motion between scans.
        noise: of matches and priors of the joint graph.
        paper: SST-Calib.
        assumptions: what is assumed: considered in the covariance, tested, or estimated.
        unknown_motion: what the covariance has beside that of the matches where a single scan does not show
            motion; both 0 where the vehicle stood.
        observability: when a direction counts as unobservable.
        for_report: whether what a report alone shows is computed: likelihoods along the unknowns, and how an
            estimate by motion fits edges of the pictures.
    """

    method: Method = setting(
        "auto",
        doc="What estimates: auto (joint where both sensors have labels, both where one of several drives "
        "has none, else edges), joint (outlines of labelled objects), edges (LiDAR edges against pictures, "
        "no labels), both (joint where frames have labels, edges in the others), motion (LiDAR against "
        "visual odometry, no labels), paper (SST-Calib as printed), static (its first stage), semalign. "
        "track knows joint, edges and both; auto is edges there where the drive has no labels.",
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
        "where the points of a scan share one time. always: rolling sweeps, too, whose offset it errs "
        "by some milliseconds; never: where visual odometry is poor.",
    )
    max_range_m: float = setting(
        MAX_RANGE_M,
        at_least=1.0,
        at_most=1000.0,
        doc="Range beyond which objects are not used. Lower it where labels of far objects are poor, "
        "raise it for long-range LiDARs.",
    )
    image_edges: bool = setting(
        True,
        doc="Move the contours of the masks to the edges in the picture. Set to false for pictures at"
        " night or without texture, or for exact masks.",
    )
    lower_edges: UseLowerEdges = setting(
        "auto",
        doc="Match edges towards the ground: auto where the labels of both sides agree on them, class"
        " by class; never for hand-drawn outlines that cover the gap below vehicles.",
    )
    decide_sweep: bool = setting(
        True,
        doc="Decide from the scans whether points without times are compensated for the sweep. Set to"
        " false where they are known to be.",
    )
    check_contradictions: bool = setting(
        True,
        doc="Test whether drives, and parts of a drive, contradict one another. Set to false to save time.",
    )
    for_report: bool = internal(True)
    check_stamps: bool = setting(
        True,
        doc="Report a result as not converged where a sensor's stamps jump, unless the frames before and "
        "after show one time offset. Set to false for sensors without a steady rate.",
    )
    find_causes: bool = setting(
        True,
        doc="Where a result is not ok, try changes of the data (mirrored, inverted, ...) that would "
        "make the labels agree. Set to false to save up to a minute.",
    )
    seed: int = setting(
        0,
        at_least=0,
        at_most=10**15,
        doc="Seed of all that is sampled. Change it to see whether the answer depends on it.",
    )
    search: SearchConfig = field(default_factory=SearchConfig)
    lidar_odometry: LidarOdometryConfig = field(default_factory=LidarOdometryConfig)
    noise: GraphConfig = field(default_factory=GraphConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)
    assumptions: AssumptionConfig = field(default_factory=AssumptionConfig)
    unknown_motion: UnknownMotionConfig = field(default_factory=UnknownMotionConfig)
    observability: ObservabilityConfig = field(default_factory=ObservabilityConfig)

    def __post_init__(self) -> None:
        object.__setattr__(self, "search", replace(self.search, seed=self.seed))
        object.__setattr__(self, "paper", replace(self.paper, seed=self.seed))

    @property
    def prepare(self) -> PrepareConfig:
        """What is kept of every frame."""
        return PrepareConfig(self.max_range_m, self.image_edges, self.lidar_odometry)

    @property
    def joint(self) -> JointConfig:
        """The joint method under this noise."""
        return JointConfig(self.noise)

    @property
    def estimating(self) -> CalibrationConfig:
        """These settings with a variable in method joint's graph for each assumption to be estimated."""
        return replace(self, noise=replace(self.noise, estimate=self.assumptions.estimate))


def prepared_classes(config: CalibrationConfig) -> tuple[SemanticClass, ...]:
    """Classes that drives are prepared with: edges need objects of no class, motion needs none."""
    if config.method == "edges":
        return (SemanticClass.OBJECT,)
    if config.method == "motion":
        return ()
    return (*config.classes, SemanticClass.OBJECT) if config.method == "both" else config.classes
