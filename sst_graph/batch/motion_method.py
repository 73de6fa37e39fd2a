"""``--method motion``: the hand-eye solution as a method of ``calibrate``, its fit by edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sst_graph.batch.by_edges.problem import problem_of_some_frames, with_fewer_points
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.batch.motion_factor import offsets_held_by_motion
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.fit import Fit
from sst_graph.graph.outer_loop import still_moved
from sst_graph.graph.state import difference
from sst_graph.hand_eye.solution import MotionSolution, alternative, solve_motion
from sst_graph.inspect.gained import KEY, pair_gains, to_document
from sst_graph.result import FrameId
from sst_graph.types import Guess


def motion_method(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> MethodEstimate:
    """LiDAR odometry against visual odometry; labels only leave out what may move.

    The estimate uses no edges. Its fit is measured by those of some frames, read again.

    Raises:
        EstimationError: too few consecutive frames with known motion.
    """
    solutions = solve_motion(drives, guess, config.search.time_offset_s, progress)
    best = solutions[0]
    cameras = best.terms.pairs.cameras
    frames = tuple(FrameId(drives[camera.drive].name, camera.image) for camera in cameras)
    gained = pair_gains(best.terms.each(), frames, best.state)
    return MethodEstimate(
        cTl=best.state.cTl,
        time_offset_s=best.state.time_offsets_s[0],
        covariance=best.covariance,
        frames=frames,
        reasons=_reasons(solutions),
        diagnostics={
            "outer_iterations": best.outer_iterations,
            "pairs": len(cameras),
            "directions": int(best.terms.residuals.directed.sum()),
            "noise_scales": {"rotation": best.scales.rotation, "direction": best.scales.direction},
            "turned_deg": _turned_deg(best),
            KEY: to_document(gained),
        },
        held_offsets=offsets_held_by_motion(drives, best.state, config),
        fit=check_by_edges(drives, guess, config, best) if config.for_report else None,
    )


def check_by_edges(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, solution: MotionSolution
) -> Fit | None:
    """How a solution, which has used no edge, fits those of some frames; None where no picture has any.

    Raises:
        DataError: a frame cannot be read again.
    """
    offsets_s = [solution.state.time_offset_s(number) for number in range(len(drives))]
    some = problem_of_some_frames(drives, offsets_s, guess, config)
    return None if some is None else with_fewer_points(some[0]).fit_at(solution.state, solution.iterations)


def _turned_deg(solution: MotionSolution) -> float:
    """How far the vehicle turned in all, to and fro [deg]."""
    turns = [np.linalg.norm(camera.turned) for camera in solution.terms.pairs.cameras]
    return float(np.degrees(np.sum(turns)))


def _reasons(solutions: Sequence[MotionSolution]) -> tuple[str, ...]:
    best = solutions[0]
    reasons = []
    if not best.converged:
        reasons.append(still_moved(best.outer_iterations))
    if best.misfit is not None:
        reasons.append(best.misfit)
    other = alternative(solutions)
    if other is not None:
        step = difference(best.state, other.state)
        degrees = np.degrees(np.linalg.norm(step[:3]))
        reasons.append(
            f"another solution, {degrees:.1f} deg and {1e3 * step[6]:+.0f} ms away, explains the motion "
            "almost as well: record more turns and changes of speed"
        )
    return tuple(reasons)
