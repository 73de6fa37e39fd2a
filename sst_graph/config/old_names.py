"""What to say of settings that were given by an earlier name.

Names are dotted as ``--set`` takes them: of ``calibrate``, or of ``track`` and the experiments for their own.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

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

_CALIBRATION = "calibration."
"""What the names of ``calibrate``'s settings begin with in other commands; the tables leave it out."""


def new_name(name: str, known: Collection[str]) -> str:
    """What a setting of an earlier name is called among those that a command knows; empty for other names."""
    short = name.removeprefix(_CALIBRATION)
    new = name.removesuffix(short) + RENAMED.get(short, "")
    return new if new in known else ""


def fixed_in(name: str) -> str:
    """The module that fixes what an earlier setting set; empty for a name that never was one."""
    place = name.removeprefix(_CALIBRATION)
    while place and place not in FIXED:
        place = place.rpartition(".")[0]
    return FIXED.get(place, "")
