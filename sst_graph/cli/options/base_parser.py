"""The argument parser of every command."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from sst_graph.cli.messages import say
from sst_graph.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import SupportsWrite


SIGN = "t_lidar = t_camera_stamp + offset"


class Parser(argparse.ArgumentParser):
    """An argument parser that complains through :class:`ConfigError`."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see '{self.prog} --help')")

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        # Help and version are printed nowhere else; argparse's own passes over a stdout that fails.
        say(message, end="")


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What a command is added to."""
