"""``sst-graph experiment``: a table of accuracy, made from seeds."""

from __future__ import annotations

import argparse

from sst_graph.cli.inputs import settings
from sst_graph.cli.progress import ProgressBar
from sst_graph.errors import ConfigError
from sst_graph.experiments.registry import experiment
from sst_graph.files import atomic_write_text


def run(args: argparse.Namespace) -> int:
    """Run the experiment ``args.name``; its Markdown goes to ``args.out``, or to the terminal."""
    chosen = experiment(args.name)
    methods = None if args.methods is None else [m.strip() for m in args.methods.split(",") if m.strip()]
    flags = {"streets": args.streets, "seed": args.seed, "methods": methods}
    config = settings(chosen.config, args, flags)
    if args.out is not None and args.out.exists() and not args.overwrite:
        raise ConfigError(f"{args.out}: found a file, expected none (or --overwrite)")
    with ProgressBar() as progress:
        text = chosen.run(config, progress)
    if args.out is None:
        print(text, end="")
        return 0
    atomic_write_text(args.out, text)
    print(f"{'wrote':<15} {args.out}")
    return 0
