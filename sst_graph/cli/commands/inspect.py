"""``sst-graph inspect``: how far a result can be trusted, and what to record next."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sst_graph.cli.inputs import result_with_information
from sst_graph.cli.messages import say
from sst_graph.cli.options import SOURCE_DEFAULTS
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.progress import ProgressBar
from sst_graph.cli.reading import checked_options, open_drive_of, reading_words
from sst_graph.errors import ConfigError, in_file
from sst_graph.files import OutputKind, atomic_directory
from sst_graph.fit import MeasuredFit
from sst_graph.inspect.inspection import Inspection, inspect_result, to_dict
from sst_graph.inspect.inspection_text import inspection_text
from sst_graph.result import result_file
from sst_graph.viz.inspection import inspection_plots

PLOTS = OutputKind("folder of plots")

MOST_NEXT = 100_000
"""Frames that a prediction may add: some hours of driving."""


def run(args: argparse.Namespace) -> int:
    """Print the inspection of ``args.result`` and its fit to ``args.data``; draw it for ``--plots``."""
    if not 1 <= args.next <= MOST_NEXT:
        raise ConfigError(f"--next {str(args.next)[:12]}: expected 1 or more, at most {MOST_NEXT}")
    check_apart({"RESULT": result_file(args.result), "DATA": args.data}, {"--plots": args.plots})
    if args.data is None:
        _refuse_data_options(args)
    names = []
    if args.plots is None:
        inspection, measured = _inspected(args)
    else:
        with atomic_directory(args.plots, args.overwrite, PLOTS) as folder:
            inspection, measured = _inspected(args)
            names = _write_plots(inspection, folder)
    read_as = checked_options(inspection.result.read_as, result_file(args.result))
    if args.json:
        now = None if measured is None else measured.to_dict()
        say(json.dumps({**to_dict(inspection), "fit_now": now, "read_as": read_as}, allow_nan=False))
    else:
        parts = [inspection_text(inspection, args.all_frames, measured)]
        if reading_words(read_as):
            parts.append(f"The drives were read with {reading_words(read_as)}.")
        if names:
            parts.append(f"wrote {args.plots}: {', '.join(names)}")
        say("\n\n".join(parts))
    return 0


def _inspected(args: argparse.Namespace) -> tuple[Inspection, MeasuredFit | None]:
    """The inspection, and the fit to ``args.data`` where that was given."""
    result = result_with_information(args.result)
    with in_file(result_file(args.result)):
        inspection = inspect_result(result, args.next)
    if args.data is None:
        return inspection, None
    # What measures a drive brings all that calibrates one; without a drive nothing waits for it.
    from sst_graph.batch.given.measured_fit import measure_fit

    source = open_drive_of(args, args.data, result, args.result)
    with ProgressBar() as progress:
        return inspection, measure_fit(result, source, progress)


def _refuse_data_options(args: argparse.Namespace) -> None:
    """Refuse options that say how a drive is read, where none was given.

    Raises:
        ConfigError: there is one.
    """
    for name in SOURCE_DEFAULTS:
        if getattr(args, name) is not None:
            raise ConfigError(f"--{name.replace('_', '-')}: says how DATA is read, expected RESULT DATA")


def _write_plots(inspection: Inspection, folder: Path) -> list[str]:
    """Draw everything; the names of the plots."""
    plots = inspection_plots(inspection)
    for name, plot in plots.items():
        plot.savefig(folder / name, format="png", dpi=110)
    return list(plots)
