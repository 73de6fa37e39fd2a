"""``sst-graph inspect``: how far a result can be trusted, and what to record next."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from sst_graph.cli.inputs import result_at
from sst_graph.errors import ConfigError
from sst_graph.files import atomic_directory, check_writable_target
from sst_graph.uncertainty.inspection import InspectConfig, Inspection, inspect_result, to_dict
from sst_graph.uncertainty.inspection_words import inspection_text
from sst_graph.viz.inspection import inspection_plots

MARKER = "ellipses.png"
"""The plot by which a folder is known as ours, and may be replaced."""


def run(args: argparse.Namespace) -> int:
    """Print the inspection of ``args.result``; draw it where ``--plots`` asks for it."""
    if args.next < 1:
        raise ConfigError(f"--next {args.next}: expected 1 or more")
    if args.plots is not None:
        check_writable_target(args.plots, args.overwrite, owned_by=MARKER)
    inspection = inspect_result(result_at(args.result), InspectConfig(next_frames=args.next))
    wrote = ""
    if args.plots is not None:
        names = _write_plots(inspection, args.plots, args.overwrite)
        wrote = f"\n\nwrote {args.plots}: {', '.join(names)}"
    if args.json:
        print(json.dumps(to_dict(inspection), allow_nan=False))
    else:
        print(inspection_text(inspection, args.all_frames) + wrote)
    return 0


def _write_plots(inspection: Inspection, folder: Path, overwrite: bool) -> list[str]:
    """Draw everything before the folder appears; the names of the plots."""
    plots = inspection_plots(inspection)
    with atomic_directory(folder, overwrite, owned_by=MARKER) as partial:
        for name, plot in plots.items():
            plot.savefig(partial / name, format="png", dpi=110)
    return list(plots)
