"""The heuristics that ``studies/ablation.py`` leaves out, one case each: what, how, and which lines would go.

A case leaves its heuristic out by a setting where there is one. Else it replaces a named constant, function
or member of a class of ``sst_graph`` while it runs: a name that does not exist is an error, and so is one
that another module holds under another name.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.motion_factor import WithMotion
from sst_graph.batch.total_covariance import SweepEffects
from sst_graph.config import with_overrides
from sst_graph.covariance.considered import Considered
from sst_graph.covariance.error_model import ErrorModel
from sst_graph.features.up import LEVEL
from sst_graph.graph.outer_loop import KERNELS_PX, NARROW_KERNELS_PX
from sst_graph.graph.state import State
from sst_graph.initialization.global_search import COARSE

PACKAGE = Path(__file__).resolve().parent.parent / "sst_graph"
JOINT, EDGES, SEARCH = "joint", "edges", "search"
"""Kinds of run: by labels and by edges, from nearby; by labels with the search for a start."""
Change = Callable[[Any], Any]
"""What stands in the place of an original, made from it."""


@dataclass(frozen=True)
class Case:
    """One heuristic.

    Attributes:
        name: of the case.
        what: is left out; in brackets what is there instead.
        settings: overrides, as ``--set`` has them.
        changes: by ``module:NAME`` or ``module:Class.name``, without ``sst_graph.``.
        lines: code that would go: ``file``, ``file:name`` or ``file:Class.name``.
        more_lines: an estimate of those that stand inside longer functions.
        prepared: drives are to be prepared anew.
        methods: kinds of run that it is left out of.
    """

    name: str
    what: str
    settings: Sequence[str] = ()
    changes: Mapping[str, Change] = field(default_factory=dict)
    lines: Sequence[str] = ()
    more_lines: int = 0
    prepared: bool = False
    methods: Sequence[str] = (JOINT,)

    def configured(self, config: CalibrationConfig) -> CalibrationConfig:
        """Settings without it."""
        return with_overrides(config, self.settings)

    @contextlib.contextmanager
    def left_out(self) -> Iterator[None]:
        """The package without it."""
        with contextlib.ExitStack() as stack:
            for place, change in self.changes.items():
                stack.enter_context(replaced(place, change))
            yield

    @property
    def size(self) -> int:
        """Lines that would go."""
        return self.more_lines + sum(map(lines_of, self.lines))


@contextlib.contextmanager
def replaced(place: str, change: Change) -> Iterator[None]:
    """A constant, function or member replaced, in all modules that have imported it.

    Raises:
        LookupError: there is none of this name, or a module has it under another one.
    """
    module_name, _, names = place.partition(":")
    owner: Any = importlib.import_module(f"sst_graph.{module_name}")
    *outer, name = names.split(".")
    for each in outer:
        owner = getattr(owner, each)
    if name not in vars(owner):
        raise LookupError(f"{place}: found nothing of this name")
    original = vars(owner)[name]
    holders = [owner] if outer else _holders(name, original)
    new = change(original)
    for holder in holders:
        setattr(holder, name, new)
    try:
        yield
    finally:
        for holder in holders:
            setattr(holder, name, original)
    late = [] if outer else [module.__name__ for module in _modules() if vars(module).get(name) is new]
    if new is not original and late and not isinstance(new, int | float):
        raise LookupError(f"{place}: {', '.join(late)} imported it while it was replaced")


def _modules() -> list[Any]:
    return [module for name, module in sorted(sys.modules.items()) if name.split(".")[0] == "sst_graph"]


def _holders(name: str, original: Any) -> list[Any]:
    """Modules that have an object under its name."""
    if callable(original):
        for module in _modules():
            others = [own for own, value in vars(module).items() if value is original and own != name]
            if others:
                raise LookupError(f"{name}: {module.__name__} has it as {', '.join(others)}")
    return [module for module in _modules() if vars(module).get(name) is original]


def lines_of(place: str) -> int:
    """Lines of a file, or of a function, class or member in it, without blank ones."""
    file, _, names = place.partition(":")
    text = (PACKAGE / file).read_text(encoding="utf-8")
    rows, node = text.splitlines(), ast.parse(text)
    if names:
        for name in names.split("."):
            node = next(own for own in node.body if getattr(own, "name", "") == name)  # type: ignore[assignment]
        first = min([node.lineno, *(each.lineno for each in node.decorator_list)])  # type: ignore[attr-defined]
        rows = rows[first - 1 : node.end_lineno]  # type: ignore[attr-defined]
    return sum(bool(row.strip()) for row in rows)


def base_of(case: Case, method: str) -> Case:
    """What a case is compared with: where the cases by labels are left out of :data:`LEAN`, that."""
    return NOTHING if method != JOINT or case in (NOTHING, LEAN, *DIAGNOSTICS) else LEAN


def to(value: Any) -> Change:
    """This value in place of the original."""
    return lambda _: value


def answering(value: Any) -> Change:
    """A function that answers this, whatever it is asked."""
    return lambda _: lambda *args, **options: value


def _no_upper_edges(original: Any) -> Any:
    def ring_edges(points, seen, beams, ground=None, roofs=False):  # type: ignore[no-untyped-def]
        found = original(points, seen, beams, ground, roofs)
        if ground is not None:
            return found
        return type(found)(*(rows[:0] for rows in vars(found).values()))

    return ring_edges


def _no_roofs(original: Any) -> Any:
    return lambda points, seen, beams, ground=None, roofs=False: original(points, seen, beams, ground)


def _without_own_tracks(original: Any) -> Any:
    def of(cls, *args):  # type: ignore[no-untyped-def]
        found = original.__func__(cls, *args)
        return None if found is None else replace(found, own_tracks=None)

    return classmethod(of)


def _tracks_of_objects(_: Any) -> Any:
    return property(
        lambda self: None if self.edges.own_tracks is None else self.edges.own_tracks[self.points]
    )


def _without_velocities(original: Any) -> Any:
    def found(*args):  # type: ignore[no-untyped-def]
        return {name: replace(one, velocity=None) for name, one in original(*args).items()}

    return found


def _all_or_nothing(_: Any) -> Any:
    def weights(unknown_mps, taus_s, reach_m):  # type: ignore[no-untyped-def]
        return np.where(unknown_mps * np.hypot(taus_s, 0.005) < reach_m, 1.0, 0.0)

    return weights


def _constant_twists(original: Any) -> Any:
    def at_all(self, stamps_ns):  # type: ignore[no-untyped-def]
        found = original(self, stamps_ns)
        return replace(found, accelerations=np.zeros_like(found.accelerations))

    return at_all


def _means_at_middles(original: Any) -> Any:
    def at_middles(self, first, end):  # type: ignore[no-untyped-def]
        _, rates, known = original(self, first, end)
        return np.array([motion.mean_twist for motion in self._motions[first:end]]), rates, known

    return at_middles


def _as_they_are(_: Any) -> Any:
    return lambda self, motions: list(motions)


def _none_of(_: Any) -> Any:
    return lambda self, points, *args: np.zeros(len(points), np.bool_)


def _model_alone(original: Any) -> Any:
    return lambda covariance, spread, ratio: original(covariance, None, ratio)


def _priors_alone(_: Any) -> Any:
    return lambda evidence: {name: each.prior for name, each in evidence.items()}


def _nothing_considered(_: Any) -> Any:
    return lambda self, size: np.zeros((size, size))


def _steps_answering(value: Any) -> Change:
    def steps(*args, **options):  # type: ignore[no-untyped-def]
        yield 1
        return value

    return lambda _: steps


def _start_as_guessed(_: Any) -> Any:
    def steps(edges, region):  # type: ignore[no-untyped-def]
        yield 1
        return [State(region.cTl, region.time_offsets_s[:1])]

    return steps


def _centres_alone(original: Any) -> Any:
    def nearest(gradients, spans, uvs, outward, scale_px, place="centre"):  # type: ignore[no-untyped-def]
        return original(gradients, spans, uvs, outward, scale_px, "centre" if place == "peak" else place)

    return nearest


def _equal_label_scores(_: Any) -> Any:
    def steps(problem, poses, config):  # type: ignore[no-untyped-def]
        yield 1
        return np.ones(len(poses))

    return steps


def _first_alone(original: Any) -> Any:
    return lambda *args: original(*args)[:1]


_BOTH = (JOINT, EDGES)

FEATURES: tuple[Case, ...] = (
    Case(
        "lower_edges",
        "edges towards the ground",
        settings=("lower_edges=never",),
        lines=(
            "batch/lower_edges.py",
            "features/lidar_edges.py:_ground_below",
            "features/lidar_edges.py:_Ground",
        ),
        more_lines=50,
        prepared=True,
    ),
    Case(
        "lower_edges_test",
        "test whether labels agree about edges towards the ground (always used)",
        settings=("lower_edges=always",),
        lines=("batch/lower_edges.py:LowerEdgeSupport", "batch/lower_edges.py:lower_edge_support"),
        more_lines=15,
    ),
    Case(
        "lower_edge_bias",
        "mask bias that lower edges of a class share (they share their object's)",
        changes={"graph.matching:DriveMatches.tracks": _tracks_of_objects},
        more_lines=25,
    ),
    Case(
        "lower_edge_sigma",
        "larger error that matches of a lower edge share (that of other sides)",
        changes={"association.edge_matching:LOWER_EDGE_SIGMA_PX": to(0.7)},
        more_lines=3,
    ),
    Case(
        "top_edges",
        "edges towards the ring above",
        changes={"features.lidar_edges:_ring_edges": _no_upper_edges},
        more_lines=30,
        prepared=True,
    ),
    Case(
        "roofs",
        "reach along roofs",
        changes={"features.lidar_edges:_ring_edges": _no_roofs},
        lines=("features/lidar_edges.py:_to_tangent", "features/lidar_edges.py:_within_object"),
        more_lines=8,
        prepared=True,
    ),
    Case(
        "roof_beams",
        "a roof goes on to both sides of a point (no matter)",
        changes={
            "features.lidar_edges:_within_object": lambda _: (
                lambda mask, beams, index: np.ones(len(index), np.bool_)
            )
        },
        lines=("features/lidar_edges.py:_within_object",),
        more_lines=2,
        prepared=True,
    ),
    Case(
        "range_slope",
        "range of an edge carried on by the slope of two returns",
        changes={
            "features.lidar_edges:_extrapolated": lambda _: (
                lambda beams, last, before, known: np.zeros(len(last))
            )
        },
        lines=("features/lidar_edges.py:_extrapolated",),
        more_lines=8,
        prepared=True,
    ),
    Case(
        "range_step",
        "least step in range across an edge (any)",
        changes={
            "features.lidar_edges:_is_behind": lambda original: (
                lambda rho, last, following, behind_m: original(rho, last, following, 0.0)
            )
        },
        more_lines=4,
        prepared=True,
    ),
    Case(
        "beam_gaps",
        "largest gaps to the next beam and the next ring (any)",
        changes={
            "features.lidar_edges:_MAX_STEPS": to(1e6),
            "features.lidar_edges:_MAX_ELEVATION_GAP": to(10.0),
        },
        more_lines=8,
        prepared=True,
    ),
    Case(
        "small_objects",
        "objects with fewer than 15 returns are left out",
        changes={"features.lidar_edges:_MIN_POINTS": to(1)},
        more_lines=5,
        prepared=True,
    ),
    Case(
        "far_objects",
        "objects beyond 60 m are left out",
        settings=("max_range_m=1000",),
        more_lines=8,
        prepared=True,
    ),
    Case(
        "upside_down",
        "LiDARs that hang upside down (up is the z axis)",
        changes={"features.up:up_direction": answering(LEVEL)},
        lines=("features/up.py",),
        more_lines=8,
        prepared=True,
    ),
    Case(
        "picture",
        "contours follow the picture",
        settings=("image_edges=false",),
        lines=("features/image_edges.py",),
        more_lines=25,
        prepared=True,
    ),
    Case(
        "picture_unseen",
        "contours without an edge in the picture are left out",
        changes={"features.image_edges:_MIN_SHARE": to(0.0)},
        more_lines=15,
        prepared=True,
    ),
    Case(
        "picture_ambiguous",
        "a contour stays where two edges of the picture are alike (it follows the likeliest)",
        changes={"features.image_edges:_MAX_SECOND_BEST": to(1e9)},
        more_lines=5,
        prepared=True,
    ),
    Case(
        "picture_contrast",
        "a contour stays where the picture has little contrast",
        changes={"features.image_edges:_MIN_CONTRAST": to(0.0)},
        more_lines=3,
        prepared=True,
    ),
    Case(
        "picture_nearness",
        "of two edges of the picture the nearer is likelier",
        changes={"features.image_edges:_MASK_SIGMA_PX": to(1e3)},
        more_lines=4,
        prepared=True,
    ),
    Case(
        "picture_along",
        "profiles of the picture are averaged along the contour",
        changes={"features.image_edges:_ALONG_PX": to(0)},
        more_lines=12,
        prepared=True,
    ),
    Case(
        "contour_smoothing",
        "smoothing of the masks' distances",
        changes={"features.mask_contour:_SMOOTHING_PX": to(0.01)},
        more_lines=3,
        prepared=True,
    ),
    Case(
        "image_border",
        "nothing is matched within 3 px of the image's border",
        changes={"features.mask_contour:BORDER_PX": to(0.0)},
        more_lines=4,
    ),
    Case(
        "ridges",
        "pixels between two contours are not matched",
        changes={"features.mask_contour:MIN_GRADIENT": to(0.0)},
        more_lines=3,
    ),
)

MATCHES: tuple[Case, ...] = (
    Case(
        "facing",
        "contours that do not face outward are not matched",
        changes={"association.edge_matching:_MIN_COSINE": to(-2.0)},
        lines=("association/edge_matching.py:faces",),
        more_lines=6,
    ),
    Case(
        "object_share",
        "objects of which little meets a contour are left out",
        changes={"association.edge_matching:MIN_OBJECT_SHARE": to(0.0)},
        lines=("association/edge_matching.py:of_matched_objects",),
        more_lines=4,
    ),
    Case(
        "beam_sigma",
        "sigma of a match by the gap between beams (the mask's alone)",
        changes={
            "association.edge_matching:match_sigmas": lambda _: (
                lambda lengths_px, cosines, config: np.full(len(lengths_px), config.mask_sigma_px)
            )
        },
        lines=("association/edge_matching.py:match_sigmas",),
    ),
    Case(
        "side_weights",
        "errors that matches of a side share, in the weights",
        changes={
            "association.edge_matching:side_weights": lambda _: lambda owners, *args: np.ones(len(owners))
        },
        lines=("association/edge_matching.py:side_weights", "association/edge_matching.py:_information"),
        more_lines=4,
        methods=_BOTH,
    ),
    Case(
        "level_edges",
        "error between two rings that a level edge's matches share",
        changes={
            "association.edge_matching:level_sigmas": lambda _: (
                lambda sides, sigmas_px, config: np.zeros(len(sides))
            )
        },
        lines=("covariance/level_edges.py", "association/edge_matching.py:level_sigmas"),
        more_lines=60,
    ),
    Case(
        "level_sums",
        "the same in the covariance alone",
        changes={
            "covariance.level_edges:LevelSums.variance": lambda _: (
                lambda self: np.zeros((self.scores.shape[1],) * 2)
            )
        },
        lines=("covariance/level_edges.py",),
        more_lines=40,
    ),
    Case(
        "acceleration",
        "acceleration around an image (constant twist)",
        changes={"drive.twists:SensorTwists.at_all": _constant_twists},
        more_lines=25,
    ),
    Case(
        "twist_curve",
        "twists are those of a curve (the mean of each interval at its middle)",
        changes={"drive.twists:SensorTwists._at_middles": _means_at_middles},
        more_lines=8,
    ),
    Case(
        "class_bias",
        "mask bias of a class",
        settings=("noise.mask_bias_sigma_px=0.001",),
        more_lines=30,
    ),
    Case(
        "object_bias",
        "mask bias of each object (its class's)",
        changes={"graph.matching:DriveEdges.of": _without_own_tracks},
        more_lines=110,
        methods=_BOTH,
    ),
    Case(
        "biases",
        "both kinds of mask bias",
        settings=("noise.mask_bias_sigma_px=0.001",),
        changes={"graph.matching:DriveEdges.of": _without_own_tracks},
        more_lines=140,
    ),
)

OBJECTS: tuple[Case, ...] = (
    Case(
        "movers",
        "everything about objects that move",
        changes={"objects.dynamic_objects:find_dynamic_objects": answering({})},
        lines=(
            "objects/dynamic_objects.py",
            "objects/occupancy.py",
            "objects/velocity.py",
            "covariance/static_objects.py",
        ),
        more_lines=60,
        methods=_BOTH,
    ),
    Case(
        "path_test",
        "an object moves where a line fits its centres",
        changes={"objects.dynamic_objects:speed_of_path": answering(0.0)},
        lines=(
            "objects/dynamic_objects.py:speed_of_path",
            "objects/dynamic_objects.py:Detection",
            "objects/dynamic_objects.py:DynamicObjectTest._test_path",
            "objects/dynamic_objects.py:DynamicObjectTest._test_latest_paths",
        ),
        more_lines=30,
    ),
    Case(
        "occupancy",
        "an object moves where its place is free at other times",
        changes={"objects.occupancy:OccupancyTest.speeds": answering({})},
        lines=("objects/occupancy.py",),
        more_lines=6,
    ),
    Case(
        "occupancy_horizon",
        "the shorter of two intervals of that test",
        changes={"objects.occupancy:_HORIZONS_S": to((0.3,))},
        more_lines=8,
    ),
    Case(
        "occupied_by_any",
        "a place is taken by anything but ground (by the object's class)",
        changes={
            "objects.occupancy:_Outlines.near_some": lambda _: (
                lambda self, wPs: np.zeros(len(self.wPs), np.bool_)
            )
        },
        lines=("objects/occupancy.py:_Outlines.near_some", "objects/occupancy.py:_Places._raised"),
        more_lines=5,
    ),
    Case(
        "velocities",
        "velocities by an object's near end, as a test and as a compensation",
        changes={"objects.velocity:ObjectVelocities.update_all": answering(None)},
        lines=("objects/velocity.py", "covariance/static_objects.py"),
        more_lines=50,
    ),
    Case(
        "velocity_compensation",
        "velocities as a compensation (they still tell what moves)",
        changes={"objects.dynamic_objects:find_dynamic_objects": _without_velocities},
        lines=("covariance/static_objects.py",),
        more_lines=50,
    ),
    Case(
        "velocity_check",
        "the whole outline moves along with its near end",
        changes={"objects.velocity:_is_carried": answering(True)},
        lines=("objects/velocity.py:_is_carried",),
        more_lines=5,
    ),
    Case(
        "velocity_memory",
        "what has moved within 0.8 s is dynamic (at its own scan alone)",
        changes={"objects.velocity:_MEMORY_S": to(0.0)},
        more_lines=20,
    ),
    Case(
        "graded_weights",
        "weights of what moves by how far (all or nothing)",
        changes={"objects.dynamic_objects:dynamic_object_weights": _all_or_nothing},
        more_lines=6,
    ),
    Case(
        "static_covariance",
        "what moving objects alone tell does not count as known",
        changes={
            "covariance.static_objects:static_covariance": lambda _: lambda robust, pairs: robust.matrix
        },
        lines=("covariance/static_objects.py",),
        more_lines=30,
    ),
)

ODOMETRY: tuple[Case, ...] = (
    Case(
        "smoothing",
        "smoothing of the LiDAR's motion",
        changes={"odometry.smoothing:MotionSmoother.smoothed": _as_they_are},
        lines=("odometry/smoothing.py",),
        methods=_BOTH,
    ),
    Case(
        "standstill",
        "no motion at standstill",
        changes={"odometry.standstill:ZeroVelocityUpdate.apply": _as_they_are},
        lines=("odometry/standstill.py",),
    ),
    Case(
        "parked_in_odometry",
        "static objects of movable classes in the odometry",
        changes={"odometry.static_points:StaticPoints.find": _none_of},
        lines=("odometry/static_points.py",),
        more_lines=12,
        prepared=True,
    ),
    Case(
        "movable_in_odometry",
        "movable classes are left out of the odometry (all points)",
        changes={"odometry.lidar:_MOVABLE": to(np.zeros(256, np.bool_))},
        lines=("odometry/static_points.py",),
        more_lines=25,
        prepared=True,
    ),
    Case(
        "map_age",
        "map of 20 scans (of the last one)",
        changes={"odometry.lidar:_MAP_AGE": to(1)},
        lines=("odometry/local_map.py",),
        more_lines=15,
        prepared=True,
    ),
    Case(
        "main_surface",
        "fewer points of the main surface",
        changes={"odometry.lidar:PLANE_RATIO": to(1e3)},
        lines=("odometry/cloud.py:_along_main_direction",),
        more_lines=12,
        prepared=True,
    ),
    Case(
        "more_neighbours",
        "more neighbours where rings are far apart",
        changes={"odometry.cloud:_neighbours": lambda _: lambda points, tree, fewest: fewest},
        lines=("odometry/cloud.py:_neighbours",),
        more_lines=8,
        prepared=True,
    ),
    Case(
        "voxel_adaptation",
        "voxels that adapt to 3000 points",
        changes={"odometry.lidar:_MIN_VOXEL_M": to(0.2), "odometry.lidar:_MAX_VOXEL_M": to(0.2)},
        more_lines=6,
        prepared=True,
    ),
    Case(
        "first_motion",
        "search for the first motion",
        changes={"odometry.lidar:LidarOdometry._best_start": lambda _: lambda self, points, wTl: wTl},
        lines=("odometry/lidar.py:LidarOdometry._best_start",),
        more_lines=14,
        prepared=True,
    ),
    Case(
        "missed_cost",
        "cost of a point without a pair in that search",
        changes={"odometry.lidar:_MISSED_COST": to(0.0)},
        more_lines=4,
        prepared=True,
    ),
    Case(
        "odometry_inflation",
        "sigmas of the odometry are doubled",
        changes={"odometry.lidar:_INFLATION": to(1.0)},
        more_lines=2,
        prepared=True,
    ),
    Case(
        "odometry_floor",
        "sigmas added to every motion",
        changes={"odometry.lidar:FLOOR_RAD": to(1e-7), "odometry.lidar:FLOOR_M": to(1e-6)},
        more_lines=4,
        prepared=True,
    ),
    Case(
        "sweep",
        "decision about the sweep",
        settings=("decide_sweep=false",),
        lines=(
            "odometry/sweep/decision.py",
            "odometry/sweep/estimate.py",
            "odometry/sweep/window.py",
            "odometry/sweep/source.py",
            "covariance/undecided_sweep.py",
        ),
        more_lines=60,
        prepared=True,
    ),
    Case(
        "sweep_covariance",
        "sweeps that are undecided, in the covariance",
        changes={"batch.total_covariance:sweep_effects": answering(SweepEffects((), np.zeros((7, 7))))},
        lines=(
            "covariance/undecided_sweep.py",
            "batch/total_covariance.py:sweep_effects",
            "batch/total_covariance.py:sweep_step",
            "batch/total_covariance.py:_retimed",
            "batch/total_covariance.py:SweepEffects",
        ),
        more_lines=10,
    ),
)

LOOP: tuple[Case, ...] = (
    Case(
        "kernel_short",
        "12 scales of the kernel (4: 20, 10, 5, 3 px)",
        changes={"graph.outer_loop:KERNELS_PX": to((20.0, 10.0, 5.0, 3.0))},
    ),
    Case(
        "kernel_one",
        "the kernel's schedule (3 px)",
        changes={"graph.outer_loop:KERNELS_PX": to((3.0,))},
        more_lines=8,
    ),
    Case(
        "short_steps",
        "shorter steps after six full ones",
        changes={"graph.outer_loop:FULL_STEPS": to(1000)},
        lines=("graph/outer_loop.py:step_share",),
        more_lines=5,
    ),
    Case(
        "oscillation",
        "limit of the oscillation that counts as converged",
        changes={"graph.outer_loop:OSCILLATION_SIGMAS": to(1e9)},
        more_lines=4,
    ),
    Case(
        "inner_iterations",
        "the second inner iteration",
        changes={"graph.outer_loop:INNER_ITERATIONS": to(1)},
    ),
    Case(
        "motion_factor",
        "motion as a factor and as a check",
        settings=("use_motion=never",),
        lines=("batch/motion_factor.py",),
        more_lines=35,
        prepared=True,
    ),
    Case(
        "motion_check",
        "motion as a check (no contradiction is seen)",
        changes={
            "batch.motion_factor:MAX_DISAGREEMENT_CHI2": to(np.inf),
            "batch.motion_factor:_worst_stretch": answering(None),
        },
        lines=(
            "batch/motion_factor.py:_worst_stretch",
            "batch/motion_factor.py:_of_stretch",
            "batch/motion_factor.py:_contradiction",
        ),
        more_lines=15,
    ),
    Case(
        "motion_in_graph",
        "motion as a factor (it is only compared)",
        changes={
            "batch.calibrate:with_motion": lambda _: lambda problem, labels, stretches: WithMotion(labels)
        },
        more_lines=12,
    ),
    Case(
        "motion_inflation",
        "larger covariance where labels and motion differ",
        changes={"batch.motion_factor:UNLIKELY_CHI2": to(np.inf)},
        more_lines=8,
    ),
)

COVARIANCE: tuple[Case, ...] = (
    Case(
        "clusters",
        "cluster-robust covariance (all matches are independent)",
        changes={"covariance.cluster_robust:covariance_of": lambda _: lambda bread, *args, **options: bread},
        lines=(
            "covariance/cluster_robust.py",
            "covariance/error_model.py",
            "covariance/jackknife.py",
            "covariance/level_edges.py",
            "covariance/match_table.py",
            "covariance/sums.py",
        ),
    ),
    Case(
        "jackknife",
        "jackknife over objects, and 0.33 of the model (the model alone)",
        changes={"covariance.jackknife:composed": _model_alone},
        lines=(
            "covariance/jackknife.py:ObjectSpread",
            "covariance/jackknife.py:steps_without",
            "covariance/jackknife.py:growth_without",
            "covariance/cluster_robust.py:steps_without_objects",
        ),
        more_lines=20,
    ),
    Case(
        "two_shares",
        "0.33 of the model and 0.145 of the jackknife (half of each)",
        changes={"covariance.jackknife:_MODEL_SHARE": to(0.5), "covariance.jackknife:_OBJECT_SHARE": to(0.5)},
        more_lines=6,
    ),
    Case(
        "birge",
        "larger covariance where objects disagree",
        changes={"covariance.jackknife:ObjectSpread.disagreement": answering(1.0)},
        lines=("covariance/jackknife.py:ObjectSpread.disagreement",),
        more_lines=4,
    ),
    Case(
        "few_objects",
        "correction for few objects",
        changes={"covariance.jackknife:ObjectSpread.correction": to(1.0)},
        lines=("covariance/jackknife.py:ObjectSpread.correction",),
        more_lines=8,
    ),
    Case(
        "two_objects",
        "larger model's part with less than two objects of like weight",
        changes={"covariance.jackknife:_OF_TWO": to(np.inf)},
        more_lines=4,
    ),
    Case(
        "jackknife_bounds",
        "bounds of correction, disagreement, flatness and of what is left out",
        changes={
            "covariance.jackknife:_LARGEST_CORRECTION": to(1e9),
            "covariance.jackknife:_LARGEST_DISAGREEMENT": to(1e9),
            "covariance.jackknife:_LARGEST_RATIO": to(1e9),
            "covariance.jackknife:_LEFT_OUT": to(1.0 - 1e-9),
        },
        more_lines=12,
    ),
    Case(
        "flatness",
        "weight over curvature of the robust loss, squared",
        changes={"covariance.jackknife:bounded_ratio": answering(1.0)},
        lines=(
            "covariance/jackknife.py:bounded_ratio",
            "covariance/jackknife.py:curvature_ratio",
            "covariance/match_table.py:curvatures_of",
            "covariance/match_table.py:MatchTable.weight_curvature_ratio",
        ),
        more_lines=20,
    ),
    Case(
        "floors",
        "least variances of the error model",
        changes={"covariance.error_model:with_floors": to(ErrorModel)},
        lines=("covariance/error_model.py:with_floors",),
        more_lines=8,
    ),
    Case(
        "freedom",
        "degrees of freedom that the fit takes from the sides",
        changes={"covariance.error_model:freedom_of_sides": answering(1.0)},
        lines=("covariance/error_model.py:freedom_of_sides",),
        more_lines=4,
    ),
    Case(
        "image_shifts",
        "pictures and stamps that shift from image to image",
        changes={"covariance.image_shifts:shift_variances": answering(np.zeros(3))},
        lines=("covariance/image_shifts.py",),
        more_lines=20,
    ),
    Case(
        "considered",
        "assumptions in the covariance",
        changes={"covariance.considered:Considered.covariance": _nothing_considered},
        lines=("covariance/considered.py", "covariance/broken_assumptions.py"),
        more_lines=20,
        methods=_BOTH,
    ),
    Case(
        "broken_assumptions",
        "assumptions that may be broken, in the covariance (prior sigmas)",
        changes={"covariance.broken_assumptions:considered_sigmas": _priors_alone},
        lines=("covariance/broken_assumptions.py", "batch/assumption_tests.py:with_test_results"),
    ),
    Case(
        "assumption_test",
        "tests of the assumptions",
        settings=("assumptions.test=false",),
        lines=(
            "batch/assumption_tests.py",
            "covariance/broken_assumptions.py",
            "batch/by_edges/lens.py",
        ),
        methods=_BOTH,
    ),
    Case(
        "few_objects_in_tests",
        "Student's t in the tests of assumptions",
        changes={"batch.assumption_tests:few_objects_factor": answering(1.0)},
        lines=("batch/assumption_tests.py:few_objects_factor",),
        more_lines=6,
    ),
    Case(
        "another_optimum",
        "tests of assumptions are left out at another optimum",
        changes={"batch.assumption_tests:_ANOTHER_OPTIMUM": to(0.0)},
        more_lines=12,
    ),
    Case(
        "contradictions",
        "contradictions within a drive",
        settings=("check_contradictions=false",),
        lines=("batch/contradictions.py", "batch/part_solver.py", "covariance/contradiction.py"),
        more_lines=15,
    ),
    Case(
        "stamps",
        "jumps of the stamps",
        settings=("check_stamps=false",),
        lines=("drive/stamp_intervals.py", "batch/method_estimate.py:held_offsets"),
        more_lines=60,
    ),
)

BY_EDGES: tuple[Case, ...] = (
    Case(
        "edges_motion",
        "motion as a factor and as a check",
        changes={"batch.by_edges.problem:checking_motion": answering(None)},
        lines=("batch/by_edges/problem.py:checking_motion",),
        more_lines=40,
        methods=(EDGES,),
    ),
    Case(
        "edges_translation",
        "narrow prior of the translation (10 m)",
        changes={"batch.by_edges.problem:_TRANSLATION_SIGMA_M": to(10.0)},
        more_lines=8,
        methods=(EDGES,),
    ),
    Case(
        "edges_search",
        "search for starts (the guess)",
        changes={"batch.by_edges.optimum:edge_starts_steps": _start_as_guessed},
        lines=("edges/search.py",),
        more_lines=30,
        methods=(EDGES,),
    ),
    Case(
        "edges_restarts",
        "better optima nearby",
        changes={"batch.by_edges.optimum:RESTARTS": to(0)},
        lines=(
            "batch/by_edges/optimum.py:_better_nearby",
            "batch/by_edges/optimum.py:toward_motion",
            "batch/by_edges/optimum.py:shifted",
        ),
        more_lines=12,
        methods=(EDGES,),
    ),
    Case(
        "edges_toward_motion",
        "the one of them that is turned towards motion's rotation",
        changes={"batch.by_edges.optimum:toward_motion": answering([])},
        lines=("batch/by_edges/optimum.py:toward_motion",),
        more_lines=6,
        methods=(EDGES,),
    ),
    Case(
        "edges_peaks",
        "long steps to the peaks of edges (to their centres)",
        changes={"features.picture_gradients:nearest_edges": _centres_alone},
        lines=("batch/by_edges/optimum.py:_newton_ascent",),
        more_lines=12,
        methods=(EDGES,),
    ),
    Case(
        "edges_start_kernels",
        "six scales of the kernel on a few scans (3 px)",
        changes={"batch.by_edges.optimum:START_KERNELS_PX": to((3.0,))},
        more_lines=2,
        methods=(EDGES,),
    ),
    Case(
        "edges_kernels",
        "16 scales of the kernel on all scans (5, 3, 2, 1.2 px)",
        changes={"batch.by_edges.optimum:KERNELS_PX": to((5.0, 3.0, 2.0, 1.2))},
        methods=(EDGES,),
    ),
    Case(
        "edges_shallow",
        "upper edges that may be no outline, in the covariance",
        changes={"features.lidar_edges:_OUTLINE_M": to(0.0)},
        lines=("batch/by_edges/covariance.py:outline_steps",),
        more_lines=25,
        prepared=True,
        methods=(EDGES,),
    ),
    Case(
        "edges_small_steps",
        "edges across small steps in range (0.5 m, as of classes)",
        changes={"features.lidar_edges:_JUMP_M": to(0.5)},
        more_lines=4,
        prepared=True,
        methods=(EDGES,),
    ),
    Case(
        "edges_few_points",
        "at most 1000 points a scan (all)",
        changes={"batch.by_edges.problem:POINTS_A_SCAN": to(100_000)},
        more_lines=8,
        methods=(EDGES,),
    ),
    Case(
        "edges_object_height",
        "objects are cut off at 4.5 m",
        changes={"features.compact_objects:_MAX_HEIGHT_M": to(100.0)},
        more_lines=4,
        prepared=True,
        methods=(EDGES,),
    ),
    Case(
        "edges_half_samples",
        "half-samples of the objects, in the covariance",
        changes={"covariance.shared_errors:spread_covariance": answering(np.zeros((7, 7)))},
        lines=(
            "batch/by_edges/covariance.py:half_samples",
            "batch/by_edges/covariance.py:half_sample_steps",
        ),
        more_lines=30,
        methods=(EDGES,),
    ),
    Case(
        "edges_floor",
        "sigmas that are added",
        changes={"batch.by_edges.covariance:FLOOR": to(np.zeros(7))},
        more_lines=8,
        methods=(EDGES,),
    ),
    Case(
        "edges_farther",
        "step by edges that are farther away, in the covariance and as a check",
        changes={"batch.by_edges.optimum:farther_edges_steps": _steps_answering((np.zeros(7), ()))},
        lines=("batch/by_edges/optimum.py:farther_edges_steps",),
        more_lines=10,
        methods=(EDGES,),
    ),
    Case(
        "edges_positions",
        "where edges lie between the beams, in the covariance",
        changes={"batch.by_edges.positions:considered_positions": answering(Considered({}, {}))},
        lines=("batch/by_edges/positions.py",),
        more_lines=5,
        methods=(EDGES,),
    ),
    Case(
        "edges_contrast",
        "least agreement of edges, against other poses and other starts",
        changes={
            "batch.by_edges.reasons:MIN_CONTRAST": to(-1e9),
            "batch.by_edges.reasons:MIN_OVER_OTHER": to(1e-9),
        },
        lines=("batch/by_edges/reasons.py:edge_contrast_steps", "edges/turns.py"),
        more_lines=30,
        methods=(EDGES,),
    ),
    Case(
        "edges_halves",
        "halves of the drive against each other",
        settings=("check_contradictions=false",),
        lines=("batch/by_edges/halves.py",),
        more_lines=6,
        methods=(EDGES,),
    ),
)

START: tuple[Case, ...] = (
    Case(
        "search_votes",
        "candidates by votes (by dependence alone)",
        changes={"initialization.global_search:_SCORES": to(("dependence",))},
        more_lines=40,
        methods=(SEARCH,),
    ),
    Case(
        "search_dependence",
        "candidates by dependence (by votes alone)",
        changes={"initialization.global_search:_SCORES": to(("votes",))},
        more_lines=40,
        methods=(SEARCH,),
    ),
    Case(
        "search_near",
        "a family of candidates near the guess's translation (free)",
        changes={"initialization.global_search:_NEAR_TRANSLATION_M": to(0.6)},
        more_lines=10,
        methods=(SEARCH,),
    ),
    Case(
        "search_cross_entropy",
        "candidates are improved before they are refined",
        changes={"initialization.global_search:COARSE": to((replace(COARSE[0], rounds=0),))},
        lines=("initialization/global_search.py:_cross_entropy_steps",),
        more_lines=30,
        methods=(SEARCH,),
    ),
    Case(
        "search_labels",
        "labels of all points in the choice of the start",
        changes={"initialization.candidates:label_score_steps": _equal_label_scores},
        lines=("initialization/candidates.py:label_score_steps",),
        more_lines=10,
        methods=(SEARCH,),
    ),
    Case(
        "search_second",
        "a second start that is solved on all frames",
        changes={
            "initialization.selection:_SELECTED": to(1),
            "initialization.selection:_with_alternative": _first_alone,
        },
        lines=(
            "initialization/selection.py:_with_alternative",
            "initialization/selection.py:alternatives",
        ),
        more_lines=30,
        methods=(SEARCH,),
    ),
    Case(
        "search_few_points",
        "fewer points under wide kernels (all)",
        changes={"initialization.selection:_WIDE_POINTS": to(100_000)},
        more_lines=12,
        methods=(SEARCH,),
    ),
    Case(
        "search_selection",
        "candidates are dropped from stage to stage (none but alike ones)",
        changes={"initialization.selection:_KEPT_SHARE": to(1.0)},
        more_lines=10,
        methods=(SEARCH,),
    ),
    Case(
        "search_offsets",
        "the best candidate at other time offsets",
        changes={
            "initialization.selection:_with_offsets": lambda _: lambda candidates, offset_s: list(candidates)
        },
        lines=("initialization/selection.py:_with_offsets",),
        methods=(SEARCH,),
    ),
    Case(
        "search_object_share",
        "objects of which little meets a contour are left out of the search",
        changes={"initialization.pose_batch:_MIN_OBJECT_SHARE": to(0.0)},
        more_lines=4,
        methods=(SEARCH,),
    ),
    Case(
        "search_last_steps",
        "six more steps at the last scale",
        changes={"initialization.selection:_NARROW_STAGE": to(NARROW_KERNELS_PX)},
        more_lines=2,
        methods=(SEARCH,),
    ),
    Case(
        "search_narrow",
        "narrow kernels from a start that was searched (the whole schedule)",
        changes={"graph.outer_loop:NARROW_KERNELS_PX": to(KERNELS_PX)},
        more_lines=4,
        methods=(SEARCH,),
    ),
    Case(
        "search_agreement",
        "least agreement of labels, in the status",
        changes={"graph.outer_loop:poor_fit": answering([])},
        lines=("graph/outer_loop.py:poor_fit", "graph/outer_loop.py:concentration"),
        more_lines=20,
        methods=(SEARCH,),
    ),
    Case(
        "search_alternatives",
        "other solutions that agree nearly as well, in the status",
        changes={"batch.joint_report:_alternatives": answering(())},
        lines=("batch/joint_report.py:_alternatives",),
        more_lines=8,
        methods=(SEARCH,),
    ),
)

DIAGNOSTICS: tuple[Case, ...] = (
    Case(
        "lens_beside_labels",
        "test of the principal point by edges of some frames",
        changes={"batch.calibrate:lens_beside_labels": answering(())},
        lines=(
            "batch/by_edges/lens.py:lens_beside_labels",
            "batch/by_edges/lens.py:_may_contradict",
            "batch/assumption_tests.py:with_further_tests",
            "drive/edges_of_frames.py",
            "batch/by_edges/problem.py:problem_of_some_frames",
            "batch/by_edges/problem.py:_with_some_edges",
            "batch/by_edges/problem.py:_some_pairs",
        ),
        more_lines=25,
    ),
    Case(
        "frame_gains",
        "what each frame tells, in the diagnostics",
        changes={"inspect.frame_gains:frame_gains": answering(())},
        lines=("inspect/frame_gains.py", "inspect/frame_information.py"),
        more_lines=4,
    ),
    Case(
        "fit",
        "how the estimate fits the labels, in the result",
        changes={"batch.joint_report:fit_of": answering(None)},
        lines=("quality/fit_of_solution.py", "quality/close_points.py", "quality/residuals.py"),
        more_lines=25,
    ),
)
"""They cost a third of the time, and change neither estimate nor covariance: the status at most."""

NOTHING = Case("nothing", "nothing", methods=(JOINT, EDGES, SEARCH))
LEAN = Case(
    "lean",
    "the principal point's test, what each frame tells, and the fit together",
    changes={place: change for case in DIAGNOSTICS for place, change in case.changes.items()},
    lines=[place for case in DIAGNOSTICS for place in case.lines],
    more_lines=sum(case.more_lines for case in DIAGNOSTICS),
)
"""The full method without the diagnostics: the other cases by labels are left out of it, to save time."""
CASES: tuple[Case, ...] = (
    NOTHING,
    LEAN,
    *DIAGNOSTICS,
    *FEATURES,
    *MATCHES,
    *OBJECTS,
    *ODOMETRY,
    *LOOP,
    *COVARIANCE,
    *BY_EDGES,
    *START,
)
