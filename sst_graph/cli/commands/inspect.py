"""``sst-graph inspect``: how far a result can be trusted, and what to record next."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sst_graph.cli.inputs import result_with_information
from sst_graph.cli.messages import say
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.reading import checked_options, reading_words
from sst_graph.errors import ConfigError
from sst_graph.files import OutputKind, atomic_directory
from sst_graph.inspect.inspection import Inspection, inspect_result, to_dict
from sst_graph.inspect.inspection_text import inspection_text
from sst_graph.result import result_file
from sst_graph.viz.inspection import inspection_plots

PLOTS = OutputKind("folder of plots")

MOST_NEXT = 100_000
"""Frames that a prediction may add: some hours of driving."""


def run(args: argparse.Namespace) -> int:
    """Print the inspection of ``args.result``; draw it where ``--plots`` asks for it."""
    if not 1 <= args.next <= MOST_NEXT:
        raise ConfigError(f"--next {str(args.next)[:12]}: expected 1 or more, at most {MOST_NEXT}")
    check_apart({"RESULT": result_file(args.result)}, {"--plots": args.plots})
    names = []
    if args.plots is None:
        inspection = inspect_result(result_with_information(args.result), args.next)
    else:
        with atomic_directory(args.plots, args.overwrite, PLOTS) as folder:
            inspection = inspect_result(result_with_information(args.result), args.next)
            names = _write_plots(inspection, folder)
    read_as = checked_options(inspection.result.read_as, result_file(args.result))
    if args.json:
        say(json.dumps({**to_dict(inspection), "read_as": read_as}, allow_nan=False))
    else:
        parts = [inspection_text(inspection, args.all_frames)]
        if reading_words(read_as):
            parts.append(f"The drives were read with {reading_words(read_as)}.")
        if names:
            parts.append(f"wrote {args.plots}: {', '.join(names)}")
        say("\n\n".join(parts))
    return 0


def _write_plots(inspection: Inspection, folder: Path) -> list[str]:
    """Draw everything; the names of the plots."""
    plots = inspection_plots(inspection)
    for name, plot in plots.items():
        plot.savefig(folder / name, format="png", dpi=110)
    return list(plots)
