"""The argument parser of every command, and switches under a former name."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from sst_graph.cli.messages import complain, say
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


class Renamed(argparse.Action):
    """A switch under its former name: sets what the switch ``const`` sets, and says so."""

    def __init__(self, option_strings: Sequence[str], dest: str, const: str, help: str | None = None) -> None:
        super().__init__(option_strings, const.lstrip("-").replace("-", "_"), nargs=0, const=const, help=help)

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, True)
        complain(f"{option_string} is now called {self.const}")


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What a command is added to."""
