"""The steps to a first estimate: by labels where there are any, by edges otherwise."""

from __future__ import annotations

from dataclasses import replace

from sst_graph.errors import EstimationError
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.by_edges.kinds import by_edges, by_labels, of_kind
from sst_graph.tracker.by_edges.start import first_edge_estimate_steps
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.start.first_estimate import FirstEstimate, StartGuess, Stretch
from sst_graph.tracker.start.solution import first_estimate_steps


def start_steps(stretch: Stretch, guess: StartGuess, config: TrackerConfig) -> Stepwise[FirstEstimate]:
    """The batch solution of some scans, step by step.

    Raises:
        EstimationError: none.
    """
    classes, drive, why = config.calibration.classes, stretch.drive, ""
    if not by_edges(classes):
        return FirstEstimate((yield from first_estimate_steps(drive, guess, config)))
    if by_labels(classes) and all(drive.labelled_ns):
        labelled = of_kind(drive, edges=False)
        try:
            return FirstEstimate((yield from first_estimate_steps(labelled, guess, config)))
        except EstimationError as error:
            why = f"by labels: {error}; by edges: "
    try:
        unlabelled = replace(stretch, drive=of_kind(drive, edges=True))
        return (yield from first_edge_estimate_steps(unlabelled, guess, config))
    except EstimationError as error:
        raise EstimationError(f"{why}{error}") from error
