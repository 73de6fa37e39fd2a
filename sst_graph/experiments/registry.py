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
    rigs,
    slam,
    windows,
)
from sst_graph.experiments.paper.tables import TABLES, PaperTable
from sst_graph.experiments.peers import runs as peer_runs
from sst_graph.experiments.peers import table as peer_table


@dataclass(frozen=True)
class Experiment:
    """An experiment.

    Attributes:
        summary: what it shows, in a line.
        config: its default settings, a frozen dataclass.
        run: makes its Markdown from settings of that class.
        table: what else it writes, and what makes it resumable; None where the Markdown is all.
    """

    summary: str
    config: Any
    run: Callable[[Any, Progress | None], str]
    table: PaperTable | None = None


EXPERIMENTS: Mapping[str, Experiment] = {
    "accuracy": Experiment(
        "errors, failures and NEES of the joint method, by scenario",
        accuracy.AccuracyConfig(),
        accuracy.run,
    ),
    "assumptions": Experiment(
        "assumptions broken on purpose: found or not, errors left",
        assumptions.AssumptionTableConfig(),
        assumptions.run,
    ),
    "basin": Experiment(
        "starts over the whole sphere: failures, silent ones, bounds",
        basin.BasinConfig(),
        basin.run,
    ),
    "consistency": Experiment(
        "NEES and coverage over many short simulated drives",
        consistency.ConsistencyConfig(),
        consistency.run,
    ),
    "drives": Experiment(
        "real drives from wrong starts: spread, distance to reference",
        drives.DrivesConfig(),
        drives.run,
    ),
    "fit": Experiment(
        "boundary points near contours: right and turned poses",
        fit.FitTableConfig(),
        fit.run,
    ),
    "motion": Experiment(
        "what motion alone determines, and adds to the joint method",
        motion.MotionTableConfig(),
        motion.run,
    ),
    "peers": Experiment(
        "other methods, re-implemented, and ours from the same starts",
        peer_runs.PeersConfig(),
        peer_table.run,
    ),
    "rigs": Experiment(
        "several cameras on one LiDAR, with and without known poses",
        rigs.RigTableConfig(),
        rigs.run,
    ),
    "slam": Experiment(
        "SLAM and calibration in one graph against either alone",
        slam.SlamConfig(),
        slam.run,
    ),
    **{name: Experiment(one.summary, one.config, one.run, one) for name, one in TABLES.items()},
    "windows": Experiment(
        "real drives in windows: spread against the claimed sigmas",
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
