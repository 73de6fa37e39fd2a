"""Every experiment by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sst_graph.drive.preparation import Progress
from sst_graph.errors import ConfigError
from sst_graph.experiments import (
    accuracy,
    assumptions,
    basin,
    consistency,
    drives,
    fit,
    motion,
    paper_table,
    rigs,
    slam,
    windows,
)
from sst_graph.experiments.peers import runs as peer_runs
from sst_graph.experiments.peers import table as peer_table


@dataclass(frozen=True)
class Experiment:
    """An experiment.

    Attributes:
        summary: what it shows, in a line.
        config: its default settings, a frozen dataclass.
        run: makes its Markdown from settings of that class.
    """

    summary: str
    config: Any
    run: Callable[[Any, Progress | None], str]


EXPERIMENTS: Mapping[str, Experiment] = {
    "accuracy": Experiment(
        "accuracy, failures and consistency of the joint method, scenario by scenario",
        accuracy.AccuracyConfig(),
        accuracy.run,
    ),
    "assumptions": Experiment(
        "assumptions broken on purpose: which are found, and what the others do to the result",
        assumptions.AssumptionTableConfig(),
        assumptions.run,
    ),
    "basin": Experiment(
        "starts over the whole sphere of rotations: failures and silent failures, with their bounds",
        basin.BasinConfig(),
        basin.run,
    ),
    "consistency": Experiment(
        "NEES and coverage of the covariance over many short simulated drives",
        consistency.ConsistencyConfig(),
        consistency.run,
    ),
    "drives": Experiment(
        "real drives from many wrong starts: one result, and its distance from the reference",
        drives.DrivesConfig(),
        drives.run,
    ),
    "fit": Experiment(
        "share of boundary points close to their contour: right calibrations against turned ones",
        fit.FitTableConfig(),
        fit.run,
    ),
    "motion": Experiment(
        "what motion alone determines on simulated streets, and what it adds to the joint method",
        motion.MotionTableConfig(),
        motion.run,
    ),
    "paper-table": Experiment(
        "the paper's table: QAD, AEAD, ATD and failures from wrong starts on simulated streets",
        paper_table.PaperTableConfig(),
        paper_table.run,
    ),
    "peers": Experiment(
        "other methods, re-implemented, beside ours from the same starts: error, failures, time, memory",
        peer_runs.PeersConfig(),
        peer_table.run,
    ),
    "rigs": Experiment(
        "several cameras on one LiDAR: errors, joint NEES, and what a known pose between cameras adds",
        rigs.RigTableConfig(),
        rigs.run,
    ),
    "slam": Experiment(
        "SLAM and calibration in one graph against either alone, on simulated streets",
        slam.SlamConfig(),
        slam.run,
    ),
    "windows": Experiment(
        "real drives cut into windows: the spread of the results against the claimed sigmas",
        windows.WindowsConfig(),
        windows.run,
    ),
}


def experiment(name: str) -> Experiment:
    """The experiment of a name.

    Raises:
        ConfigError: there is none; the message names those that there are.
    """
    if name not in EXPERIMENTS:
        known = "; ".join(f"{key} ({value.summary})" for key, value in EXPERIMENTS.items())
        raise ConfigError(f"experiment '{name}': expected one of {known}")
    return EXPERIMENTS[name]
