"""Where commands write: files that they may replace, and places apart from what they read."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path

from sst_graph.errors import ConfigError
from sst_graph.files import OutputFileKind

RESULT_FILE = OutputFileKind("a calibration.json", lambda head: b'"sst-graph/calibration"' in head)
CHECKPOINT_FILE = OutputFileKind("a checkpoint of the tracker", lambda head: b"head.npy" in head[:64])
RERUN_FILE = OutputFileKind("a recording of rerun", lambda head: head.startswith(b"RRF"))
PICTURE_SOFTWARE = b"Software\0sst-graph"
"""Text in the PNGs that are written, by which they are told from the pictures of a drive."""
PNG_FILE = OutputFileKind(
    "a PNG that sst-graph wrote", lambda head: head.startswith(b"\x89PNG\r\n") and PICTURE_SOFTWARE in head
)

_NO_PATHS = ("dataset", "none", "initial")
"""Choices of ``--init`` and ``--before`` that are no files."""


def check_apart(
    inputs: Mapping[str, str | Path | None],
    outputs: Mapping[str, Path | None],
) -> None:
    """Refuse outputs that are the same file, or that would replace what is read.

    Args:
        inputs: what is read, by the name of its option; None and choices that are no paths are passed over.
        outputs: what is to be written, by the name of its option.

    Raises:
        ConfigError: two of them are one, or an input lies in a folder that would be replaced.
    """
    written = {name: Path(os.path.realpath(path)) for name, path in outputs.items() if path is not None}
    for (first, a), (second, b) in itertools.combinations(written.items(), 2):
        if _same(a, b):
            raise ConfigError(f"{first} and {second}: found the same file {outputs[first]}, expected two")
    named = {name: path for name, path in inputs.items() if path is not None and path not in _NO_PATHS}
    read = {name: Path(os.path.realpath(path)) for name, path in named.items()}
    for (output, a), (given, b) in itertools.product(written.items(), read.items()):
        if _same(a, b) or a in b.parents:
            raise ConfigError(
                f"{output} {outputs[output]}: is read as {given} and would be replaced, expected another name"
            )


def _same(a: Path, b: Path) -> bool:
    try:
        return a == b or os.path.samefile(a, b)
    except OSError:
        return False
