"""``sst-graph experiment``: a table of accuracy, made from seeds."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

from sst_graph.cli.inputs import settings
from sst_graph.cli.messages import mention, say
from sst_graph.cli.outputs import check_apart
from sst_graph.cli.progress import ProgressBar
from sst_graph.experiments.registry import experiment
from sst_graph.files import output_file


def run(args: argparse.Namespace) -> int:
    """Run the experiment ``args.name``; its Markdown goes to ``args.out``, or to the terminal."""
    chosen = experiment(args.name)
    methods = None if args.methods is None else [m.strip() for m in args.methods.split(",") if m.strip()]
    flags = {"streets": args.streets, "seed": args.seed, "methods": methods}
    flags |= {"data": args.data, "jobs": args.jobs}
    config = settings(chosen.config, args, flags)
    check_apart({"--config": args.config}, {"--out": args.out})
    with ExitStack() as outputs:
        out = None if args.out is None else outputs.enter_context(output_file(args.out, args.overwrite))
        with ProgressBar() as progress:
            text = chosen.run(config, progress)
        if out is None:
            say(text, end="")
            return 0
        out.write_text(text)
    mention(f"{'wrote':<15} {args.out}")
    return 0
