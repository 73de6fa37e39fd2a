"""``--method both``: labels where both sensors have some, edges in the other frames, one estimate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sst_graph.batch.by_edges.fusion import Fused, state_of
from sst_graph.batch.by_edges.label_parts import split_by_labels
from sst_graph.batch.by_edges.method import edges_method
from sst_graph.batch.by_edges.problem import LabelEstimate
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.batch.motion_factor import MAX_DISAGREEMENT_CHI2
from sst_graph.covariance.undecided_sweep import MATTERS
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.fit import Fit
from sst_graph.graph.state import State, step_text
from sst_graph.inspect.frame_information import KEY as FRAME_INFORMATION
from sst_graph.types import Guess

ByLabels = Callable[[Sequence[Drive], Guess, CalibrationConfig, Progress | None], MethodEstimate]

_Part = MethodEstimate | str
"""An estimate, or why there is none."""
_START_SIGMAS = np.array([*np.radians([0.3] * 3), 0.15, 0.15, 0.15, 0.03])
"""(7,) labels that know the calibration this well give edges their start: within the widest kernel [rad, m,
s]."""


def both_method(
    by_labels: ByLabels,
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
) -> MethodEstimate:
    """Extrinsic and time offset from labels and edges.

    Args:
        by_labels: the method for frames with labels.
        drives: prepared with their labels and with objects without a class.

    Raises:
        EstimationError: neither labels nor edges give an estimate.
    """
    with_labels, without = split_by_labels(drives)
    as_joint = replace(config, method="joint")

    def solve_labels(begin: Guess) -> _Part:
        if not with_labels:
            return "no class has labels on both sides"
        return _attempt(lambda: by_labels(with_labels, begin, as_joint, progress))

    # 1. Labels; they give edges their start where they know enough.
    labels = solve_labels(guess)
    # 2. Edges in the other frames.
    edges: _Part = "every frame has labels"
    if without:
        edges = _attempt(lambda: edges_method(without, guess, config, progress, _label_estimate(labels)))
    # 3. Labels that found nothing by themselves once more, from there.
    if not _usable(labels) and _usable(edges):
        assert isinstance(edges, MethodEstimate)
        labels = _started_at(guess, solve_labels(Guess(edges.cTl, edges.time_offset_s)))
    # 4. Both as one.
    return fuse_parts(labels, edges)


def _attempt(run: Callable[[], MethodEstimate]) -> _Part:
    """An estimate, or why there is none."""
    try:
        return run()
    except EstimationError as error:
        return str(error)


def _started_at(guess: Guess, part: _Part) -> _Part:
    """A part whose fit is to be measured beside the start of both."""
    if isinstance(part, str) or part.matched is None:
        return part
    return replace(part, matched=part.matched.started_at(guess))


def _fit_at(fused: State, part: MethodEstimate) -> Fit | None:
    """How a part's labels or edges fit the estimate of both."""
    return None if part.matched is None else part.matched.fit_at(fused.calibration())


def _usable(part: _Part) -> bool:
    return isinstance(part, MethodEstimate) and not part.reasons


def _label_estimate(labels: _Part) -> LabelEstimate:
    if isinstance(labels, str) or labels.reasons:
        return LabelEstimate()
    sure = bool((np.sqrt(np.diag(labels.covariance)) < _START_SIGMAS).all())
    has_motion = bool(labels.diagnostics["motion"].get("fused", False))
    return LabelEstimate(state_of(labels) if sure else None, has_motion)


def fuse_parts(labels: _Part, edges: _Part) -> MethodEstimate:
    """The estimate from both parts, or from the one that is usable.

    Raises:
        EstimationError: neither is an estimate.
    """
    if isinstance(labels, str) and isinstance(edges, str):
        raise EstimationError(f"by labels: {labels}; by edges: {edges}")
    if isinstance(edges, str) or (edges.reasons and _usable(labels)):
        assert not isinstance(labels, str)
        return _of_one_part(labels, ("edges", edges))
    if isinstance(labels, str) or (labels.reasons and _usable(edges)):
        return _of_one_part(edges, ("labels", labels))
    if labels.reasons:  # neither is usable
        reasons = [*(f"by labels: {each}" for each in labels.reasons)]
        reasons += [f"by edges: {each}" for each in edges.reasons]
        return replace(labels, reasons=tuple(reasons), solved=None, held_offsets=_held(labels, edges))
    return _of_both_parts(labels, edges)


