"""The parser of ``sst-graph`` with all its commands."""

from __future__ import annotations

import argparse

import sst_graph
from sst_graph.cli.options.base_parser import Commands, Parser
from sst_graph.cli.options.calibration import add_batch, add_calibrate, add_track
from sst_graph.cli.options.drives import add_info, add_segment
from sst_graph.cli.options.formats import add_export, add_import
from sst_graph.cli.options.results import add_evaluate, add_inspect, add_overlay, add_view
from sst_graph.cli.options.simulation import add_demo, add_experiment, add_simulate


def add_settings_command(commands: Commands) -> argparse.ArgumentParser:
    text = "list the settings of calibrate and track: default, unit, range, and when to change them"
    settings = commands.add_parser("settings", help=text, description=text)
    settings.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        default="",
        help="only those whose dotted name contains this, such as search or noise.mask",
    )
    form = settings.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON")
    form.add_argument("--markdown", action="store_true", help="print Markdown (docs/reference/settings.md)")
    return settings


def add_completion(commands: Commands) -> argparse.ArgumentParser:
    text = "print what completes commands and options in a shell"
    completion = commands.add_parser(
        "completion",
        help=text,
        description=f"{text[0].upper()}{text[1:]}: source <(sst-graph completion bash), or in zsh "
        "sst-graph completion zsh > a folder of $fpath, as _sst-graph, or in fish "
        "sst-graph completion fish > ~/.config/fish/completions/sst-graph.fish.",
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh", "fish"))
    return completion


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``sst-graph`` with all its commands."""
    parser = Parser(
        prog="sst-graph",
        description="LiDAR-camera calibration without targets, in space and time, as a GTSAM factor graph.",
        epilog="Exit codes: 0 done; 2 bad input or usage, or an output that could not be written; 3 "
        "finished, but the result is not to be trusted (the reason is on stderr, the files are written); "
        "130, 143, 129 ended by Ctrl-C, SIGTERM, SIGHUP; 141 the reader of stdout has gone.",
    )
    parser.add_argument("--version", action="version", version=f"sst-graph {sst_graph.__version__}")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=Parser, title="commands"
    )
    for add in (
        add_demo,
        add_simulate,
        add_calibrate,
        add_batch,
        add_track,
        add_evaluate,
        add_inspect,
        add_overlay,
        add_view,
        add_export,
        add_import,
        add_info,
        add_segment,
        add_settings_command,
        add_experiment,
        add_completion,
    ):
        command = add(commands)
        loudness = command.add_mutually_exclusive_group()
        loudness.add_argument("-v", "--verbose", action="store_true", help="log what happens on stderr")
        loudness.add_argument(
            "-q",
            "--quiet",
            action="store_true",
            help="no progress, and no summary of what is in the files; warnings and errors only",
        )
    return parser
