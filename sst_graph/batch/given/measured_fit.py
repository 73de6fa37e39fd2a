"""How a calibration fits a drive at its own pose and time offset: nothing is estimated.

The functions are those that ``calibrate`` measures its estimate with; so a calibration that was written by
hand, changed, or made of another drive has the same figures.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.by_edges.choice import with_method_for
from sst_graph.batch.by_edges.problem import with_fewer_points
from sst_graph.batch.config import CalibrationConfig, prepared_classes
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.batch.sources import as_sources
from sst_graph.cameras.estimated_camera import estimated_values
from sst_graph.config import from_dict
from sst_graph.drive.geometric_labels import GeometricallyLabelled
from sst_graph.drive.preparation import Progress, check_progress, prepare_drive
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors.arguments import described
from sst_graph.fit import (
    EDGE_BIAS,
    MASK_BIAS,
    Fit,
    FitQuality,
    MeasuredFit,
    PointResiduals,
    mask_biases_px,
)
from sst_graph.floating_point import with_usual_errors
from sst_graph.graph.state import State
from sst_graph.inspect.verdict import is_start
from sst_graph.odometry.sweep import SWEEP_KEY, with_sweep, with_sweep_of
from sst_graph.result import CalibrationResult
from sst_graph.types import Guess, SemanticClass, Source

_LOG = logging.getLogger(__name__)

_BIAS_ROUNDS = 2
"""With a bias points meet other contours: a second round is of those."""
_LEFT_AND_RIGHT = (0, 1)
"""Sides of :class:`~sst_graph.fit.PointResiduals`."""
_LEAST_POINTS = 10
"""Fewest points on either side that tell a bias."""


@with_usual_errors
def measure_fit(result: CalibrationResult, source: Source, progress: Progress | None = None) -> MeasuredFit:
    """How a result fits a drive at its ``T_camera_lidar`` and time offset, by labels and by edges.

    A lens that was estimated with it counts for the same camera. Mask biases count as in the result where the
    drive is one of its own, for another one as the outlines' width says
    (:attr:`~sst_graph.fit.MeasuredFit.bias_px`).

    Args:
        source: a drive that it was made of, or another one of the same sensors.
        progress: called with (stage, steps done, steps in all).

    Raises:
        DataError: no result, no drive, or frames that cannot be used.
        FactorError: ``progress`` cannot be called so.
    """
    check_progress(progress)
    if not isinstance(result, CalibrationResult):
        raise DataError("result", described(result), "a CalibrationResult (read_result)")
    if result.initial is None and is_start(result):
        raise DataError("result", "no estimate and no start", "a calibration")
    (source,) = as_sources([source])
    config = settings_of(result)
    decided = result.diagnostics.get(SWEEP_KEY)
    if isinstance(decided, Mapping) and source.name in decided:
        source = with_sweep_of(source, result.diagnostics)
    else:
        source = with_sweep(source, config.decide_sweep, progress)
    labels: FitQuality | None = None
    biases: dict[SemanticClass, float] = {}
    if with_method_for(replace(config, method="auto"), [source]).method != "edges":
        labels, biases = _quality(result, source, replace(config, method="joint"), progress)
    edges, _ = _quality(result, source, replace(config, method="edges"), progress)
    return MeasuredFit(source.name, labels, edges, {c.name.lower(): bias for c, bias in biases.items()})


def settings_of(result: CalibrationResult) -> CalibrationConfig:
    """The settings that the result was made with; those of a tracker are below ``calibration``.

    Those of a later version, or of none, are the defaults, and that is logged.
    """
    own = result.config.get("calibration", result.config)
    try:
        config = from_dict(CalibrationConfig, own if isinstance(own, Mapping) else {})
    except ConfigError as error:
        _LOG.warning("measured with the default settings, for those of the result cannot be read: %s", error)
        config = CalibrationConfig()
    return replace(config, use_motion="never", time_offset_per_drive=False)


def _quality(
    result: CalibrationResult, source: Source, config: CalibrationConfig, progress: Progress | None
) -> tuple[FitQuality | None, dict[SemanticClass, float]]:
    """Of labels or of edges, by the method in the settings, and the biases by class [px].

    No quality where the drive has none in view.
    """
    by_edges = config.method == "edges"
    # Motion between images is no part of the fit: no features are tracked.
    prepare = replace(config.prepare, use_visual_odometry=False)
    seen = GeometricallyLabelled(source) if by_edges else source
    drive = prepare_drive(seen, prepared_classes(config), prepare, progress, False, not by_edges)
    below = () if by_edges else _classes(result.diagnostics.get("lower_edges"))
    config = replace(config, noise=replace(config.noise, lower_edges=below))
    guess = Guess(result.initial, result.initial_time_offset_s)
    problem = CalibrationProblem.of([drive], guess, config)
    if by_edges:
        problem = with_fewer_points(problem)
    # Of labels and edges together, what the edges have of their own stands by itself.
    of_edges = result.diagnostics.get("edges")
    kept = of_edges if by_edges and isinstance(of_edges, Mapping) else result.diagnostics
    biases = mask_biases_px(kept, source.name, EDGE_BIAS if by_edges else MASK_BIAS)
    nuisances = estimated_values(result, ASSUMPTIONS) if result.camera == source.camera else {}

    def measured() -> Fit | None:
        of_drive = {(0, c): bias for c, bias in biases.items()}
        offset_s = result.time_offset_of(source.name)
        return problem.fit_at(State(result.T_camera_lidar, (offset_s,), of_drive, nuisances=nuisances))

    known, fit = by_edges or bool(biases), measured()
    for _ in range(0 if known else _BIAS_ROUNDS):
        if fit is None:
            break
        for c in map(SemanticClass, np.unique(fit.points.classes)):
            biases[c] = biases.get(c, 0.0) + width_bias_px(fit.points, c)
        fit = measured()
    return (None if fit is None else fit.quality), biases


def width_bias_px(points: PointResiduals, semantic_class: int) -> float:
    """How much wider than the objects their outlines are drawn, on either side [px]; 0 where too few tell.

    The mean of what points lie inside of them on the left and on the right: a rotation, or a shift, brings
    those of one side in and those of the other out.
    """
    of_class = points.classes == semantic_class
    sides = [points.residuals_px[of_class & (points.sides == side)] for side in _LEFT_AND_RIGHT]
    if min(map(len, sides)) < _LEAST_POINTS:
        return 0.0
    return -float(np.mean([np.median(side) for side in sides]))


def _classes(names: Any) -> tuple[SemanticClass, ...]:
    """Classes by their names in a result's diagnostics, those that are known."""
    known = {c.name.lower(): c for c in SemanticClass}
    return tuple(known[name] for name in names if name in known) if isinstance(names, list) else ()
