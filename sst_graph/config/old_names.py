"""Settings given by an earlier name: read under the name that they have.

Names are dotted as ``--set`` takes them: of ``calibrate``, or of ``track`` and the experiments for their own.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from typing import Any

from sst_graph.config.settings import join, walk_settings
from sst_graph.config.values import printable, shown
from sst_graph.errors import ConfigError

_LOG = logging.getLogger(__name__)

RENAMED: Mapping[str, str] = {
    "assumptions.sigmas.cx": "assumptions.cx",
    "assumptions.sigmas.cy": "assumptions.cy",
    "assumptions.sigmas.focal": "assumptions.focal",
    "assumptions.sigmas.k1": "assumptions.k1",
    "assumptions.sigmas.k2": "assumptions.k2",
    "assumptions.sigmas.line_delay": "assumptions.line_delay",
    "assumptions.sigmas.range_bias": "assumptions.range_bias",
    "assumptions.sigmas.range_scale": "assumptions.range_scale",
    "assumptions.sigmas.skew": "assumptions.skew",
    "assumptions.sigmas.sweep": "assumptions.sweep",
    "camera.delay_sigma_s": "camera.time_offset_sigma_s",
    "contradictions.check": "check_contradictions",
    "delay_per_drive": "time_offset_per_drive",
    "delay_s": "time_offset_s",
    "drift.offset_s": "drift.time_offset_s",
    "joint.graph.bias_sigma_px": "noise.mask_bias_sigma_px",
    "joint.graph.delay_sigma_s": "noise.time_offset_sigma_s",
    "joint.graph.estimate": "assumptions.estimate",
    "joint.graph.match.mask_sigma_px": "noise.mask_sigma_px",
    "joint.graph.match.side_sigma_px": "noise.side_sigma_px",
    "joint.graph.object_bias_sigma_px": "noise.object_bias_sigma_px",
    "joint.graph.time_offset_sigma_s": "noise.time_offset_sigma_s",
    "lower_edges.use": "lower_edges",
    "motion.start.max_offset_s": "search.time_offset_s",
    "observability.offset_s": "observability.time_offset_s",
    "paper.seed": "seed",
    "prepare.boundary.max_range_m": "max_range_m",
    "prepare.lidar_odometry.far_m": "lidar_odometry.far_m",
    "prepare.lidar_odometry.near_m": "lidar_odometry.near_m",
    "prepare.lidar_odometry.voxel_m": "lidar_odometry.voxel_m",
    "prepare.picture.use": "image_edges",
    "semalign.seed": "seed",
    "start.enabled": "search.enabled",
    "start.search.box_deg": "search.rotation_deg",
    "start.search.delay_s": "search.time_offset_s",
    "start.search.free_translation_m": "search.free_translation_m",
    "start.search.seed": "seed",
    "start.search.time_offset_s": "search.time_offset_s",
    "start.search.translation_m": "search.translation_m",
    "sweep.decide": "decide_sweep",
    "undersides.use": "lower_edges",
}
"""Old name -> the name of the setting."""

FIXED: Mapping[str, str] = {
    "adoption": "sst_graph.tracker.monitor.monitor",
    "alarm": "sst_graph.tracker.monitor",
    "camera.match": "sst_graph.association.edge_matching",
    "challenge": "sst_graph.baselines.second_search",
    "contradictions": "sst_graph.batch.contradictions",
    "drift.epoch_s": "sst_graph.tracker.window.epochs",
    "drift.history": "sst_graph.tracker.history",
    "images": "sst_graph.tracker.inputs",
    "joint": "sst_graph.graph.outer_loop",
    "joint.graph": "sst_graph.graph.building",
    "joint.graph.match": "sst_graph.association.edge_matching",
    "joint.graph.mover_reach_m": "sst_graph.graph.matching",
    "min_frame_matches": "sst_graph.tracker.window.matcher",
    "motion": "sst_graph.hand_eye",
    "motion.full_steps": "sst_graph.graph.outer_loop",
    "motion.max_disagreement": "sst_graph.batch.motion_factor",
    "motion.settled": "sst_graph.graph.outer_loop",
    "observability": "sst_graph.covariance.observability",
    "paper": "sst_graph.baselines.sst_calib",
    "paper.standing": "sst_graph.odometry.standstill",
    "prepare": "sst_graph.drive.preparation",
    "prepare.boundary": "sst_graph.features.lidar_edges",
    "prepare.lidar_odometry": "sst_graph.odometry.lidar",
    "prepare.lidar_odometry.movers": "sst_graph.odometry.static_points",
    "prepare.picture": "sst_graph.features.image_edges",
    "prepare.visual_odometry": "sst_graph.odometry",
    "renew": "sst_graph.tracker.window.relinearization",
    "renew_most": "sst_graph.tracker.window.relinearization",
    "restart_scans": "sst_graph.tracker.start.initializer",
    "semalign": "sst_graph.baselines.semalign",
    "settle_scans": "sst_graph.tracker.window.relinearization",
    "stale_sigmas": "sst_graph.tracker.window.relinearization",
    "start": "sst_graph.initialization",
    "start.min_concentration": "sst_graph.graph.outer_loop",
    "start.min_explained": "sst_graph.graph.outer_loop",
    "start.min_explained_vague": "sst_graph.graph.outer_loop",
    "start_attempts": "sst_graph.tracker.start.initializer",
    "start_gain": "sst_graph.tracker.start.solution",
    "start_offset_step_s": "sst_graph.tracker.start.solution",
    "start_share": "sst_graph.tracker.start.solution",
    "start_work": "sst_graph.tracker.start.initializer",
    "sweep": "sst_graph.odometry.sweep",
    "sweep.window.movers": "sst_graph.odometry.static_points",
    "undersides": "sst_graph.batch.lower_edges",
}
"""Old name, or old table -> the module or package that fixes it; the longest that fits counts."""

CALIBRATION = "calibration."
"""What the names of ``calibrate``'s settings begin with in other commands; the tables leave it out."""

