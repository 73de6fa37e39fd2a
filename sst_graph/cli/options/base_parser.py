"""The argument parser of every command."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from sst_graph.cli.messages import say
from sst_graph.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import SupportsWrite


SIGN = "t_lidar = t_camera_stamp + offset"


class Parser(argparse.ArgumentParser):
    """An argument parser that complains through :class:`ConfigError`."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see '{self.prog} --help')")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        # Python before 3.13 makes an empty list of the value in --option=--, whatever the option expects.
        if action.option_strings and arg_strings == ["--"]:
            raise argparse.ArgumentError(action, "found --, expected a value")
        return super()._get_values(action, arg_strings)

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        # Help and version are printed nowhere else; argparse's own passes over a stdout that fails.
        say(message, end="")


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What a command is added to."""
