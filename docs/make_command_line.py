"""Writes the page of all commands and options from argparse, for the site."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from sst_graph.cli.options import build_parser

HEAD = """# Command line

All commands with their options, as `sst-graph COMMAND --help` prints them.
"""

COLUMNS = "94"


def write_page(path: Path) -> None:
    """Write the page, if it says anything new."""
    text = page()
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def page() -> str:
    """The help of ``sst-graph`` and of each of its commands, a section each."""
    os.environ["COLUMNS"] = COLUMNS
    parser = build_parser()
    parts = [HEAD, _block(parser)]
    for name, command in _commands(parser).items():
        parts += [f"## {name}\n", _block(command)]
    return "\n".join(parts)


def _block(parser: argparse.ArgumentParser) -> str:
    return f"```text\n{parser.format_help().rstrip()}\n```\n"


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (action,) = (one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    return dict(action.choices)