_MAX_DEPTH = 12
"""Levels of a table that are searched for old names: more than any name has, fewer than recursion allows."""


def with_new_names(
    cls: Any, data: Mapping[str, Any], renamed: Mapping[str, str] = RENAMED
) -> Mapping[str, Any]:
    """Nested settings for ``cls`` under the names that they have; each old name is logged as a warning.

    A name that neither ``cls`` nor ``renamed`` has stays: whoever reads it refuses it.

    Raises:
        ConfigError: a setting that is given under two names.
    """
    known = {name for name, _, _ in walk_settings(cls)}
    given: dict[str, tuple[str, Any]] = {}
    for name, value in _leaves(data):
        short = name.removeprefix(CALIBRATION)
        new = name.removesuffix(short) + renamed.get(short, short)
        if name in known or new not in known:
            new = name
        elif new != name:
            _LOG.warning("setting '%s' is called '%s': use that name", name, new)
        other, same = given.setdefault(new, (name, value))
        if other == name:
            continue
        if new in (other, name):
            raise _found_both(name if new == other else other, new)
        if same != value:
            raise ConfigError(
                f"'{printable(other)}' and '{printable(name)}', both called '{new}': found {shown(same)} and "
                f"{shown(value)}, expected one value"
            )
    if all(new == name for new, (name, _) in given.items()):
        return data
    tree: dict[str, Any] = {}
    for new, (name, value) in given.items():
        *tables, last = new.split(".")
        table = tree
        for level, key in enumerate(tables, 1):
            table = table.setdefault(key, {})
            if not isinstance(table, dict):  # a single value is given in the table's place
                raise _found_both(name, ".".join(tables[:level]))
        if last in table:
            raise _found_both(name, new)
        table[last] = value
    return tree


def _found_both(old: str, new: str) -> ConfigError:
    return ConfigError(f"'{printable(old)}' and '{printable(new)}': found both, expected the second alone")


def fixed_in(name: str, fixed: Mapping[str, str] = FIXED) -> str:
    """The module that fixes what an earlier setting set; empty for a name that never was one."""
    place = name.removeprefix(CALIBRATION)
    while place and place not in fixed:
        place = place.rpartition(".")[0]
    return fixed.get(place, "")


def _leaves(data: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of each single setting in a nested table."""
    for key, value in data.items():
        name = join(where, str(key))
        if isinstance(value, Mapping) and value and name.count(".") < _MAX_DEPTH:
            yield from _leaves(value, name)
        else:
            yield name, value
