"""The commands on the program itself: ``settings``, ``completion``."""

from __future__ import annotations

import argparse

from sst_graph.cli.options.base_parser import Commands


def add_settings_command(commands: Commands) -> argparse.ArgumentParser:
    text = "list the settings of calibrate and track: default, unit, range, and when to change them"
    settings = commands.add_parser("settings", help=text, description=text)
    settings.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        default="",
        help="only those whose dotted name contains this, such as start or joint.graph",
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
        "sst-graph completion zsh > a folder of $fpath, as _sst-graph.",
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    return completion
