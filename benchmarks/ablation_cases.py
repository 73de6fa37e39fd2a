"""The heuristics that ablation.py leaves out, one case each: how, and which lines would go with it."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sst_graph.batch.config import CalibrationConfig
from sst_graph.covariance.cluster_robust import ErrorModel
from sst_graph.tracker.config import TrackerConfig

ROOT = Path(__file__).parents[1] / "sst_graph"
ANY_START = ("near", "free")
ESTIMATE = ("local",)
TRACKING = ("track",)
WATCHING = ("track", "knock", "clock")


@dataclass(frozen=True)
class Case:
    """One heuristic.

    Attributes:
        name: of the case.
        what: is left out, in a few words.
        tier: those of the first tier are run first.
        settings: what replaces a setting, by its dotted name in ``CalibrationConfig``.
        tracker: the same in ``TrackerConfig``.
        constants: what replaces a constant of a module, by ``module:NAME``.
        functions: what replaces a function wherever it was imported, by ``module:name``.
        members: what replaces a member of a class, by ``module:Class.name``.
        lines: where its code stands: ``file``, ``file:name`` or ``file:Class.name``.
        extra_lines: of it that stand inside longer functions.
        preparation: the drives are to be prepared anew.
        kinds: of run that it may change.
        covariance: the answer stays as it is: the covariance of the full method's run is computed again, that
            of the matches, or what assumptions add to it; decisions made by covariances stay, too.
    """

    name: str
    what: str
    tier: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    tracker: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, Any] = field(default_factory=dict)
    functions: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    members: Mapping[str, Any] = field(default_factory=dict)
    lines: Sequence[str] = ()
    extra_lines: int = 0
    preparation: bool = False
    kinds: Sequence[str] = ESTIMATE
    covariance: Literal["", "matches", "assumptions"] = ""

    def configured(self, config: CalibrationConfig) -> CalibrationConfig:
        return _with_settings(config, self.settings)

    def tracking(self, config: TrackerConfig) -> TrackerConfig:
        return _with_settings(config, self.tracker)

    @contextlib.contextmanager
    def left_out(self) -> Iterator[None]:
        """The package without it."""
        with contextlib.ExitStack() as stack:
            for place, value in self.constants.items():
                module, name = place.split(":")
                stack.enter_context(_replaced(importlib.import_module(f"sst_graph.{module}"), name, value))
            for place, value in self.members.items():
                module, names = place.split(":")
                owner, name = names.split(".")
                cls = getattr(importlib.import_module(f"sst_graph.{module}"), owner)
                stack.enter_context(_replaced(cls, name, value))
            for place, value in self.functions.items():
                module, name = place.split(":")
                original = getattr(importlib.import_module(f"sst_graph.{module}"), name)
                for other in [m for n, m in sys.modules.items() if n.startswith("sst_graph")]:
                    for own in [n for n, v in vars(other).items() if v is original]:
                        stack.enter_context(_replaced(other, own, value))
            yield

    @property
    def size(self) -> int:
        """Lines of its code."""
        return self.extra_lines + sum(map(lines_of, self.lines))


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    before = owner.__dict__[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


def _with_settings(config: Any, values: Mapping[str, Any]) -> Any:
    for dotted, value in values.items():
        config = _with(config, dotted.split("."), value)
    return config


def _with(config: Any, names: Sequence[str], value: Any) -> Any:
    name, *rest = names
    return dataclasses.replace(config, **{name: _with(getattr(config, name), rest, value) if rest else value})


def lines_of(place: str) -> int:
    """Lines of a file, or of a function or class in it, without blank ones."""
    file, _, names = place.partition(":")
    text = (ROOT / file).read_text()
    rows = text.splitlines()
    if names:
        body: Any = ast.parse(text)
        for name in names.split("."):
            body = next(node for node in body.body if _name_of(node) == name)
        decorators = [node.lineno for node in getattr(body, "decorator_list", [])]
        rows = rows[min([body.lineno, *decorators]) - 1 : body.end_lineno]
    return sum(bool(row.strip()) for row in rows)


def _name_of(node: ast.stmt) -> str:
    if isinstance(node, ast.Assign):
        return getattr(node.targets[0], "id", "")
    return getattr(node, "name", "")


def _model_alone(covariance: Any, spread: Any, flatness: float) -> Any:
    """The covariance of the error model, multiplied by what all together come to on average."""
    from sst_graph.covariance.jackknife import believed_flatness

    return np.asarray(covariance * believed_flatness(flatness) ** 2)


def _naive(bread: Any, table: Any, model: Any) -> Any:
    return np.asarray(bread)


def _without_own_tracks() -> Any:
    from sst_graph.graph.matching import DriveOutlines

    made = DriveOutlines.of.__func__  # type: ignore[attr-defined]

    def of(cls: Any, *args: Any) -> Any:
        found = made(cls, *args)
        return None if found is None else dataclasses.replace(found, own_tracks=None)

    return classmethod(of)


def _without_velocity() -> Any:
    from sst_graph.objects.tracks import moving_objects

    def moving(*args: Any) -> Any:
        return {name: dataclasses.replace(m, velocity=None) for name, m in moving_objects(*args).items()}

    return moving


def _fixed_twist() -> Any:
    from sst_graph.drive.trajectory import TwistTrack

    at_all = TwistTrack.at_all

    def constant(self: Any, stamps_ns: Any) -> Any:
        found = at_all(self, stamps_ns)
        return dataclasses.replace(found, accelerations=np.zeros_like(found.accelerations))

    return constant


def _one_search() -> Any:
    from sst_graph.initialization.selection import _coarse, finding_start, holding_contest

    def choosing(drives, tracks, classes, cTl, offset_s, joint, config):  # type: ignore[no-untyped-def]
        coarse = dataclasses.replace(config, search=_coarse(config))
        found = yield from finding_start(drives, tracks, classes, cTl, offset_s, coarse)
        return (yield from holding_contest(drives, tracks, classes, found, cTl, offset_s, joint, config))

    return choosing


def _no_label_scores(drives, tracks, classes, states, offset_s, config):  # type: ignore[no-untyped-def]
    yield 0
    return np.ones(len(states))


def _one_family() -> Any:
    from sst_graph.initialization import global_search

    families = global_search._families

    def first(*args: Any) -> Any:
        found = yield from families(*args)
        return found[-1:]

    return first


def _held_family() -> Any:
    from sst_graph.initialization import global_search

    families = global_search._families

    def first(*args: Any) -> Any:
        found = yield from families(*args)
        return found[:1]

    return first


def _all_or_nothing(unknown_mps: Any, taus_s: Any, reach_m: float) -> Any:
    return np.where(np.abs(unknown_mps * np.hypot(taus_s, 0.005)) < reach_m, 1.0, 0.0)


def _other_sigma_weights(owners: Any, sides: Any, sigmas_px: Any, config: Any) -> Any:
    return np.ones(len(owners))


SHORT = (20.0, 10.0, 5.0, 3.0)

CASES: tuple[Case, ...] = (
    Case("none", "nothing", 1, kinds=("local", "near", "free", "track", "knock", "clock")),
    # Features
    Case(
        "lower_edges",
        "edges towards the ground",
        1,
        settings={"undersides.use": "never"},
        lines=("batch/lower_edges.py", "features/lidar_edges.py:_ground_heights"),
        extra_lines=60,
        preparation=True,
    ),
    Case(
        "lower_edges_test",
        "test whether labels agree about edges towards the ground (always used)",
        1,
        settings={"undersides.use": "always"},
        lines=("batch/lower_edges.py:UndersideSupport", "batch/lower_edges.py:underside_support"),
        extra_lines=20,
    ),
    Case(
        "lower_edges_bias",
        "mask bias of the lower edges' own (they share their object's)",
        2,
        members={
            "graph.matching:DriveMatches.tracks": property(
                lambda self: (
                    None if self.outlines.own_tracks is None else self.outlines.own_tracks[self.points]
                )
            )
        },
        extra_lines=25,
    ),
    Case("top_edges", "top edges", 1, settings={"joint.graph.match.top_edges": False}, extra_lines=30),
    Case(
        "roofs",
        "reach along roofs (max_roof_m = 0)",
        1,
        settings={"prepare.boundary.max_roof_m": 0.0},
        lines=("features/lidar_edges.py:_along_roof", "features/lidar_edges.py:_amid"),
        extra_lines=12,
        preparation=True,
    ),
    Case(
        "slope",
        "range carried on by the slope of two returns (max_slope_m = 0)",
        2,
        settings={"prepare.boundary.max_slope_m": 0.0},
        lines=("features/lidar_edges.py:_carried_on", "features/lidar_edges.py:_along_rays"),
        preparation=True,
    ),
    Case(
        "picture",
        "contours follow the picture",
        1,
        settings={"prepare.picture.use": False},
        lines=("features/image_edges.py",),
        extra_lines=25,
        preparation=True,
    ),
    Case(
        "picture_unseen",
        "contours without an edge in the picture are left out (min_share = 0)",
        2,
        settings={"prepare.picture.min_share": 0.0},
        extra_lines=20,
        preparation=True,
    ),
    # Matches
    Case(
        "min_cosine",
        "facing test of a match (min_cosine = 0)",
        2,
        settings={"joint.graph.match.min_cosine": 0.0},
        extra_lines=8,
    ),
    Case(
        "min_object_share",
        "objects of whose boundary little meets a contour are left out",
        1,
        settings={"joint.graph.match.min_object_share": 0.0},
        extra_lines=6,
    ),
    Case(
        "side_sigma",
        "error that the matches of one side share (weights 1)",
        1,
        functions={"association.edge_matching:_shared_weights": _other_sigma_weights},
        lines=("association/edge_matching.py:_shared_weights",),
        extra_lines=6,
    ),
    Case(
        "acceleration",
        "acceleration between stamps (constant twist)",
        2,
        members={"drive.trajectory:TwistTrack.at_all": _fixed_twist()},
        extra_lines=20,
    ),
    # Mask biases
    Case(
        "object_bias",
        "mask bias of each object (they share their class's)",
        1,
        members={"graph.matching:DriveOutlines.of": _without_own_tracks()},
        extra_lines=110,
        kinds=("local",),
    ),
    Case(
        "class_bias",
        "mask bias of a class (object biases stay, around 0)",
        1,
        settings={"joint.graph.bias_sigma_px": 0.001},
        extra_lines=30,
    ),
    Case(
        "biases",
        "both kinds of mask bias",
        1,
        settings={"joint.graph.bias_sigma_px": 0.001},
        members={"graph.matching:DriveOutlines.of": _without_own_tracks()},
        extra_lines=140,
        kinds=("local",),
    ),
    # Moving objects
    Case(
        "movers",
        "everything about moving objects",
        1,
        functions={"objects.tracks:moving_objects": lambda *_: {}},
        lines=(
            "objects/persistence.py",
            "objects/velocity.py",
            "objects/tracks.py:MovingConfig",
            "objects/tracks.py:moving_objects",
            "objects/tracks.py:_speeds_without_tracks",
            "objects/tracks.py:_speeds_of_tracks",
            "objects/tracks.py:speed_of",
            "covariance/stationary_objects.py",
        ),
        extra_lines=60,
        kinds=("local",),
    ),
    Case(
        "persistence",
        "moving test by places found again",
        1,
        functions={"objects.tracks:_speeds_without_tracks": lambda *_: {}},
        members={
            "objects.persistence:Persistence.add": lambda *_: set(),
            "objects.persistence:Persistence.speeds": lambda *_: {},
        },
        lines=("objects/persistence.py", "objects/tracks.py:_speeds_without_tracks"),
        extra_lines=8,
    ),
    Case(
        "moving_test",
        "moving test by the way of an object's centre",
        1,
        functions={"objects.tracks:speed_of": lambda *_: 0.0},
        lines=(
            "objects/tracks.py:MovingConfig",
            "objects/tracks.py:_speeds_of_tracks",
            "objects/tracks.py:speed_of",
            "tracker/window/window.py:Window._judge",
            "tracker/window/window.py:Window._judge_track",
            "tracker/window/window.py:Window._decide",
            "tracker/window/window.py:Window._speed",
        ),
        extra_lines=10,
    ),
    Case(
        "velocities",
        "velocities of objects, as compensation and as a moving test",
        1,
        members={"objects.velocity:Velocities._judge": lambda *_: set()},
        lines=("objects/velocity.py", "covariance/stationary_objects.py"),
        extra_lines=60,
    ),
    Case(
        "only_persistence",
        "two of three moving tests: places found again alone",
        1,
        functions={"objects.tracks:speed_of": lambda *_: 0.0},
        members={"objects.velocity:Velocities._judge": lambda *_: set()},
        lines=(
            "objects/velocity.py",
            "covariance/stationary_objects.py",
            "objects/tracks.py:MovingConfig",
            "objects/tracks.py:_speeds_of_tracks",
            "objects/tracks.py:speed_of",
        ),
        extra_lines=130,
    ),
    Case(
        "only_moving_test",
        "two of three moving tests: the way of the centre alone",
        1,
        functions={"objects.tracks:_speeds_without_tracks": lambda *_: {}},
        members={
            "objects.velocity:Velocities._judge": lambda *_: set(),
            "objects.persistence:Persistence.add": lambda *_: set(),
            "objects.persistence:Persistence.speeds": lambda *_: {},
        },
        lines=("objects/velocity.py", "covariance/stationary_objects.py", "objects/persistence.py"),
        extra_lines=70,
    ),
    Case(
        "only_velocities",
        "two of three moving tests: velocities alone",
        1,
        functions={
            "objects.tracks:_speeds_without_tracks": lambda *_: {},
            "objects.tracks:speed_of": lambda *_: 0.0,
        },
        members={
            "objects.persistence:Persistence.add": lambda *_: set(),
            "objects.persistence:Persistence.speeds": lambda *_: {},
        },
        lines=(
            "objects/persistence.py",
            "objects/tracks.py:MovingConfig",
            "objects/tracks.py:_speeds_of_tracks",
            "objects/tracks.py:speed_of",
        ),
        extra_lines=80,
    ),
    Case(
        "velocity_compensation",
        "velocities of objects as compensation (they still tell what moves)",
        1,
        functions={"objects.tracks:moving_objects": _without_velocity()},
        lines=("covariance/stationary_objects.py",),
        extra_lines=50,
        kinds=("local",),
    ),
    Case(
        "graded_share",
        "graded weight of what moves (all or nothing)",
        2,
        functions={"objects.tracks:standing_shares": _all_or_nothing},
        extra_lines=10,
    ),
    # Covariance
    Case(
        "clusters",
        "cluster-robust covariance altogether (all matches independent)",
        1,
        functions={"covariance.cluster_robust:covariance_of": _naive},
        lines=(
            "covariance/jackknife.py",
            "covariance/cluster_robust.py:fit_error_model",
            "covariance/cluster_robust.py:score_variance",
            "covariance/cluster_robust.py:covariance_of",
            "covariance/cluster_robust.py:steps_without_objects",
            "covariance/cluster_robust.py:spread_beyond",
            "covariance/cluster_robust.py:with_floors",
            "tracker/sums/score_sums.py",
        ),
        kinds=("local",),
        covariance="matches",
    ),
    Case(
        "jackknife",
        "jackknife over objects, with 0.33 and 0.145 (the model alone)",
        1,
        functions={"covariance.jackknife:composed": _model_alone},
        lines=(
            "covariance/jackknife.py:ObjectSpread",
            "covariance/jackknife.py:step_without",
            "covariance/cluster_robust.py:steps_without_objects",
            "tracker/sums/object_sums.py",
        ),
        extra_lines=20,
        covariance="matches",
    ),
    Case(
        "two_constants",
        "0.33 and 0.145 (0.5 and 0.5)",
        1,
        constants={"covariance.jackknife:_MODEL_SHARE": 0.5, "covariance.jackknife:_OBJECT_SHARE": 0.5},
        extra_lines=6,
        covariance="matches",
    ),
    Case(
        "birge_objects",
        "inflation where objects disagree (Birge)",
        1,
        members={"covariance.jackknife:ObjectSpread.disagreement": lambda *_: 1.0},
        lines=("covariance/jackknife.py:ObjectSpread.disagreement",),
        extra_lines=3,
        covariance="matches",
    ),
    Case(
        "few_objects",
        "correction for few objects",
        1,
        members={"covariance.jackknife:ObjectSpread.correction": 1.0},
        lines=("covariance/jackknife.py:ObjectSpread.correction",),
        extra_lines=8,
        covariance="matches",
    ),
    Case(
        "flatness",
        "curvature-corrected covariance (flatness)",
        1,
        functions={"covariance.jackknife:believed_flatness": lambda flatness: 1.0},
        lines=(
            "covariance/jackknife.py:believed_flatness",
            "covariance/cluster_robust.py:MatchTable.flatness",
            "covariance/cluster_robust.py:curvatures_of",
            "covariance/cluster_robust.py:flatness_of",
        ),
        extra_lines=25,
        covariance="matches",
    ),
    Case(
        "floors",
        "floors of the error model, with the views",
        1,
        functions={
            "covariance.cluster_robust:with_floors": lambda side, side_frame, match, views: ErrorModel(
                side, side_frame, match
            )
        },
        lines=(
            "covariance/cluster_robust.py:with_floors",
            "covariance/cluster_robust.py:effective_views",
            "covariance/cluster_robust.py:views_of",
        ),
        extra_lines=10,
        covariance="matches",
    ),
    Case(
        "views",
        "share of a side seen from one place (_VIEW = 0)",
        2,
        constants={"covariance.cluster_robust:_VIEW": 0.0},
        lines=("covariance/cluster_robust.py:effective_views", "covariance/cluster_robust.py:views_of"),
        extra_lines=20,
        covariance="matches",
    ),
    Case(
        "freedom",
        "degrees of freedom of sides that the fit swallows",
        2,
        functions={"covariance.cluster_robust:freedom_of_sides": lambda *_: 1.0},
        lines=("covariance/cluster_robust.py:freedom_of_sides",),
        extra_lines=4,
        covariance="matches",
    ),
    Case(
        "moving_covariance",
        "what moving objects alone tell is not called known",
        2,
        functions={"covariance.stationary_objects:standing_covariance": lambda robust, pairs: robust.matrix},
        lines=("covariance/stationary_objects.py",),
        extra_lines=40,
        kinds=("local",),
    ),
    # Outer loop
    Case(
        "full_steps",
        "shortened steps, and the circle that counts as converged",
        1,
        settings={"joint.full_steps": 1000},
        extra_lines=12,
    ),
    Case(
        "circle_sigmas",
        "limit of the circle that counts as converged",
        2,
        settings={"joint.circle_sigmas": 100.0},
        extra_lines=5,
    ),
    Case("kernel_short", "12 kernel scales (4: 20, 10, 5, 3 px)", 1, settings={"joint.kernel_px": SHORT}),
    Case(
        "kernel_one",
        "the kernel's schedule altogether (3 px)",
        1,
        settings={"joint.kernel_px": (3.0,)},
        extra_lines=4,
    ),
    Case("inner_one", "a second inner iteration", 2, settings={"joint.inner_iterations": 1}),
    # Motion
    Case(
        "motion_factor",
        "motion as a factor and a check",
        1,
        settings={"use_motion": "never"},
        lines=("batch/motion_factor.py",),
        extra_lines=35,
        preparation=True,
        kinds=("local",),
    ),
    Case(
        "motion_inflation",
        "inflation where labels and motion disagree",
        2,
        constants={"batch.motion_factor:_UNLIKELY_CHI2": np.inf},
        extra_lines=6,
        kinds=("local",),
    ),
    Case(
        "motion_stretches",
        "check of the motion against each stretch",
        2,
        functions={"batch.motion_factor:_worst_stretch": lambda *_: None},
        lines=("batch/motion_factor.py:_worst_stretch", "batch/motion_factor.py:_of_stretch"),
        extra_lines=12,
        kinds=("local",),
    ),
    # Checks
    Case(
        "contradictions",
        "contradictions within a drive",
        1,
        settings={"contradictions.check": False},
        lines=("batch/contradictions.py", "batch/parts.py", "covariance/contradiction.py"),
        extra_lines=15,
        kinds=("local",),
    ),
    Case(
        "assumption_test",
        "test of the assumptions",
        1,
        settings={"assumptions.test": False},
        lines=(
            "batch/assumption_tests.py",
            "covariance/broken_assumptions.py",
            "tracker/assumption_tests.py",
        ),
    ),
    Case(
        "broken_assumptions",
        "prior odds of broken assumptions (prior sigmas are considered)",
        1,
        functions={
            "covariance.broken_assumptions:considered_sigmas": lambda evidence: {
                name: each.prior for name, each in evidence.items()
            }
        },
        lines=("covariance/broken_assumptions.py", "batch/assumption_tests.py:told_by"),
        covariance="assumptions",
    ),
    Case(
        "considered",
        "assumptions considered, and their test",
        1,
        settings={"assumptions.test": False},
        members={"covariance.considered:Considered.covariance": lambda self, size: np.zeros((size, size))},
        lines=(
            "covariance/considered.py",
            "batch/assumption_tests.py",
            "tracker/assumption_tests.py",
            "covariance/broken_assumptions.py",
        ),
        covariance="assumptions",
    ),
    # Odometry
    Case(
        "smoothing",
        "smoothing of the LiDAR's motion",
        1,
        members={"odometry.smoothing:MotionSmoother.smoothed": lambda self, motions: list(motions)},
        lines=("odometry/smoothing.py",),
    ),
    Case(
        "standstill",
        "standing frames (exactly no motion)",
        1,
        members={"odometry.standing:Rest.told": lambda self, motions: list(motions)},
        lines=("odometry/standing.py",),
    ),
    Case(
        "odometry_movers",
        "standing objects of movable classes in the odometry",
        1,
        members={
            "odometry.stationary_objects:StandingObjects.still": lambda self, wPs, stamp_ns: np.zeros(
                len(wPs), np.bool_
            )
        },
        lines=("odometry/stationary_objects.py",),
        extra_lines=8,
        preparation=True,
    ),
    Case(
        "odometry_all",
        "movable classes are left out of the odometry (all points used)",
        2,
        members={
            "odometry.stationary_objects:StandingObjects.still": lambda self, wPs, stamp_ns: np.ones(
                len(wPs), np.bool_
            )
        },
        lines=("odometry/stationary_objects.py",),
        extra_lines=12,
        preparation=True,
    ),
    Case(
        "odometry_rest",
        "early end of the first search where it stands (rest_m = 0)",
        2,
        settings={"prepare.lidar_odometry.rest_m": 0.0},
        extra_lines=6,
        preparation=True,
    ),
    Case(
        "odometry_search",
        "search of the first motion (search_m = 0)",
        2,
        settings={"prepare.lidar_odometry.search_m": 0.0},
        lines=("odometry/lidar.py:LidarOdometry._searched",),
        extra_lines=20,
        preparation=True,
    ),
    Case(
        "missed_cost",
        "cost of a point without a pair among the trials",
        2,
        settings={"prepare.lidar_odometry.missed_cost": 0.0},
        extra_lines=3,
        preparation=True,
    ),
    Case(
        "map_age",
        "local map of 20 scans (scan to scan: 1)",
        2,
        settings={"prepare.lidar_odometry.map_age": 1},
        extra_lines=15,
        preparation=True,
    ),
    Case(
        "plane_ratio",
        "fewer points of the main surface",
        2,
        settings={"prepare.lidar_odometry.plane_ratio": 1000.0},
        extra_lines=15,
        preparation=True,
    ),
    Case(
        "voxel_adaptation",
        "voxels that adapt to 3000 points",
        2,
        settings={"prepare.lidar_odometry.min_voxel_m": 0.2, "prepare.lidar_odometry.max_voxel_m": 0.2},
        extra_lines=6,
        preparation=True,
    ),
    Case(
        "sweep",
        "decision about the sweep",
        2,
        settings={"sweep.decide": False},
        lines=(
            "odometry/sweep/decision.py",
            "odometry/sweep/estimate.py",
            "odometry/sweep/window.py",
            "odometry/sweep/source.py",
            "odometry/sweep/__init__.py",
            "batch/sweep_effect.py",
        ),
        preparation=True,
        kinds=("local",),
    ),
    # Start
    Case(
        "second_search",
        "second search around distant candidates",
        1,
        functions={"initialization.selection:choosing_start": _one_search()},
        extra_lines=35,
        kinds=("free",),
    ),
    Case(
        "search_free",
        "family of candidates with the translation free",
        1,
        functions={"initialization.global_search:_families": _held_family()},
        extra_lines=10,
        kinds=ANY_START,
    ),
    Case(
        "search_held",
        "family of candidates with the translation held",
        1,
        functions={"initialization.global_search:_families": _one_family()},
        extra_lines=10,
        kinds=ANY_START,
    ),
    Case(
        "search_dependence",
        "candidates by dependence (by votes alone)",
        1,
        settings={"start.search.judges": ("votes",)},
        extra_lines=40,
        kinds=ANY_START,
    ),
    Case(
        "search_votes",
        "candidates by votes (by dependence alone)",
        1,
        settings={"start.search.judges": ("dependence",)},
        extra_lines=40,
        kinds=ANY_START,
    ),
    Case(
        "cross_entropy",
        "refinement of the candidates by the cross-entropy method",
        1,
        settings={"start.rounds": 0},
        lines=("initialization/global_search.py:_cross_entropy",),
        extra_lines=40,
        kinds=ANY_START,
    ),
    Case(
        "label_scores",
        "score of all labels in the choice of the start",
        1,
        functions={"initialization.candidates:scoring_labels": _no_label_scores},
        lines=("initialization/candidates.py:scoring_labels", "initialization/candidates.py:label_scores"),
        kinds=ANY_START,
    ),
    Case(
        "finalists",
        "a second solution, and alternatives elsewhere",
        1,
        settings={"start.finalists": 1},
        functions={"initialization.selection:_rival": lambda *_: None},
        lines=("initialization/selection.py:_rival", "initialization/selection.py:rivals"),
        extra_lines=40,
        kinds=ANY_START,
    ),
    Case(
        "thinned_stages",
        "thinned points under wide kernels",
        1,
        settings={"start.heat_points": 5000},
        extra_lines=35,
        kinds=ANY_START,
    ),
    Case(
        "selection_stages",
        "selection between the stages (all candidates go on)",
        2,
        settings={"start.survival": 1.0},
        extra_lines=15,
        kinds=ANY_START,
    ),
    Case(
        "start_object_share",
        "objects matched badly are left out of the choice",
        1,
        settings={"start.min_object_share": 0.0},
        lines=("initialization/selection.py:_simple",),
        extra_lines=3,
        kinds=ANY_START,
    ),
    Case(
        "start_offsets",
        "the best candidate at two other time offsets",
        1,
        functions={"initialization.selection:_with_offsets": lambda candidates, offset_s: list(candidates)},
        lines=("initialization/selection.py:_with_offsets",),
        kinds=ANY_START,
    ),
    Case(
        "free_breadth",
        "four times as many candidates without a guess",
        1,
        settings={"start.search.free_breadth": 1, "start.free_contenders": 320},
        extra_lines=8,
        kinds=("free",),
    ),
    Case(
        "settling_steps",
        "further steps under the narrowest kernel",
        2,
        settings={"start.settling": 0},
        extra_lines=2,
        kinds=ANY_START,
    ),
    # Tracker
    Case(
        "track_ambiguous",
        "scans that may belong to either of two images keep both",
        4,
        members={"tracker.window.matcher:WindowMatcher._other": lambda *_: None},
        lines=("tracker/window/ambiguous_pairs.py", "tracker/window/matcher.py:WindowMatcher._other"),
        extra_lines=30,
        kinds=TRACKING,
    ),
    Case(
        "track_observed",
        "observed information of what has left (second derivatives of the loss)",
        4,
        constants={"tracker.sums.scan_scores:_LEAST_BEND": 1.0},
        extra_lines=45,
        kinds=TRACKING,
    ),
    Case(
        "track_settling",
        "matching the whole window anew at times",
        4,
        members={"tracker.window.whole_window:Milestones.reached": lambda *_: False},
        lines=("tracker/window/whole_window.py:Milestones", "tracker/window/whole_window.py:Settling"),
        extra_lines=45,
        kinds=TRACKING,
    ),
    Case(
        "track_renew",
        "matching scans anew that the estimate has moved away from",
        4,
        tracker={"renew": 0, "stale_sigmas": 1000.0},
        lines=("tracker/window/rematching.py:_staleness",),
        extra_lines=15,
        kinds=TRACKING,
    ),
    Case(
        "track_leaving",
        "matching a scan anew before it leaves",
        4,
        constants={"tracker.window.rematching:_FRESH_SIGMAS": 1e9},
        extra_lines=10,
        kinds=TRACKING,
    ),
    Case(
        "track_renew_all",
        "matching scans anew in any case but settling",
        4,
        tracker={"renew": 0, "renew_most": 0},
        lines=("tracker/window/rematching.py",),
        kinds=TRACKING,
    ),
    Case(
        "track_judged_anew",
        "matching scans anew whose objects turn out to move",
        4,
        functions={"tracker.window.rematching:_judged_anew": lambda *_: []},
        lines=("tracker/window/rematching.py:_judged_anew",),
        extra_lines=12,
        kinds=TRACKING,
    ),
    Case(
        "track_start_check",
        "check of a start",
        4,
        members={
            "tracker.monitor.start_check:Trial.check": lambda *_: "",
            "tracker.monitor.start_check:Trial.over": lambda *_: True,
            "tracker.monitor.start_check:Trial.look_again": lambda *_: None,
        },
        lines=("tracker/monitor/start_check.py", "tracker/monitor/comparison.py:Watch.disagreement"),
        extra_lines=20,
        kinds=WATCHING,
    ),
    Case(
        "track_alarm",
        "watch for changes",
        4,
        tracker={"alarm.enabled": False},
        lines=(
            "tracker/monitor/alarm.py",
            "tracker/monitor/comparison.py",
            "tracker/monitor/confirmation.py",
        ),
        extra_lines=60,
        kinds=WATCHING,
    ),
    Case(
        "track_stamps",
        "jumps of the stamps' intervals",
        4,
        tracker={"alarm.stamps": False},
        lines=("drive/stamp_intervals.py",),
        extra_lines=30,
        kinds=WATCHING,
    ),
    Case(
        "track_one_object",
        "a change must hold without any one object",
        4,
        members={"tracker.monitor.comparison:Watch._contradicted": lambda self, *_: self.kept},
        lines=("tracker/monitor/comparison.py:Watch._contradicted",),
        kinds=WATCHING,
    ),
    Case(
        "track_usual",
        "usual size of the statistic, learnt",
        4,
        members={"tracker.monitor.alarm:StepAlarm._scale": lambda *_: 1.0},
        lines=("tracker/monitor/alarm.py:StepAlarm._scale",),
        extra_lines=6,
        kinds=WATCHING,
    ),
    Case(
        "track_restless",
        "objects that moved lately are not asked",
        4,
        members={"tracker.window.window:Window.restless": lambda self: set()},
        lines=("tracker/window/window.py:Window.restless",),
        extra_lines=12,
        kinds=WATCHING,
    ),
    Case(
        "track_lost",
        "labels that leave what ought to be in view",
        4,
        members={
            "tracker.monitor.comparison:Watch.lost": False,
            "tracker.monitor.comparison:Watch.far": False,
        },
        lines=(
            "tracker/monitor/comparison.py:Watch.lost",
            "tracker/monitor/comparison.py:Watch.far",
            "tracker/monitor/comparison.py:Watch._gone",
            "tracker/window/matcher.py:WindowMatcher.in_view",
        ),
        extra_lines=20,
        kinds=WATCHING,
    ),
    Case(
        "track_arrivals",
        "gains of each scan",
        4,
        members={"tracker.window.arrivals:Arrivals.take": lambda *_: None},
        lines=("tracker/window/arrivals.py",),
        extra_lines=8,
        kinds=TRACKING,
    ),
    Case(
        "track_adoption",
        "held-out comparison",
        4,
        members={"tracker.monitor.adoption:Adoption.hear": lambda *_: None},
        lines=("tracker/monitor/adoption.py", "tracker/window/matcher.py:WindowMatcher.cost"),
        extra_lines=15,
        kinds=TRACKING,
    ),
    Case(
        "track_tests",
        "test of the assumptions",
        4,
        settings={"assumptions.test": False},
        lines=("tracker/assumption_tests.py",),
        extra_lines=20,
        kinds=TRACKING,
    ),
    Case(
        "track_considered",
        "assumptions considered, and their test",
        4,
        settings={"assumptions.test": False},
        members={"covariance.considered:Considered.covariance": lambda self, size: np.zeros((size, size))},
        lines=("tracker/assumption_tests.py",),
        extra_lines=80,
        kinds=TRACKING,
    ),
    Case(
        "track_start_damping",
        "damping of the time offset in the first solution",
        4,
        tracker={"start_offset_step_s": 10.0},
        lines=("tracker/start/solution.py:_damped",),
        extra_lines=8,
        kinds=TRACKING,
    ),
    Case(
        "track_jackknife",
        "jackknife over objects, with 0.33 and 0.145 (the model alone)",
        4,
        functions={"covariance.jackknife:composed": _model_alone},
        lines=("tracker/sums/object_sums.py",),
        extra_lines=40,
        kinds=TRACKING,
    ),
    Case(
        "track_object_bias",
        "mask bias of each object (and what moves: they go by one switch)",
        4,
        settings={"joint.graph.object_bias_sigma_px": 0.0},
        extra_lines=120,
        kinds=TRACKING,
    ),
    Case(
        "track_lower_edges",
        "edges towards the ground",
        4,
        settings={"undersides.use": "never"},
        extra_lines=40,
        kinds=TRACKING,
    ),
)
