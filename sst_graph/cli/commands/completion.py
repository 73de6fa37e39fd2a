"""``sst-graph completion``: commands, options and paths completed in a shell."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.messages import say
from sst_graph.cli.options import build_parser
from sst_graph.errors import optional_module


def run(args: argparse.Namespace) -> int:
    """Print the script of ``args.shell``."""
    without = "completion needs shtab, which is not installed"
    shtab = optional_module("shtab", without, "completion")
    parser = build_parser()
    _complete_paths(parser, shtab.FILE)
    say(shtab.complete(parser, args.shell))
    return 0


def _complete_paths(parser: argparse.ArgumentParser, files: object) -> None:
    """Let every argument that is a path be completed as one."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_paths(command, files)
        elif action.type is Path:
            action.complete = files  # type: ignore[attr-defined]
