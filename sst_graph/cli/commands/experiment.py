"""``sst-graph experiment``: a table of accuracy, made from seeds."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from sst_graph.cli.inputs import settings
from sst_graph.cli.messages import mention, say
from sst_graph.cli.output_places import check_apart
from sst_graph.cli.progress import ProgressBar
from sst_graph.errors import ConfigError
from sst_graph.experiments.paper.config import PaperTableConfig
from sst_graph.experiments.paper.tables import STATE, PaperTable
from sst_graph.experiments.registry import experiment
from sst_graph.experiments.tasks.code_version import code_version
from sst_graph.files import output_file

RECORDS_NAME = "{}.runs.jsonl"
"""File of what is done in the folder of --out, by the experiment's name."""


def run(args: argparse.Namespace) -> int:
    """Run the experiment ``args.name``; its Markdown goes to ``args.out``, or to the terminal.

    Its last line tells the command and the version of the code. Tables of the paper have further files beside
    ``args.out``; so have experiments that keep what is done, where their setting ``records`` names no file.
    """
    chosen = experiment(args.name)
    methods = None if args.methods is None else [m.strip() for m in args.methods.split(",") if m.strip()]
    flags = {"data": args.data, "streets": args.streets, "seed": args.seed, "methods": methods}
    flags["jobs"] = args.jobs
    for name, value in flags.items():
        if value is not None and not hasattr(chosen.config, name):
            raise ConfigError(f"--{name}: means nothing for experiment {args.name}")
    config = settings(chosen.config, args, flags)
    if chosen.table is not None and args.out is not None:
        return _write_table(chosen.table, config, args)
    outputs_by_name = {"--out": args.out}
    if figure := getattr(config, "figure", ""):
        outputs_by_name["the figure"] = Path(figure)
    if args.out is not None and getattr(config, "records", None) == "":
        records = args.out.parent / RECORDS_NAME.format(args.name)
        config = dataclasses.replace(config, records=str(records))
        outputs_by_name["the file of runs"] = records
    check_apart({"--config": args.config}, outputs_by_name)
    with ExitStack() as outputs:
        out = None if args.out is None else outputs.enter_context(output_file(args.out, args.overwrite))
        with ProgressBar() as progress:
            text = chosen.run(config, progress) + _origin(args)
        if out is None:
            say(text, end="")
            return 0
        out.write_text(text)
    mention(f"{'wrote':<15} {args.out}")
    return 0


def _write_table(table: PaperTable, config: PaperTableConfig, args: argparse.Namespace) -> int:
    """All files of a table of the paper; what is done stays in its file of runs, whatever ends the rest."""
    paths = table.paths(config, args.out)
    named = {"--out": args.out, **{f"the {path.suffix[1:]} beside it": path for path in paths[1:]}}
    check_apart({"--config": args.config}, {**named, "the file of runs": args.out.parent / STATE})
    left = _left_by_a_kill(paths)
    with ExitStack() as outputs:
        files = {
            path: outputs.enter_context(output_file(path, args.overwrite))
            for path in paths
            if path not in left
        }
        with ProgressBar() as progress:
            contents = {**table.files(config, progress, args.out)}
        contents[args.out] += _origin(args)
        for path in (*paths[1:], args.out):  # the table last: without it nothing is finished
            if path not in left:
                files[path].write_text(contents[path])
            elif path.read_bytes() != contents[path].encode():
                outputs.enter_context(output_file(path, args.overwrite)).write_text(contents[path])
    mention(f"{'wrote':<15} {', '.join(str(path) for path in paths)}")
    return 0


def _left_by_a_kill(paths: Sequence[Path]) -> list[Path]:
    """Files beside a table that a run may have written which ended before the table: runs are there, and the
    table is not. Where they hold what is to be written, they need no ``--overwrite``."""
    table, *others = paths
    unfinished = not table.exists() and (table.parent / STATE).is_file()
    return [path for path in others if unfinished and path.is_file()]


def _origin(args: argparse.Namespace) -> str:
    """What made a table, as its last line: figures and the version of their code stay together."""
    # Outputs and processes make no difference to the figures.
    flags = {name: getattr(args, name) for name in ("streets", "seed", "methods", "config")}
    words = [word for name, value in flags.items() if value is not None for word in (f"--{name}", str(value))]
    words += [word for setting in args.settings for word in ("--set", setting)]
    data = ["--data", *args.data] if args.data else []
    command = shlex.join(["sst-graph", "experiment", args.name, *data, *words])
    return f"\nMade by `{command}`, sst-graph {code_version()}.\n"
