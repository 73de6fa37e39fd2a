"""Whether the share of close points tells a right calibration from one that is 0.3 deg off.

Simulated streets are solved from the truth. The share of close points, and what the labels are said to allow,
are evaluated at the estimate, at the truth, and at calibrations turned about each axis of the LiDAR. With
``calibration.method=edges`` the points are compared with edges of the pictures, and a further column has the
share at random rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Progress
from sst_graph.edges.turns import turned_states
from sst_graph.experiments.markdown import table
from sst_graph.fit import FitQuality
from sst_graph.graph.outer_loop import NARROW_KERNELS_PX, solve_joint
from sst_graph.graph.state import State
from sst_graph.quality.fit_of_solution import FitOfDrives
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Guess

_HEAD = (
    "| label noise | street | points | at the estimate | at the truth | allowed, at the estimate "
    "| turned about x | about y | about z | allowed, turned |"
)
_BY_CHANCE = " at random rotations |"
"""The further column with edges."""
_ROUNDS = 8
"""Times that edges are solved: soft matches make short steps."""
_TURNED = 8
"""Random rotations."""


@dataclass(frozen=True)
class FitTableConfig(Settings):
    """Streets of the table.

    Attributes:
        seeds: of the streets.
        label_noises: scales of the errors of their labels.
        turn_deg: how far calibrations are turned [deg].
        street: the rest of them.
        calibration: how they are solved.
    """

    seeds: tuple[int, ...] = setting((21, 22, 23, 24), at_least=0, at_most=2**63 - 1, length=(1, 1000))
    label_noises: tuple[float, ...] = setting((0.5, 1.0, 2.0), at_least=0.0, at_most=2.0, length=(1, 100))
    turn_deg: float = setting(0.3, at_least=0.0, at_most=10.0)
    street: SimulationConfig = field(
        default_factory=lambda: SimulationConfig(frames=16, azimuth_limit_deg=50.0, time_offset_s=0.1)
    )
    calibration: CalibrationConfig = field(default_factory=lambda: CalibrationConfig(use_motion="never"))


def run(config: FitTableConfig, progress: Progress | None = None) -> str:
    """The table, in Markdown."""
    head = _HEAD + _BY_CHANCE * (config.calibration.method == "edges")
    rows: list[list[str]] = []
    total = len(config.seeds) * len(config.label_noises)
    for noise in config.label_noises:
        for seed in config.seeds:
            rows.append(_row(config, seed, noise))
            if progress is not None:
                progress("streets", len(rows), total)
    return table(head, rows)


def _row(config: FitTableConfig, seed: int, noise: float) -> list[str]:
    street = simulate(replace(config.street, seed=seed, label_noise=noise))
    truth = street.truth
    drives = prepare_drives([street], config.calibration)
    offset_s = truth.time_offset_s or 0.0
    problem = CalibrationProblem.of(drives, Guess(truth.cTl, offset_s), config.calibration)
    state = _solved(problem, State(truth.cTl, (offset_s,)))
    fit = FitOfDrives(problem.drives, problem.motions, problem.objects, problem.config.joint.graph)

    def quality(at: State) -> FitQuality:
        measured = fit.measured(at)
        return FitQuality(0, 0.0, None, 0.0) if measured is None else fit.quality(measured, None)

    here = quality(state)
    there = quality(replace(state, cTl=truth.cTl, time_offsets_s=(offset_s,)))
    turned = [[quality(at) for at in _turned(state, axis, config.turn_deg)] for axis in range(3)]
    lowest = min(one.attainable for pair in turned for one in pair)
    cells = [f"{noise:g}", str(seed), str(here.points)]
    cells += map(_percent, (here.share, there.share, here.attainable))
    cells += [_percent(float(np.mean([one.share for one in pair]))) for pair in turned]
    cells.append(f"{_percent(lowest)} or more")
    if config.calibration.method == "edges":
        around = turned_states(state, config.calibration.seed)[:_TURNED]
        cells.append(_percent(float(np.mean([quality(at).share for at in around]))))
    return cells


def _solved(problem: CalibrationProblem, start: State) -> State:
    """The estimate from a start that is nearly right."""
    if problem.config.method != "edges":
        return solve_joint(problem.joint(), start, NARROW_KERNELS_PX).state
    for _ in range(_ROUNDS):
        start = solve_joint(problem.joint(), start, NEAR_KERNELS_PX).state
    return start


def _turned(state: State, axis: int, degrees: float) -> Iterator[State]:
    """The state turned both ways about an axis of the LiDAR."""
    for sign in (-1.0, 1.0):
        step = np.zeros(6)
        step[axis] = sign * np.radians(degrees)
        yield replace(state, cTl=state.cTl.compose(gtsam.Pose3.Expmap(step)))


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
