"""The options of every command. Imports nothing heavy: ``--help`` answers at once.

What several commands take, by what it is about: ``data``, ``method``. The commands with what each alone
takes: ``calibration``, ``simulation``, ``drives``, ``results``, ``formats``; those on the program itself are
in ``parser``.
"""

from __future__ import annotations

from sst_graph.cli.options.data import SOURCE_DEFAULTS
from sst_graph.cli.options.formats import EXPORTS, IMPORTS
from sst_graph.cli.options.parser import build_parser

__all__ = ["EXPORTS", "IMPORTS", "SOURCE_DEFAULTS", "build_parser"]