def _of_one_part(used: MethodEstimate, left_out: tuple[str, _Part]) -> MethodEstimate:
    """One part, and why the other, of a name, was left out."""
    name, part = left_out
    why = part if isinstance(part, str) else part.reasons[0]
    remark = f"{name} were left out: {why}"
    facts = {} if isinstance(part, str) else {name: _facts(part)}
    return replace(
        used,
        remarks=(*used.remarks, remark),
        held_offsets=_held(used, part),
        diagnostics={**used.diagnostics, "both": {"left_out": remark, **facts}},
        solved=None,
    )


def _held(used: MethodEstimate, other: _Part) -> dict[str, str]:
    """Jumps of the stamps after which either part shows the same time offset, the first one's words first."""
    return {**({} if isinstance(other, str) else other.held_offsets), **used.held_offsets}


def _of_both_parts(labels: MethodEstimate, edges: MethodEstimate) -> MethodEstimate:
    """The fused estimate; it may be wrong where the two contradict each other."""
    fused = Fused.of(labels, edges)
    static = edges.covariance
    if labels.by_static_objects is not None:
        # It has no part by the assumptions.
        of_static = replace(labels, covariance=labels.by_static_objects, assumption_steps={})
        static = Fused.of(of_static, edges).covariance
    sweeps = dict.fromkeys((*labels.open_sweeps, *edges.open_sweeps))
    shares = np.diag(fused.by_sweeps) / np.diag(fused.covariance)
    # What a frame brought to the labels' estimate is not what it brought to this one.
    diagnostics = {name: value for name, value in labels.diagnostics.items() if name != FRAME_INFORMATION}
    facts = {"labels": _facts(labels), "edges": _facts(edges), "chi2_of_7": fused.chi2}
    return replace(
        labels,
        cTl=fused.state.cTl,
        time_offset_s=fused.state.time_offsets_s[0],
        covariance=fused.covariance,
        frames=tuple(dict.fromkeys((*labels.frames, *edges.frames))),
        reasons=_contradiction(fused),
        open_sweeps=tuple(sweeps) if (shares > MATTERS**2).any() else (),
        remarks=(*labels.remarks, *edges.remarks),
        by_static_objects=static,
        diagnostics=diagnostics
        | {
            "assumptions": _assumptions(fused, labels, edges),
            "edges": dict(edges.diagnostics),
            "both": facts,
        },
        solved=None,
        assumption_steps=fused.assumption_steps,
        held_offsets=_held(labels, edges),
        # Of convergence and likelihood each part has its own, about another estimate than this.
        fit=_fit_at(fused.state, labels),
        edges_fit=_fit_at(fused.state, edges),
        matched=None,
    )


def _assumptions(fused: Fused, labels: MethodEstimate, edges: MethodEstimate) -> dict[str, Any]:
    """What the parts say of the assumptions, with the sensitivities of the fused estimate."""
    said = {**edges.diagnostics.get("assumptions", {}), **labels.diagnostics.get("assumptions", {})}
    return {
        name: {**entry, "sensitivity": (fused.assumption_steps[name] / entry["sigma"]).tolist()}
        if name in fused.assumption_steps and entry["sigma"] > 0.0
        else entry
        for name, entry in said.items()
    }


def _contradiction(fused: Fused) -> tuple[str, ...]:
    if fused.chi2 <= MAX_DISAGREEMENT_CHI2:
        return ()
    return (
        f"labels and edges of different frames contradict each other: {step_text(fused.step)} apart "
        f"(chi-squared {fused.chi2:.0f} of 7)",
    )


def _facts(part: MethodEstimate) -> dict[str, Any]:
    """What a part says by itself, JSON-able."""
    return {
        "T_camera_lidar": part.cTl.matrix().tolist(),
        "time_offset_s": part.time_offset_s,
        "sigmas": np.sqrt(np.diag(part.covariance)).tolist(),
        "frames": len(part.frames),
        "reasons": list(part.reasons),
    }
