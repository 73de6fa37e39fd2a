"""Folders for copies of drives and of results; the next batch removes those of a killed one."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sst_graph.files.staging import lock_file

_PREFIX = "sst-graph-batch-"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder of this process alone, removed with all it holds when the block ends."""
    root = Path(tempfile.gettempdir())
    # Locked under a hidden name, which no clean-up looks at, then renamed.
    hidden = root / f".{_PREFIX}{secrets.token_hex(8)}"
    hidden.mkdir(mode=0o700)
    descriptor = os.open(hidden, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        lock_file(descriptor)
        folder = root / hidden.name[1:]
        os.rename(hidden, folder)
        yield folder
    finally:
        shutil.rmtree(root / hidden.name[1:], ignore_errors=True)
        shutil.rmtree(hidden, ignore_errors=True)
        os.close(descriptor)


def sweep_scratch() -> int:
    """Remove the folders of processes that have ended; how many there were."""
    removed = 0
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if lock_file(descriptor):
                    shutil.rmtree(folder, ignore_errors=True)
                    removed += 1
            finally:
                os.close(descriptor)
    return removed
